"""Index tables of random graphs, interpreted in Python, against the simulated clock: integer hashes must be equal."""

import jax
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.hash_nodes import random_graph
from oracles.table_interpreter import interpret_hashes

from sim2real.graph import Timeline
from sim2real.graph.episode import MemoryRecorder
from sim2real.graph.schedule import draw, rederive
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.compiled.wiring import wire
from sim2real.runtime.init import OUTPUTS


def simulate(nodes, supervisor, timeline, eps=0, seed=0):
    """Return initial state and record of one episode on the simulated clock."""
    recorder = MemoryRecorder()
    graph = AsyncGraph(nodes, nodes[supervisor], Clock.SIMULATED, recorder=recorder, timeline=timeline)
    initial = graph.init(jax.random.key(seed))
    graph.start(initial.replace(eps=eps))
    assert graph.wait(timeout_s=60)
    graph.stop()
    return initial, recorder.episode()


def compare(nodes, supervisor, timeline, eps=0):
    """Check every output of the tables against the simulated clock; return the wiring."""
    wiring = wire(nodes, supervisor, timeline)
    initial, episode = simulate(nodes, supervisor, timeline, eps)
    outputs = {n: o.x for n, o in initial.aux[OUTPUTS].items()}
    made = interpret_hashes(nodes, wiring, eps, initial.state, outputs)
    for name, values in made.items():
        expected = episode.outputs.get(name, {"x": np.zeros(0, np.uint32)})["x"]
        np.testing.assert_array_equal(values, expected[: len(values)], err_msg=name)
        assert len(values) >= soon(nodes, supervisor, wiring, timeline, eps, name)
    return wiring


def soon(nodes, supervisor, wiring, timeline, eps, name):
    """Return how many steps a node must have made by the last row: those that start a few rows before."""
    if wiring.world:
        last = wiring.rows * wiring.ticks / nodes[wiring.world].rate * 1e6
        wait = 3 * np.ceil(nodes[wiring.world].rate / nodes[supervisor].rate) / nodes[wiring.world].rate * 1e6
    else:
        last, wait = timeline.vertices[supervisor].start[eps, wiring.rows - 1], 0
    v = timeline.vertices[name]
    return int((v.start[eps, : v.count[eps]] < last - wait).sum())


def check_record(nodes, timeline, episode):
    """A timeline that is derived again from its own log equals the log's."""
    derived, recorded = rederive(episode, nodes), Timeline.from_episode(episode, nodes)
    for name, v in recorded.vertices.items():
        for field in ("start", "end", "count"):
            np.testing.assert_array_equal(getattr(derived.vertices[name], field), getattr(v, field))
    for key, e in recorded.edges.items():
        np.testing.assert_array_equal(derived.edges[key].received, e.received)
        np.testing.assert_array_equal(derived.edges[key].seq_in, e.seq_in)


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(0, 10))
def test_random_graphs(seed, which):
    nodes = random_graph(seed)
    timeline = draw(nodes, 0.5, 2, seed)
    supervisor = [n for n in nodes if not n.startswith("world")][which % sum(n.startswith("n") for n in nodes)]
    compare(nodes, supervisor, timeline, eps=1)


@settings(max_examples=25)
@given(st.integers(0, 10**6))
def test_a_log_derived_again_gives_its_own_timeline(seed):
    nodes = random_graph(seed)
    timeline = draw(nodes, 0.4, 1, seed)
    _, episode = simulate(nodes, "n0", timeline)
    check_record(nodes, timeline, episode)
