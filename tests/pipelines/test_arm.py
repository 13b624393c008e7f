"""The arm's geometry, parameters, aims and score; its embedded robot has tests of its own."""

import jax
import mujoco
import numpy as np
import pytest

from sim2real import composer
from sim2real.stages.pipeline.pipeline import load_pipeline

PIPELINE = load_pipeline("arm")
ROBOT, TASK, PLANT = PIPELINE.load(), PIPELINE.load("task"), PIPELINE.load("plant")
VALUES = {
    "gain": 2.5, "damping": 0.3, "armature": 0.006, "friction_pan": 0.04, "friction_shoulder": 0.05,
    "friction_elbow": 0.02, "payload": 0.05,
}  # fmt: skip
STEP_S = 0.0025


@pytest.fixture(scope="module")
def env():
    """The task on C, which draws no targets."""
    env = composer.Environment(ROBOT.model.make_task())
    env.reset()
    return env


def test_the_tip_is_where_mujoco_has_it(env):
    task, physics = env.task, env.physics
    rng = np.random.default_rng(0)
    plant = PLANT.ArmPlant()
    for angles in (np.zeros(3), *rng.uniform(-1.6, 1.6, (20, 3))):
        physics.bind(task.joints).qpos = angles
        physics.forward()
        tip = TASK.tip_of(np, angles)
        np.testing.assert_allclose(physics.bind(task.robot.tip).xpos, tip, atol=1e-12)
        plant.data.qpos[:] = angles
        np.testing.assert_allclose([plant.state()[f"tip[{i}]"] for i in range(3)], tip, atol=1e-12)
    many = rng.uniform(-1, 1, (4, 5, 3))
    np.testing.assert_array_equal(TASK.tip_of(np, many)[2, 3], TASK.tip_of(np, many[2, 3]))


def test_model_and_embedded_robot_weigh_the_same(env):
    """The plant's geometry is written down a second time: gravity and inertia at random angles."""
    plant, physics = PLANT.ArmPlant(armature=1.0), env.physics
    model, data = physics.model.ptr, physics.data.ptr
    for angles in np.random.default_rng(1).uniform(-1.4, 1.4, (5, 3)):
        for m, d in ((model, data), (plant.model, plant.data)):
            d.qpos[:], d.qvel[:] = angles, 0.0
            mujoco.mj_forward(m, d)
        np.testing.assert_allclose(data.qfrc_bias, plant.data.qfrc_bias, atol=1e-10)
        inertias = []
        for m, d in ((model, data), (plant.model, plant.data)):
            inertias.append(np.zeros((3, 3)))
            for row, unit in zip(inertias[-1], np.eye(3), strict=True):
                mujoco.mj_mulM(m, d, row, unit)
        np.testing.assert_allclose(*inertias, atol=1e-10)


def test_parameters_stand_where_c_keeps_them(env):
    task, physics = env.task, env.physics
    aim = np.array([0.1, -0.05, 0.3])
    before = {n: np.array(getattr(physics.bind(e), a)) for n, (e, a) in ROBOT.model.fields(task).items()}
    placed = ROBOT.model.place(VALUES, aim)
    for name, (elements, attribute) in ROBOT.model.fields(task).items():
        assert np.shape(placed[name]) == before[name].shape, name
        setattr(physics.bind(elements), attribute, np.asarray(placed[name]))
    model = physics.model.ptr
    full_rad = 885 / (800 / 256) * 2 * np.pi / 4096
    np.testing.assert_allclose(model.dof_damping, 0.3, rtol=1e-6)
    np.testing.assert_allclose(model.dof_armature, 0.006 - 0.5 * STEP_S * 0.3, rtol=1e-5)
    np.testing.assert_allclose(model.dof_frictionloss, [0.04, 0.05, 0.02], rtol=1e-6)
    np.testing.assert_allclose(model.actuator_forcerange, [[-2.5 * full_rad, 2.5 * full_rad]] * 3, rtol=1e-5)
    physics.bind(task.joints).qpos = [0.1, -0.2, 0.3]
    physics.set_control([0.3, 0.2, -0.4])
    physics.forward()
    torque = np.clip(2.5 * (np.array([0.3, 0.2, -0.4]) - [0.1, -0.2, 0.3]), -2.5 * full_rad, 2.5 * full_rad)
    np.testing.assert_allclose(physics.bind(task.robot.actuators).force, torque, rtol=1e-5)
    gap = np.linalg.norm(TASK.tip_of(np, np.array([0.1, -0.2, 0.3])) - aim)
    assert task.distance(physics) == pytest.approx(gap, rel=1e-5)
    for name, (elements, attribute) in ROBOT.model.fields(task).items():
        setattr(physics.bind(elements), attribute, before[name])


