"""The arm's geometry, parameters, aims and score; its embedded robot has tests of its own."""

import jax
import numpy as np
import pytest
from arm_conformance import ArmConformance, task_on_c

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
    return task_on_c(PIPELINE)


@pytest.fixture(scope="module")
def plant():
    """The embedded robot's physics."""
    return PLANT.ArmPlant()


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


class TestArm(ArmConformance):
    pipeline, there = PIPELINE, (0.5, 0.4, 0.3)

    def test_an_arm_that_passes_by_has_the_share_of_its_time_there(self):
        angles = np.tile(np.add(self.there, [0.0, 0.5, 0.0]), (401, 1))
        angles[200:250] = self.there
        aim = TASK.tip_of(np, np.array(self.there))
        score = self.score(angles, aim)
        assert score["success"] == pytest.approx(50 / 201)
        assert score["reached"] == 0.0
        assert score["distance_m"] == pytest.approx(np.linalg.norm(TASK.tip_of(np, angles[0]) - aim))
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
