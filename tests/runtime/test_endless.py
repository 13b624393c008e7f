"""The simulated clock without an end, and recorders that keep what steps are given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from oracles.hash_nodes import Value, as_message, mix, random_graph
from oracles.reference import Reference

from sim2real.errors import UsageError
from sim2real.graph import Base, BaseNode, BaseWorld, Timeline, TrainableDist, growing
from sim2real.graph.episode import MemoryRecorder
from sim2real.graph.schedule import rederive
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.runtime.init import OUTPUTS

KEY = jax.random.key(0)


@pytest.mark.parametrize("seed", [60, *(pytest.param(seed, marks=pytest.mark.night) for seed in (61, 62, 63))])
@pytest.mark.parametrize("trainable", [False, True])
def test_an_episode_goes_on_by_the_same_rules(seed, trainable, monkeypatch):
    """In pieces, over several ends of what was drawn."""
    monkeypatch.setattr(growing, "_FIRST_S", 0.4)
    nodes = random_graph(seed, trainable=trainable)
    recorder = MemoryRecorder()
    with AsyncGraph(nodes, nodes["n0"], Clock.SIMULATED, recorder=recorder) as graph:
        gs = graph.init(KEY)
        graph.start(gs)
        for _ in range(7):
            graph.run_for(0.4)
    episode = recorder.episode()
    assert min(len(s) for s in episode.steps.values()) > 30
    recorded, derived = Timeline.from_episode(episode, nodes), rederive(episode, nodes)
    for name in nodes:
        np.testing.assert_array_equal(recorded.vertices[name].start, derived.vertices[name].start)
    states = {n: int(x) for n, x in gs.state.items()}
    defaults = {n: int(o.x) for n, o in gs.aux[OUTPUTS].items()}
    for name, hashes in Reference(nodes, recorded).hashes(states, defaults).items():
        got = [int(x) for x in episode.outputs[name]["x"]]
        # Of the last steps the recorded timeline does not have all messages.
        sent = [as_message(mix(h, 7), nodes[name].dtype) for h in hashes]
        assert got[:-30] == sent[: len(got) - 30]


@struct.dataclass
class Params(Base):
    gain: float = 2.0


class World(BaseWorld):
    def init_state(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(0.0))

    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(-1.0))

    def step(self, step_state):
        new = Value(x=step_state.state.x + 1.0)
        return step_state.replace(state=new), new


class Agent(BaseNode):
    def init_params(self, rng=None, graph_state=None):
        return Params(gain=jnp.float32(2.0))

    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(0.0))

    def step(self, step_state):
        return step_state, Value(x=step_state.params.gain * step_state.inputs["world"][-1].data.x)


def pair(trainable=False):
    world, agent = World("world", 50), Agent("agent", 25)
    delay = {"delay_dist": TrainableDist.create(0.03, 0.0, 0.1), "delay": 0.0} if trainable else {}
    agent.connect(world, window=2, **delay)
    return {"world": world, "agent": agent}


def test_the_caller_ends_an_episode_of_unknown_length():
    nodes = pair()
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED)
    gs, ss = graph.reset(graph.init(KEY))
    for _ in range(250):
        gs, ss = graph.step(gs, ss, Value(x=jnp.float32(0.0)))
    graph.stop()
    assert int(ss.seq) == 250
    assert float(ss.inputs["world"].data.x[-1]) == 2 * 250 + 1


@pytest.mark.parametrize("trainable", [False, True])
def test_a_recorder_keeps_what_steps_are_given(trainable):
    nodes = pair(trainable)
    recorder = MemoryRecorder(keep=("state", "params", "inputs"))
    graph = AsyncGraph(nodes, nodes["agent"], Clock.SIMULATED, recorder=recorder, duration_s=0.4)
    graph.start(graph.init(KEY))
    graph.wait(30)
    graph.stop()
    episode = recorder.episode()
    np.testing.assert_array_equal(episode.states["world"]["x"], np.arange(len(episode.steps["world"])))
    np.testing.assert_array_equal(episode.states["world"]["x"][1:], episode.outputs["world"]["x"][:-1])
    assert (episode.params["agent"]["gain"] == 2.0).all()
    seen = episode.inputs["agent", "world"]
    assert seen["data.x"].shape == seen["seq"].shape == (len(episode.steps["agent"]), 2)
    np.testing.assert_array_equal(2.0 * seen["data.x"][:, -1], episode.outputs["agent"]["x"])
    received = seen["ts_recv"] - seen["ts_sent"]
    assert received[seen["seq"] >= 0] == pytest.approx(0.03 if trainable else 0.0, abs=1e-5)


def test_on_the_wall_clock_too_and_nothing_more_than_asked_for():
    nodes = pair()
    recorder = MemoryRecorder(keep="state")
    with AsyncGraph(nodes, nodes["agent"], Clock.WALL_CLOCK, recorder=recorder) as graph:
        gs = graph.init(KEY)
        graph.warmup(gs)
        graph.start(gs)
        graph.run_for(0.3)
    episode = recorder.episode()
    assert len(episode.states["world"]["x"]) == len(episode.steps["world"]) > 3
    assert (episode.params, episode.inputs) == ({}, {})
    with pytest.raises(UsageError, match="cannot keep rng"):
        MemoryRecorder(keep=("rng",))
