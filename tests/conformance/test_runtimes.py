"""Every way to play a timeline, under the suite that any runtime can inherit."""

import jax
import numpy as np
import pytest
from contractions import contracting_node
from oracles.conformance import Played, RuntimeConformance
from oracles.hash_nodes import jax_hash_node, random_graph
from oracles.table_interpreter import interpret_hashes

from sim2real.graph.episode import MemoryRecorder
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.runtime.compiled.wiring import wire
from sim2real.runtime.init import OUTPUTS, init_graph_state

KEY = jax.random.key(0)


def defaults(nodes, supervisor):
    state = init_graph_state(nodes, supervisor, KEY)
    return state, {n: o.x for n, o in state.aux[OUTPUTS].items()}


class TestSimulatedClock(RuntimeConformance):
    seeds = range(100, 112)

    def play(self, nodes, supervisor, timeline, episode):
        recorder = MemoryRecorder()
        graph = AsyncGraph(nodes, nodes[supervisor], Clock.SIMULATED, recorder=recorder, timeline=timeline)
        gs = graph.init(KEY).replace(eps=episode)
        graph.start(gs)
        graph.wait(60)
        graph.stop()
        outputs = {n: o["x"] for n, o in recorder.episode().outputs.items()}
        return Played(gs.state, defaults(nodes, supervisor)[1], outputs)


class TestTables(RuntimeConformance):
    seeds = range(200, 230)
    trainable = False

    def play(self, nodes, supervisor, timeline, episode):
        gs, outputs = defaults(nodes, supervisor)
        made = interpret_hashes(nodes, wire(nodes, supervisor, timeline), episode, gs.state, outputs)
        return Played(gs.state, outputs, made)


class TestCompiled(RuntimeConformance):
    make = staticmethod(jax_hash_node)
    seeds = (300, 301)

    def play(self, nodes, supervisor, timeline, episode):
        graph = CompiledGraph(nodes, supervisor, timeline)
        gs = graph.init(KEY, eps=episode)
        _, records = jax.jit(lambda s: graph.rollout(s, tuple(nodes)))(gs)
        outputs = {}
        for name, r in records.items():
            ran = np.asarray(r.seq) >= 0
            assert np.asarray(r.seq)[ran].tolist() == list(range(ran.sum()))
            outputs[name] = np.asarray(r.output.x)[ran]
        return Played(gs.state, defaults(nodes, supervisor)[1], outputs)


@pytest.mark.night
@pytest.mark.parametrize("seed", range(500))
@pytest.mark.parametrize("runtime", [TestSimulatedClock, TestCompiled])
def test_500_random_graphs(runtime, seed):
    """Timing options at random; every third with trainable delays, every third with trainable delays of floats."""
    kind = seed % 3
    make = contracting_node if kind == 2 else runtime.make
    runtime().check(random_graph(seed, make=make, trainable=kind > 0), seed, floats=kind == 2)
