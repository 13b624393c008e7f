"""The timing of a session: what it says, and what training draws from it."""

import numpy as np
import pytest

from sim2real.artifacts.timing import Spread, Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.delays import EmpiricalDist
from sim2real.graph.episode import Episode, Messages, Steps

BUS = {
    "sensor": {"transfer_us": [400] * 98 + [9000, 500], "wait_us": [0] * 99 + [300]},
    "unknown": {"transfer_us": [1], "wait_us": [1]},
}


@pytest.fixture
def episode():
    """Two nodes at 50 Hz; two of the agent's steps take 30 ms instead of 1 ms; no step uses every fourth message."""
    start = 20_000 * np.arange(100)
    took = np.full(100, 1000)
    took[[10, 50]] = 30_000
    zeros, never = np.zeros(100, np.int64), np.full(100, -1)
    late = Steps(start, start, start + 200, never, start + took, zeros)
    quick = Steps(start, start, start, never, start + 500, zeros)
    sent = start + 500
    used = np.where(np.arange(100) % 4 == 3, -1, np.arange(100))
    messages = Messages(np.arange(100), used, sent, sent + 250)
    end = {"transactions": 200, "lost_replies": 3, "retries": 3, "late_replies": 5, "late_s": [0.0, 0.001, 0.004]}
    counted = {"agent": {"overruns": 2}, "sensor": {"overruns": 0}}
    metadata = {"log": {"session_end": {**end, "timing": counted, "monotonic_ns": 12, "bus": BUS}}}
    return Episode({"sensor": quick, "agent": late}, {("agent", "sensor"): messages}, {}, metadata)


def test_it_says_what_happened(episode):
    timing = Timing.of(episode)
    agent = timing.nodes["agent"]
    assert list(timing.nodes) == ["agent", "sensor"], "in the order in which the session names them"
    assert (agent.steps, agent.overruns) == (100, 2)
    assert (agent.computation.p50, agent.computation.max) == (0.001, 0.03)
    assert agent.lateness.p50 == pytest.approx(0.0002)
    assert agent.period.p50 == pytest.approx(0.02)
    assert timing.transport_s["agent/sensor"] == pytest.approx(np.full(100, 0.00025))
    sensor = timing.nodes["sensor"]
    assert (sensor.bus.p50, sensor.bus.max) == (pytest.approx(4e-4), pytest.approx(9e-3))
    assert agent.bus == Spread(None, None, None), "it talks to no device"
    assert list(timing.bus_s) == ["sensor"]


def test_hiccups_are_left_out_and_counted(episode):
    delays, dropped = Timing.of(episode).computation(0.005)
    assert dropped == {"agent": 2}
    assert {type(d) for d in delays.values()} == {EmpiricalDist}
    rng = np.random.default_rng(0)
    assert np.unique(delays["agent"].sample(rng, (1000,))).tolist() == [0.001]
    with pytest.raises(Sim2RealError, match="only 0 of 100 steps of node 'sensor' took less"):
        Timing.of(episode).computation(0.0001)
