"""A graph without its world's physics: what the world hears and what is made of its messages are those of a rollout."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from sim2real.errors import UsageError
from sim2real.graph.base import Base
from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.runtime.compiled.open_loop import OpenLoopGraph


@struct.dataclass
class Value(Base):
    x: jax.Array


class Sender(BaseNode):
    def init_output(self, rng=None, graph_state=None):
        return Value(jnp.float32(0.25))

    def step(self, step_state):
        return step_state, Value(jnp.sin(3.0 * step_state.ts))


class World(BaseWorld):
    def init_state(self, rng=None, graph_state=None):
        return Value(jnp.float32(1.0))

    def init_output(self, rng=None, graph_state=None):
        return Value(jnp.float32(1.0))

    def step(self, step_state):
        new = Value(0.9 * step_state.state.x + step_state.inputs["sender"][-1].data.x)
        return step_state.replace(state=new), new


class Filter(BaseNode):
    """Remembers what it measured, so that a wrong order would show."""

    def init_state(self, rng=None, graph_state=None):
        return Value(jnp.float32(0.0))

    def init_output(self, rng=None, graph_state=None):
        return Value(jnp.float32(0.0))

    def step(self, step_state):
        new = Value(0.5 * step_state.state.x + step_state.inputs["world"].data.x.sum())
        return step_state.replace(state=new), new


@pytest.fixture(scope="module")
def graph():
    return make()


def make(known=True):
    sender, world, sensor = Sender("sender", 40.0), World("world", 100.0), Filter("sensor", 30.0)
    late = TrainableDist.create(0.013, 0.0, 0.05, "zoh_mean", burst=2)
    world.connect(sender, skip=True, delay_dist=late)
    sensor.connect(world, window=3, delay_dist=TrainableDist.create(0.017, 0.0, 0.05, "linear"))
    nodes = {n.name: n for n in (sender, world, sensor)}
    timeline = draw(nodes, 1.0, episodes=3)
    width = timeline.vertices["sender"].start.shape[1]
    given = {"sender": Value(np.random.default_rng(0).normal(size=(3, width)).astype(np.float32))} if known else {}
    apart = OpenLoopGraph(nodes, "sensor", given)
    tables = jax.tree_util.tree_map(jnp.asarray, apart.tables(timeline, given))
    if known:
        rows = jnp.asarray(given["sender"].x)
        sender.step = lambda s: (s, Value(rows[s.eps, s.seq]))
    return SimpleNamespace(whole=CompiledGraph(nodes, "sensor", timeline), apart=apart, data=(tables, given))


def begun(graph, eps):
    """Return the state in which an episode of the graph in open loop starts, its timing and its recorded messages."""
    return graph.apart.begin({}, {}, eps), *jax.tree_util.tree_map(lambda rows: jnp.asarray(rows)[eps], graph.data)


def test_driven_ticks_and_replayed_steps_are_those_of_a_rollout(graph):
    world = graph.apart.nodes["world"]

    def whole(eps):
        return graph.whole.rollout(graph.whole.init(jax.random.key(0), eps=eps), record=("sensor", "world"))[1]

    def apart(eps):
        gs, tables, given = begun(graph, eps)
        ticks = graph.apart.drive(gs, tables, given, world.step)
        messages = jax.tree_util.tree_map(lambda first, rest: jnp.append(first, rest), world.init_output(), ticks)
        return ticks, graph.apart.run(gs, tables, given, "sensor", {"world": messages})

    expected = jax.jit(jax.vmap(whole))(jnp.arange(3))
    ticks, sensor = jax.jit(jax.vmap(apart))(jnp.arange(3))
    same = expected["world"].output.x.shape[1]  # a rollout ends with its last whole row
    assert ticks.x.shape[1] - same in range(4)
    np.testing.assert_allclose(ticks.x[:, :same], expected["world"].output.x, rtol=1e-6)
    episode, slot = np.nonzero(np.asarray(expected["sensor"].seq) >= 0)
    assert len(slot) > 80
    seq = np.asarray(expected["sensor"].seq)[episode, slot]
    np.testing.assert_allclose(sensor.x[episode, seq], expected["sensor"].output.x[episode, slot], rtol=1e-5)
    assert np.ptp(np.asarray(ticks.x)) > 1.0


def test_a_sender_that_runs_in_the_graph_is_refused():
    graph = make(known=False)
    gs, tables, given = begun(graph, 0)
    with pytest.raises(UsageError, match="'sender' is not given"):
        graph.apart.drive(gs, tables, given, graph.apart.nodes["world"].step)
