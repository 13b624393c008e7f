"""Recorders that keep what steps are given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from oracles.hash_nodes import Value

from sim2real.errors import UsageError
from sim2real.graph import Base, BaseNode, BaseWorld, TrainableDist
from sim2real.graph.episode import MemoryRecorder
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock

KEY = jax.random.key(0)


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
