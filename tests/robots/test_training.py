"""Training on a servo robot: what episodes are given, and the loop in simulation that they are played in."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_robot import VALUES

from sim2real.graph.schedule import draw
from sim2real.robots.messages import EpisodeStart
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.training.environment.graph_environment import GraphEnvironment

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
    return pair.training(DELAYED, DRAWS, {}, True)


@pytest.fixture(scope="module")
def trained(pair, loop):
    """Half a second in which the goals move at one speed; MJX compiles for 20 s, so its tests run at night."""
    nodes, task = loop
    graph = CompiledGraph(nodes, "agent", draw(nodes, 0.5))
    env = GraphEnvironment(graph, task)

    def run(key):
        def step(state, _):
            made = env.step(state, SPEEDS, key)
            world = made.state.graph.state["world"]
            kept = {"reward": made.reward, "seen": made.observation, "goal": made.state.graph.state["agent"].command}
            return made.state, {**kept, "joints": world.data.qpos}

        first, seen = env.reset(key)
        last, rows = jax.lax.scan(step, first, length=env.length)
        world, state = nodes["world"], last.graph.state["world"]
        blow = world.velocity(state), world.velocity(world.with_velocity(state, SPEEDS)), state.data.qvel
        return first.graph.params, (seen, env.privileged(first)), rows, blow

    params, (first, true), rows, blow = jax.jit(run)(jax.random.key(5))
    return SimpleNamespace(params=params, first=first, true=true, rows=jax.tree.map(np.asarray, rows), blow=blow)


@pytest.fixture(scope="module")
def drawn(loop):
    """The parameters of many episodes."""
    keys = jax.random.split(jax.random.key(0), 400)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(loop[1].params))(keys))


@pytest.mark.night
def test_a_push_gives_the_joints_other_velocities(trained):
    before, after, moving = trained.blow
    np.testing.assert_array_equal(before, moving)
    np.testing.assert_array_equal(after, SPEEDS)


def test_a_start_is_moved_with_its_goals_and_within_the_joints_limits(pair, drawn):
    one = jax.tree.map(lambda leaf: leaf[0], drawn)
    start = EpisodeStart(one["world"].qpos, one["world"].qvel, one["agent"].aim)
    moved = pair.node_parameters(VALUES, pair.task.moved(start, jnp.array([0.1, 100.0]), SPEEDS))
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


@pytest.mark.night
def test_the_joints_follow_and_the_policy_sees_them_late(trained):
    joints, seen = trained.rows["joints"], trained.rows["seen"]
    goals = trained.rows["goal"]
    assert np.abs(np.ptp(goals, axis=0)).min() > 0.2
    lag = goals[10:] - joints[10:]
    assert np.all(lag * np.sign(np.asarray(SPEEDS)) > -0.05)
    assert np.abs(lag).max() < 0.3
    # A row ends with the next policy step: what it sees is 15 ms old.
    age = np.abs(seen[10:, :2] - joints[10:])
    assert 0.0 < age.max() < 0.06
    np.testing.assert_allclose(seen[:, 4:6], goals, atol=1e-6)
    np.testing.assert_allclose(seen[:, 6], float(trained.params["agent"].aim[0]), atol=1e-6)


@pytest.mark.night
def test_a_value_function_may_see_where_the_joints_are_and_what_they_are_like(trained):
    true = np.asarray(trained.true)
    np.testing.assert_allclose(true[:2], trained.params["agent"].start, atol=1e-6)
    for field in ("actuator_gainprm", "dof_damping"):
        assert np.isin(np.asarray(trained.params["world"].fields[field]).ravel(), true).all()


@pytest.mark.night
def test_the_reward_is_the_tasks_less_a_little_for_speed(pair, trained):
    price = 0.01 * np.mean((np.asarray(SPEEDS) / pair.drive.servos.speed) ** 2)
    np.testing.assert_allclose(trained.rows["reward"], -np.sum(trained.rows["joints"] ** 2, axis=1) - price, atol=1e-6)
