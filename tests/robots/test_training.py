"""Training on a servo robot: what episodes are given, and the loop in simulation that they are played in."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_robot import VALUES

from sim2real.robots.messages import EpisodeStart
from sim2real.robots.training import node_parameters, training_loop

DELAYED = {**VALUES, "sensor_delay": 0.015, "actuator_delay": 0.012}
DRAWS = {
    "gain": np.array([3.0, 4.0, 5.0]),
    "damping": np.array([0.1, 0.2, 0.3]),
    "sensor_delay": np.array([0.015, 0.02, 0.01]),
    "actuator_delay": np.array([0.012, 0.01, 0.016]),
}
SPEEDS = jnp.array([1.5, -1.0])


@pytest.fixture(scope="module")
def loop(pair):
    """The nodes of the loop with delays, and its task."""
    return training_loop(pair, DELAYED, DRAWS, {}, True)


@pytest.fixture(scope="module")
def drawn(loop):
    """The parameters of many episodes."""
    keys = jax.random.split(jax.random.key(0), 400)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(loop[1].params))(keys))


def test_a_start_is_moved_with_its_goals_and_within_the_joints_limits(pair, drawn):
    one = jax.tree.map(lambda leaf: leaf[0], drawn)
    start = EpisodeStart(one["world"].qpos, one["world"].qvel, one["agent"].aim)
    moved = node_parameters(pair, VALUES, pair.task.moved(start, jnp.array([0.1, 100.0]), SPEEDS))
    expected = [one["world"].qpos[0] + 0.1, pair.drive.servos.high[1]]
    np.testing.assert_allclose(moved["world"].qpos, np.minimum(expected, pair.drive.servos.high), rtol=1e-6)
    np.testing.assert_array_equal(moved["agent"].start, moved["world"].qpos)
    np.testing.assert_allclose(moved["world"].qvel, one["world"].qvel + SPEEDS)


def test_half_of_the_episodes_start_from_rest_and_half_from_anywhere(pair, drawn):
    starts = drawn["world"].qpos
    resting = np.all(starts == 0.0, axis=1)
    assert 0.4 < resting.mean() < 0.6
    low, high = np.array(pair.drive.servos.low), np.array(pair.drive.servos.high)
    assert np.all((starts >= low) & (starts <= high))
    assert np.all(np.ptp(starts[~resting], axis=0) > 0.9 * (high - low))
    np.testing.assert_array_equal(drawn["agent"].start, starts)
    assert not drawn["world"].qvel.any()


def test_dynamics_and_delays_are_drawn_together_and_aims_vary(drawn):
    fields = drawn["world"].fields
    gain, damping = fields["actuator_gainprm"][:, 0, 0], fields["dof_damping"][:, 0]
    assert set(np.round(gain, 3).tolist()) == {3.0, 4.0, 5.0}
    np.testing.assert_allclose(damping, 0.1 * (gain - 2.0), rtol=1e-5)
    row = np.round(gain - 3.0).astype(int)
    total = DRAWS["sensor_delay"] + DRAWS["actuator_delay"]
    np.testing.assert_allclose(drawn["sensor"].delay + drawn["actuator"].delay, total[row], rtol=1e-5)
    aims = drawn["agent"].aim[:, 0]
    assert -0.4 <= aims.min() < -0.3
    assert 0.7 < aims.max() <= 0.8