def test_nominal_values_are_the_data_sheets_and_no_delays():
    nominal = ROBOT.nominal()
    assert set(nominal) == set(VALUES)
    assert nominal["gain"] == pytest.approx(1.4 / (885 / (800 / 256) * 2 * np.pi / 4096), rel=1e-6)
    assert (nominal["damping"], nominal["armature"], nominal["friction_pan"]) == (0.23, 0.0045, 0.03)
    assert set(PLANT.ArmPlant().truth()) == set(nominal), "what is true goes by the same names"
    for p in ROBOT.model.dynamics():
        assert p.low < PLANT.ArmPlant().truth()[p.name] < p.high


def test_aims_can_be_reached():
    targets = np.array([ROBOT.task.aim.draw(jax.random.key(i)) for i in range(60)])
    from_shoulder = targets - np.array([0, 0, 0.37])
    out = np.linalg.norm(targets[:, :2], axis=1)
    reach = np.hypot(out - 0.04, from_shoulder[:, 2])
    assert np.all((reach < 0.24) | (out < 0.04))
    assert targets[:, 2].min() > 0.1
    np.testing.assert_array_equal(ROBOT.task.aim.draw(jax.random.key(7)), ROBOT.task.aim.draw(jax.random.key(7)))


def trajectory(angles, target):
    """Return times and states for joint angles ``(N, 3)`` at 100 Hz, as a deployment has them."""
    states = {f"position[{i}]": angles[:, i] for i in range(3)}
    return 0.01 * np.arange(len(angles)), {**states, **{f"aim[{i}]": np.full(40, target[i]) for i in range(3)}}


def test_the_score_of_an_arm_that_arrives_and_stays():
    there = np.array([0.5, 0.4, 0.3])
    angles = np.tile(there, (401, 1))
    angles[:150] += [0.6, 0.0, 0.0]
    score = ROBOT.task.score(*trajectory(angles, TASK.tip_of(np, there)))
    assert score == {
        "success": 1.0,
        "reached": 1.0,
        "distance_m": pytest.approx(0.0, abs=1e-12),
        "first_reached_s": pytest.approx(1.5),
    }


def test_the_score_of_an_arm_that_passes_by():
    there = np.array([0.5, 0.4, 0.3])
    angles = np.tile(there + np.array([0.0, 0.5, 0.0]), (401, 1))
    angles[200:250] = there
    score = ROBOT.task.score(*trajectory(angles, TASK.tip_of(np, there)))
    off = np.linalg.norm(TASK.tip_of(np, angles[0]) - TASK.tip_of(np, there))
    assert score["success"] == pytest.approx(50 / 201)
    assert score["reached"] == 0.0
    assert score["distance_m"] == pytest.approx(off)
    assert score["first_reached_s"] == pytest.approx(2.0)


def test_a_task_that_draws_its_target_draws_one_that_can_be_reached():
    env = composer.Environment(TASK.Reach(), random_state=0)
    targets = []
    for _ in range(5):
        env.reset()
        targets.append(env.physics.bind(env.task.gantry.target).xpos.copy())
    assert np.ptp(targets, axis=0).min() > 0.01
    assert np.isinf(env.physics.variables["distance"])
    reward = env.step(np.zeros(3)).reward
    distance = env.physics.variables["distance"]
    expected = np.exp(-((distance / 0.1) ** 2)) + np.exp(-((distance / 0.02) ** 2)) - 2 * distance
    assert reward == pytest.approx(expected)
