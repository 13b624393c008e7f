"""A record of the simulated clock, from which the timing rules derive its own timeline."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.hash_nodes import random_graph

from sim2real.graph import Timeline
from sim2real.graph.episode import MemoryRecorder
from sim2real.graph.schedule import draw, rederive
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock


def simulate(nodes, supervisor, timeline, eps=0, seed=0):
    """Return initial state and record of one episode on the simulated clock."""
    recorder = MemoryRecorder()
    graph = AsyncGraph(nodes, nodes[supervisor], Clock.SIMULATED, recorder=recorder, timeline=timeline)
    initial = graph.init(jax.random.key(seed))
    graph.start(initial.replace(eps=eps))
    assert graph.wait(timeout_s=60)
    graph.stop()
    return initial, recorder.episode()


def check_record(nodes, timeline, episode):
    """A timeline that is derived again from its own log equals the log's."""
    derived, recorded = rederive(episode, nodes), Timeline.from_episode(episode, nodes)
    for name, v in recorded.vertices.items():
        for field in ("start", "end", "count"):
            np.testing.assert_array_equal(getattr(derived.vertices[name], field), getattr(v, field))
    for key, e in recorded.edges.items():
        np.testing.assert_array_equal(derived.edges[key].received, e.received)
        np.testing.assert_array_equal(derived.edges[key].seq_in, e.seq_in)


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_a_log_derived_again_gives_its_own_timeline(seed):
    nodes = random_graph(seed)
    timeline = draw(nodes, 0.4, 1, seed)
    _, episode = simulate(nodes, "n0", timeline)
    check_record(nodes, timeline, episode)
