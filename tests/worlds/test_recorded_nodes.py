"""Worlds that recorded commands drive: where they start, their first message, when commands act, what is read."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from oracles.hash_nodes import Value

from sim2real.graph.base import Base, GraphState
from sim2real.worlds.joint import Forces, JointState, JointWorld
from sim2real.worlds.recorded import Encoder, RecordedSensor


@struct.dataclass
class Params(Base):
    start: jnp.ndarray = struct.field(default_factory=lambda: jnp.array([0.1, 0.2, 3.0, 4.0]))


class Coasting(JointWorld):
    def init_params(self, rng=None, graph_state=None):
        return Params()

    def command(self, step_state):
        return 0.0

    def forces(self, params, position, velocity, command):
        return Forces(command, 0.0, 0.0)


class Doubled(Coasting):
    def output(self, params, state):
        return 2.0 * state.position


@pytest.mark.parametrize(("start", "position", "velocity"), [([0.5, -1.0], 0.5, -1.0), ([1, 2, 3, 4], [1, 2], [3, 4])])
def test_a_world_starts_where_its_parameters_say(start, position, velocity):
    world, gs = Coasting("world", 100.0), GraphState(params={"world": Params(jnp.array(start, jnp.float32))})
    state = world.init_state(None, gs)
    np.testing.assert_array_equal(state.position, position)
    np.testing.assert_array_equal(state.velocity, velocity)
    np.testing.assert_array_equal(world.init_state().velocity, np.float32([3.0, 4.0]))


def test_its_first_message_is_the_output_of_its_state():
    state = JointState(jnp.array([7.0]), jnp.zeros(1))
    assert Doubled("world", 100.0).init_output(None, GraphState(state={"world": state})) == 14.0
    np.testing.assert_allclose(Doubled("world", 100.0).init_output(), [0.2, 0.4])
    assert Coasting("world", 100.0).init_output(None, GraphState(state={"world": state})) is state


def test_a_sensor_shows_positions_as_they_are_or_as_an_encoder_reads_them():
    seen = {"world": {-1: SimpleNamespace(data=JointState(jnp.float32(0.3), jnp.float32(9.0)))}}
    plain = RecordedSensor("sensor", 40.0, lambda x: Value(x=x))
    assert plain.step(SimpleNamespace(inputs=seen, params=plain.init_params()))[1].x == np.float32(0.3)
    assert plain.init_output().x == 0.0
    through = RecordedSensor("sensor", 40.0, lambda x: Value(x=x), Encoder(0.0, 0.0))
    assert through.init_params() == Encoder(0.0, 0.0)
    read = through.step(SimpleNamespace(inputs=seen, params=Encoder(0.1, 0.05, 0.2)))[1].x
    assert read == pytest.approx(0.3 + 0.1 + 0.05 * np.sin(0.5))
