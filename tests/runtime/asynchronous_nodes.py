"""Nodes for the tests of AsyncGraph, and what any record must fulfil."""

import threading
import time

import jax
import numpy as np
from oracles.hash_nodes import Value

from sim2real.graph import BaseNode, Timeline
from sim2real.graph.episode import MemoryRecorder
from sim2real.graph.schedule import rederive
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock


class Plain(BaseNode):
    """Counts its steps in plain Python, is busy for a while in each, and notes everything that is called."""

    jittable = False
    clock = time
    """Whose ``sleep`` keeps a step busy."""

    def __init__(self, *args, busy=(0.0,), **kwargs):
        super().__init__(*args, **kwargs)
        self.busy = busy
        self.calls: list[str] = []
        self.seqs: list[int] = []
        self.threads: set[int] = set()

    def init_state(self, rng=None, graph_state=None):
        return np.int32(0)

    def init_output(self, rng=None, graph_state=None):
        return Value(x=np.int32(-1))

    def startup(self, graph_state, timeout=None):
        self.calls.append("startup")
        return True

    def stop(self, timeout=None):
        self.calls.append("stop")
        return True

    def step(self, step_state):
        self.seqs.append(int(step_state.seq))
        self.threads.add(threading.get_ident())
        seconds = self.busy[int(step_state.seq) % len(self.busy)]
        if seconds:
            self.clock.sleep(seconds)
        return step_state.replace(state=step_state.state + 1), Value(x=step_state.seq)


class Jitted(Plain):
    """The same in JAX, without side effects."""

    jittable = True

    def step(self, step_state):
        return step_state.replace(state=step_state.state + 1), Value(x=step_state.seq)


def pair(cls=Plain, rate=100.0, **options):
    """Return a sensor and an agent that listen to each other; ``options`` are those of the agent's input."""
    sensor, agent = cls("sensor", rate), Plain("agent", rate)
    agent.connect(sensor, **options)
    sensor.connect(agent, skip=True)
    return sensor, agent


def simulate(nodes, supervisor, timeline, eps=0, seed=0):
    """Return initial state and record of one episode on the simulated clock."""
    recorder = MemoryRecorder()
    graph = AsyncGraph(nodes, nodes[supervisor], Clock.SIMULATED, recorder=recorder, timeline=timeline)
    initial = graph.init(jax.random.key(seed))
    graph.start(initial.replace(eps=eps))
    assert graph.wait(timeout_s=60)
    graph.stop()
    return initial, recorder.episode()


def assert_rules_explain(episode, nodes):
    """The timeline that the rules derive from measured delays is the recorded one."""
    recorded, derived = Timeline.from_episode(episode, nodes), rederive(episode, nodes)
    for n, vertex in recorded.vertices.items():
        for field in ("start", "end", "count"):
            np.testing.assert_array_equal(getattr(derived.vertices[n], field), getattr(vertex, field), err_msg=n)
    for n, steps in episode.steps.items():
        if not any(c.blocking for c in nodes[n].inputs.values()):
            due = np.maximum(steps.scheduled + steps.drift, np.concatenate([[0], steps.end[:-1]]))
            np.testing.assert_array_equal(steps.start, due, err_msg=n)
    for (n, i), edge in recorded.edges.items():
        sender = nodes[n].inputs[i].output_node.name
        np.testing.assert_array_equal(episode.messages[n, i].seq_out, np.arange(len(episode.steps[sender])))
        np.testing.assert_array_equal(episode.messages[n, i].sent, episode.steps[sender].end)
        np.testing.assert_array_equal(derived.edges[n, i].received, edge.received, err_msg=f"{n}/{i}")
        np.testing.assert_array_equal(derived.edges[n, i].seq_in, edge.seq_in, err_msg=f"{n}/{i}")
