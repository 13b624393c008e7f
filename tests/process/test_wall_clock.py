"""A graph at 100 Hz on the machine's own clock."""

import os
import threading

import jax
import numpy as np
import pytest
from asynchronous_nodes import Plain, pair

from sim2real.graph.episode import MemoryRecorder
from sim2real.runtime.asynchronous import AsyncGraph

pytestmark = pytest.mark.process


def real_time_is_allowed():
    """Whether this process may have a real-time priority, found out in a thread that ends."""
    found = []

    def try_it():
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(3))
            found.append(True)
        except OSError:
            found.append(False)

    thread = threading.Thread(target=try_it)
    thread.start()
    thread.join()
    return found[0]


@pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="priorities of Linux")
def test_a_graph_at_100_hz_keeps_its_rate_with_real_time_priority():
    class Asks(Plain):
        def step(self, step_state):
            policy = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
            self.policies.add((policy, os.sched_getparam(0).sched_priority))
            if step_state.seq == 0:
                inner = threading.Thread(target=lambda: self.inherited.append(os.sched_getscheduler(0)))
                inner.start()
                inner.join()
            return super().step(step_state)

    sensor, agent = pair(Asks)
    sensor.policies, sensor.inherited = set(), []
    before, recorder = os.sched_getscheduler(0), MemoryRecorder()
    with AsyncGraph([sensor, agent], agent, recorder=recorder) as graph:
        graph.start(graph.init(jax.random.key(0)))
        graph.run_for(2.0)
    steps = recorder.episode().steps["sensor"]
    assert 100 <= len(steps) <= 201  # a busy machine may hold it up for most of a second
    np.testing.assert_array_equal(steps.woken > steps.start, True)
    assert np.median(steps.woken - steps.start) < 2_000  # ticks of 1 us
    assert sensor.policies == {(os.SCHED_FIFO, 1) if real_time_is_allowed() else (before, 0)}
    assert sensor.inherited == [os.SCHED_OTHER if real_time_is_allowed() else before], "what a step starts has none"
    assert os.sched_getscheduler(0) == before, "nor has what runs the graph"
