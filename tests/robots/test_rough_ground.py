"""Rough ground of a walking robot: heights, the ground of a training, and a twin on it."""

import mujoco
import numpy as np
import pytest

from pipelines.go2.robot import ROBOT
from sim2real import composer
from sim2real.emulation.body import Terrain
from sim2real.errors import UsageError
from sim2real.robots.training import training_loop
from sim2real.robots.walking.twin import Twin
from sim2real.robots.walking.world import ROUGHNESS, Ground

SMALL = Terrain(most_m=0.06, cell_m=0.2, length_m=4.0)


def below(model, data, places):
    """Return the height of the first thing below each place, by MuJoCo's own rays [m]."""
    down, hit = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    return [5.0 - mujoco.mj_ray(model, data, np.array([*p, 5.0]), down, None, 1, -1, hit) for p in places]


@pytest.fixture(scope="module")
def twin():
    return Twin(ROBOT, seed=1, roughness_m=0.04)


def test_heights_of_the_ground_are_those_that_rays_find(twin):
    places = np.random.default_rng(0).uniform(-20.0, 20.0, (200, 2))
    places = places[np.linalg.norm(places, axis=1) > 1.0]  # not on the robot
    np.testing.assert_allclose(twin._rough.at(places), below(twin.model, twin.data, places), atol=1e-6)
    assert (twin._rough.heights.min(), twin._rough.heights.max()) == pytest.approx((0.0, 0.04))


def test_the_ground_of_a_training_has_the_roughness_of_each_start():
    field = SMALL.growing()
    columns = field.heights.shape[1]
    x = (np.arange(columns) - (columns - 1) / 2) * SMALL.cell_m
    for roughness in (0.0, 0.03, 0.06):
        near = field.heights[:, np.abs(x - SMALL.start_m(roughness)) < 0.15]
        assert np.ptp(near) == pytest.approx(roughness, abs=0.003)


def test_feet_touch_the_ground_that_is_below_them():
    """In C MuJoCo, by the composed task that a training uses: its heights are MuJoCo's, and so is the contact."""
    task = Ground(ROBOT.mjcf, ROBOT.feet, ROBOT.touching_m, ROBOT.feet, SMALL.growing())
    environment = composer.Environment(task)
    environment.reset()
    physics, robot = environment.physics, task.base.full_identifier
    data = physics.data.ptr
    data.qpos[:3] = SMALL.start_m(0.06), 0.0, 0.42
    data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
    data.qpos[7:], data.ctrl[:] = ROBOT.stance, ROBOT.stance
    air = []
    for _ in range(200):
        environment.step(np.array(ROBOT.stance))
        air.append(physics.variables["air_s"] > 0)
    assert air[5].all(), "it falls from 9 cm"
    assert not air[-1].any(), "it stands on four feet"
    model = physics.model.ptr
    feet = physics.variables["at_m"]
    field = task.rough
    assert np.ptp(field.at(feet[:, :2])) > 0.005, "no two feet stand at one height"
    assert model.nhfield == 1
    np.testing.assert_allclose(feet[:, 2] - field.at(feet[:, :2]), 0.022, atol=0.004)
    assert model.body(robot).name


@pytest.mark.night
def test_a_training_without_roughness_has_a_flat_floor():
    values = ROBOT.nominal()
    kinds = []
    for draws in ({}, {ROUGHNESS: np.linspace(0.02, 0.04, 3)}):
        nodes, task = training_loop(ROBOT, values, draws, {}, True)
        start = task.robot.model.params({**values, ROUGHNESS: 0.04}, task.robot.task.at_rest(0))
        kinds.append((int(nodes["world"].environment.model.geom("floor").type[0]), start.qpos[:3].tolist()))
    plane, field = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD)
    assert kinds[0] == (plane, pytest.approx([0.0, 0.0, 0.33]))
    assert kinds[1] == (field, pytest.approx([ROBOT.terrain.start_m(0.04), 0.0, 0.37]))


@pytest.mark.parametrize("bumps_m", [[0.0, 0.2], [-0.01, 0.04]])
def test_roughness_that_the_ground_does_not_have_is_refused(bumps_m):
    with pytest.raises(UsageError, match=r"roughness must lie in \[0, 0.08\] m, got "):
        training_loop(ROBOT, ROBOT.nominal(), {ROUGHNESS: np.array(bumps_m)}, {}, True)


def test_the_start_of_a_share_of_the_curriculum_has_slower_commands():
    start = ROBOT.task.at_rest(3)
    np.testing.assert_allclose(ROBOT.task.moved(start, 0.0, 0.0, 0.25).aim, 0.25 * np.asarray(start.aim))


@pytest.mark.parametrize("numbers", [{"most_m": 0.0}, {"cell_m": 2.0}, {"length_m": -1.0}])
def test_ground_that_cannot_be_is_refused(numbers):
    with pytest.raises(UsageError, match="terrain needs"):
        Terrain(**numbers)
