"""The clock of emulated robots: threads take turns, and one that hangs is found all the same."""

import threading

import jax
import pytest
from asynchronous_nodes import Plain, pair
from virtual_clock import VirtualClock

from sim2real.errors import Sim2RealError
from sim2real.runtime import virtual
from sim2real.runtime.asynchronous import AsyncGraph


@pytest.fixture
def clock(monkeypatch):
    monkeypatch.setattr(Plain, "clock", VirtualClock())
    return Plain.clock


def test_all_nodes_make_their_steps_and_nobody_waits(clock):
    sensor, agent = pair()
    with AsyncGraph([sensor, agent], agent, clock) as graph:
        graph.start(graph.init(jax.random.key(0)))
        graph.run_for(60.0)
        statistics = graph.statistics()
    for node in (sensor, agent):
        assert statistics[node.name].steps == pytest.approx(60.0 * node.rate, abs=1)
        assert statistics[node.name].overruns == 0


def test_a_step_that_never_returns_ends_the_graph(clock, monkeypatch):
    monkeypatch.setattr(virtual, "_HANGS_S", 0.05)
    release = threading.Event()

    class Hangs(Plain):
        def step(self, step_state):
            if step_state.seq == 5:
                release.wait()
            return super().step(step_state)

    sensor, agent = pair(Hangs)
    graph = AsyncGraph([sensor, agent], agent, clock)
    graph.start(graph.init(jax.random.key(0)))
    graph.run_for(5.0)
    try:
        with pytest.raises(Sim2RealError, match="'sensor' is still in its step 5"):
            graph.stop()
        assert "stop" in sensor.calls
    finally:
        release.set()
