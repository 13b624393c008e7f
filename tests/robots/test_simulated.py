"""The nodes of a servo robot in simulation."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mujoco import mjx

from sim2real.artifacts.identification import Noise
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.robots.agent import AgentParams
from sim2real.robots.messages import Decision, JointReading
from sim2real.robots.nodes import SimActuator, SimSensor
from sim2real.robots.servo.world import ServoState
from sim2real.worlds.recorded import DelayParams


def heard(sender, message):
    one = jnp.zeros(1)
    row = jax.tree_util.tree_map(lambda x: jnp.asarray(x)[None], message)
    return {sender: InputState(jnp.zeros(1, jnp.int32), one, one, row)}


def test_the_world_is_half_a_step_behind_its_commands(pair):
    world = pair.model.make_world()
    assert world.lead_s == 0.0025
    gs = GraphState(params={"actuator": DelayParams(delay=0.02), "sensor": DelayParams(delay=0.005)})
    assert world.init_delays(None, gs) == {"actuator": pytest.approx(0.0225)}
    for params in ({}, {"actuator": DelayParams()}):
        assert world.init_delays(None, GraphState(params=params)) == {}


def test_a_push_gives_the_joints_other_velocities_and_moves_nothing(pair):
    world = pair.model.make_world()
    data = mjx.make_data(pair.model.model).replace(qvel=jnp.array([0.5, 0.0]))
    state = ServoState(data, jnp.zeros(2), {}, ((0, 1), (0, 1)))
    pushed = world.with_velocity(state, jnp.array([1.5, -1.0]))
    np.testing.assert_array_equal(world.velocity(state), [0.5, 0.0])
    np.testing.assert_array_equal(world.velocity(pushed), [1.5, -1.0])
    np.testing.assert_array_equal(pushed.data.qpos, state.data.qpos)


def test_the_sensor_and_the_actuator_pass_on_what_they_hear(pair):
    sensor = SimSensor("sensor", 50.0, pair.model.make_world())
    message = JointReading(jnp.array([0.1, 0.2]), jnp.array([1.0, 2.0]))
    _, passed = sensor.step(StepState(inputs=heard("world", message)))
    np.testing.assert_array_equal((passed.position, passed.velocity), (message.position, message.velocity))
    assert sensor.init_delays(None, GraphState(params={"sensor": DelayParams(delay=0.005)})) == {"world": 0.005}
    assert sensor.init_delays(None, GraphState()) == {}
    actuator = SimActuator("actuator", 50.0, 2)
    _, goals = actuator.step(StepState(inputs=heard("agent", Decision(jnp.array([0.3, 0.4]), jnp.zeros(1)))))
    np.testing.assert_array_equal(goals.goal, np.float32([0.3, 0.4]))
    at_rest = actuator.init_output(None, GraphState())
    np.testing.assert_array_equal(at_rest.goal, [0.0, 0.0])
    gs = GraphState(params={"agent": AgentParams(start=jnp.array([0.5, -0.1]))})
    np.testing.assert_array_equal(actuator.init_output(None, gs).goal, np.float32([0.5, -0.1]))


@pytest.fixture
def noisy(pair):
    """A sensor whose first position and second velocity scatter, and its readings of a joint that stands still."""
    sensor = SimSensor("sensor", 50.0, pair.model.make_world())
    sensor.noise = (Noise("position[0]", "rad", 0.02, 0.05, 0.3), Noise("velocity[1]", "rad/s", 0.4, 0.0, 0.0))
    still = heard("world", JointReading(jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])))

    def read(key, seq):
        own = sensor.init_state(jax.random.fold_in(key, 7))
        return sensor.step(StepState(key, own, DelayParams(), still, 0, seq, 0.0))[1]

    return sensor, jax.jit(read)


def test_readings_scatter_as_the_noise_says(noisy):
    _, read = noisy
    rows = jax.vmap(read, (None, 0))(jax.random.key(0), jnp.arange(4000))
    position, velocity = np.asarray(rows.position), np.asarray(rows.velocity)
    np.testing.assert_array_equal(position[:, 1], 2.0)
    np.testing.assert_array_equal(velocity[:, 0], 3.0)
    steps = position[:, 0] / 0.05
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    assert position[:, 0].std() == pytest.approx(np.sqrt(0.02**2 + 0.05**2 / 12), rel=0.15)
    assert velocity[:, 1].mean() == pytest.approx(4.0, abs=0.03)
    assert velocity[:, 1].std() == pytest.approx(0.4, rel=0.05)
    assert abs(np.corrcoef(velocity[1:, 1], velocity[:-1, 1])[0, 1]) < 0.06, "white"


def test_a_bias_stays_for_an_episode(noisy):
    _, read = noisy
    keys = jax.random.split(jax.random.key(1), 400)
    first, later = (np.asarray(jax.vmap(read, (0, None))(keys, k).position[:, 0]) for k in (3, 90))
    assert (first - 1.0).std() == pytest.approx(0.3, rel=0.15)
    assert np.corrcoef(first, later)[0, 1] > 0.95


def test_a_share_of_the_noise_is_that_share_of_its_errors(noisy):
    sensor, _ = noisy
    sensor = copy.copy(sensor)
    sensor.noise = tuple(dataclasses.replace(n, resolution=0.0) for n in sensor.noise)
    still = heard("world", JointReading(jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])))

    def off(share):
        params = DelayParams(noise=share)
        own = sensor.init_state(jax.random.key(7), GraphState(params={"sensor": params}))
        message = sensor.step(StepState(jax.random.key(1), own, params, still, 0, 3, 0.0))[1]
        return np.array([message.position[0] - 1.0, message.velocity[1] - 4.0])

    assert np.abs(off(None)).min() > 1e-3
    np.testing.assert_allclose(off(0.5), 0.5 * off(None), atol=1e-6)


def test_noise_needs_random_numbers_and_without_it_readings_are_exact(noisy, pair):
    sensor, _ = noisy
    still = heard("world", JointReading(jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])))
    with pytest.raises(UsageError, match="no random numbers"):
        sensor.step(StepState(None, sensor.init_state(None), DelayParams(), still, 0, 0, 0.0))
    exact = SimSensor("sensor", 50.0, pair.model.make_world())
    _, message = exact.step(StepState(None, exact.init_state(None), DelayParams(), still, 0, 0, 0.0))
    np.testing.assert_array_equal(message.position, [1.0, 2.0])
