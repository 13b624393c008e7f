"""Servos with a profile: on C MuJoCo against a rate limiter in numpy, and the same task on both engines."""

import numpy as np
import pytest
from small_robot import SHEET, PairTask, play_in_a_graph, play_on_c, world_params

from sim2real import composer
from sim2real.errors import UsageError
from sim2real.stages.pipeline.pipeline import load_pipeline

STEP_S = 0.005


def limited(goals, start, speed):
    """Return where a rate limiter is after each physics step, two of them a goal ``(2 T, n)``."""
    rows, here = [], np.asarray(start, float)
    for goal in np.repeat(goals, 2, axis=0):
        here = here + np.clip(goal - here, -speed * STEP_S, speed * STEP_S)
        rows.append(here)
    return np.array(rows)


def watched(task, goals, start):
    """Return references and controls of every physics step on C."""
    env = composer.Environment(task)
    env.reset()
    env.physics.bind(task.joints).qpos = start
    task.robot.initialize_episode(env.physics, None)
    seen = []
    env.add_extra_hook("after_substep", lambda p, _: seen.append((p.variables["reference"].copy(), p.control().copy())))
    for goal in goals:
        env.step(goal)
    return tuple(np.array(x) for x in zip(*seen, strict=True))


def test_references_are_a_rate_limiters_and_motors_get_their_mean_over_a_step():
    rng = np.random.default_rng(0)
    goals = np.repeat(rng.uniform(-0.6, 0.6, (8, 2)), 15, axis=0)
    start = np.array([0.2, -0.1])
    references, controls = watched(PairTask(), goals, start)
    expected = limited(goals, start, SHEET.profile_rad_s)
    np.testing.assert_allclose(references, expected, atol=1e-12)
    before = np.concatenate([start[None], expected[:-1]])
    share = (np.arange(2000) + 0.5) / 2000
    reach = SHEET.profile_rad_s * STEP_S * share[:, None, None]
    mean = before + np.clip(np.repeat(goals, 2, axis=0) - before, -reach, reach).mean(axis=0)
    np.testing.assert_allclose(controls, mean, atol=1e-7)
    assert np.abs(np.diff(references, axis=0)).max() <= SHEET.profile_rad_s * STEP_S + 1e-12
    arrived = np.abs(references - np.repeat(goals, 2, axis=0)) < 1e-12
    assert 0.2 < arrived.mean() < 0.9, "some goals are reached, and on the way they are not"


def test_without_a_profile_references_are_the_goals_at_once():
    goals = np.array([[0.5, -1.0], [-0.5, 1.0]])
    references, _ = watched(PairTask(profile_rad_s=float("inf")), goals, np.zeros(2))
    np.testing.assert_array_equal(references, np.repeat(goals, 2, axis=0))


def test_an_episode_begins_holding_the_joints_where_they_are():
    task = PairTask()
    env = composer.Environment(task)
    env.reset()
    physics = env.physics
    physics.bind(task.joints).qpos = [0.4, -0.3]
    task.robot.initialize_episode(physics, None)
    for name in ("goal", "reference"):
        assert physics.variables[name].tolist() == [0.4, -0.3]
    physics.bind(task.joints).qpos = [0.0, 0.0]
    assert physics.variables["reference"].tolist() == [0.4, -0.3], "a copy, which moving joints leave alone"


def test_torque_grows_with_the_error_and_ends_at_the_stall_torque():
    task = PairTask()
    env = composer.Environment(task)
    env.reset()
    gain = 1.4 / (885 / (1200 / 256) * 2 * np.pi / 4096)
    for error, torque in ((0.1, 0.1 * gain), (-0.25, -0.25 * gain), (0.5, 1.4), (-2.0, -1.4)):
        env.physics.set_control([error, error])
        env.physics.forward()
        assert env.physics.bind(task.robot.actuators).force == pytest.approx(torque)


@pytest.mark.night
def test_c_and_mjx_play_the_same_goals_alike(pair, played):
    _, positions, speeds, rewards = play_on_c(pair, played.params, played.goals)
    assert np.ptp(positions, axis=0).min() > 0.5
    np.testing.assert_allclose(played.later.position, positions, atol=2e-5)
    np.testing.assert_allclose(played.later.velocity, speeds, atol=5e-4)
    np.testing.assert_allclose(played.rewards, rewards, atol=5e-5)


@pytest.mark.night
def test_the_arm_moves_alike_on_c_and_on_mjx(arm):
    """It rubs, and its solver takes a single step. `make test` does so with the pair, in the test before."""
    robot = arm.load()
    goals = 0.8 * np.sin(6 * 0.01 * np.arange(50)[:, None] + np.arange(3)).astype(np.float32)
    target = np.array([0.2, 0.1, 0.25])
    params = world_params(robot, robot.nominal(), [0.1, 0.5, -0.3], [0.3, -1.0, 0.5], target)
    _, later, _, rewards = play_in_a_graph(robot.model.make_world())(params, goals)
    _, positions, speeds, expected = play_on_c(robot, params, goals)
    assert np.ptp(positions, axis=0).min() > 0.5
    np.testing.assert_allclose(later.position, positions, atol=1e-3)
    np.testing.assert_allclose(later.velocity, speeds, atol=0.05)
    np.testing.assert_allclose(rewards, expected, atol=1e-3)


@pytest.mark.night
def test_other_learners_see_the_joints_and_get_bounds_for_the_goals():
    """A composed task of servos, without its graph, for brax and gymnasium: what it shows, and what it may be told."""
    pytest.importorskip("gymnasium", reason="the extra interop")
    task = load_pipeline("arm").load().model.make_task()
    with pytest.raises(UsageError, match=r"Reach shows its policy nothing: no observable is enabled\. There are: '"):
        composer.MjxVectorEnv(composer.MjxEnvironment(task), 2)
    for observable in task.observables.values():
        observable.enabled = True
    env = composer.MjxVectorEnv(composer.MjxEnvironment(task), 2)
    shapes = {name.split("/")[-1]: space.shape for name, space in env.single_observation_space.items()}
    assert shapes == dict.fromkeys(("joint_positions", "joint_velocities", "target_position"), (1, 3))
    assert env.single_action_space.high.tolist() == pytest.approx([1.4, 1.4, 1.6])
    assert env.single_action_space.low.tolist() == pytest.approx([-1.4, -1.4, -1.6])
