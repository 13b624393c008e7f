"""The arm and the SO-101: tip, weight, aims, reward, score, and the names of what is true, by one table of both."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sim2real.robots.servo.task import ServoMoment
from sim2real.stages.load import load_module, load_robot

ARMS = {
    "arm": SimpleNamespace(there=(0.5, 0.4, 0.3), aim=(), plant="ArmPlant", more={}),
    "so101": SimpleNamespace(
        there=(0.5, -0.8, 1.0, -1.2, 0.3, 0.2),
        aim=(0.25,),
        plant="SO101Plant",
        more={"opening_off_rad": pytest.approx(0.05)},
    ),
}


@pytest.fixture(params=ARMS)
def of(request):
    """An arm: pipeline, robot, module, plant, and a pose at an aim."""
    pipeline, row = load_robot(request.param), ARMS[request.param]
    robot, module = pipeline, load_module(pipeline.name, "robot")
    there = np.array(row.there)
    plant = getattr(load_module(pipeline.name, "plant"), row.plant)()
    aim = np.array([*module.tip_of(there), *row.aim])
    return SimpleNamespace(robot=robot, module=module, plant=plant, there=there, aim=aim, more=row.more)


def scored(of, angles, aim):
    """Score joint angles ``(N, n)`` at 100 Hz, as a deployment has them."""
    states = {f"position[{i}]": angles[:, i] for i in range(angles.shape[1])}
    states |= {f"aim[{i}]": np.full(40, entry) for i, entry in enumerate(aim)}
    return of.robot.task.score(0.01 * np.arange(len(angles)), states)


def test_the_tip_is_where_mujoco_has_it(of):
    model = of.robot.model.model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for angles in (np.zeros(model.nq), *rng.uniform(-1.6, 1.6, (20, model.nq))):
        data.qpos[:] = angles
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.site("tip").xpos, of.module.tip_of(angles), atol=1e-12)
        of.plant.data.qpos[:] = angles
        np.testing.assert_allclose(
            [of.plant.state()[f"tip[{i}]"] for i in range(3)], of.module.tip_of(angles), atol=1e-12
        )
    many = rng.uniform(-1, 1, (4, 5, model.nq))
    np.testing.assert_allclose(of.module.tip_of(many)[2, 3], of.module.tip_of(many[2, 3]), rtol=1e-12)


def test_the_reward_is_highest_at_the_target_and_success_is_there(of):
    def judged(angles):
        now = ServoMoment(jnp.asarray(angles), jnp.zeros(len(angles)), jnp.asarray(of.aim))
        return float(of.module.reward(now)), bool(of.module.success(now))

    best, near, far = (judged(of.there + np.array([x, *[0.0] * (len(of.there) - 1)])) for x in (0.0, 0.05, 0.8))
    assert best[0] > near[0] > far[0]
    assert (best[1], far[1]) == (True, False)


def test_an_arm_that_arrives_and_stays_has_success(of):
    angles = np.tile(of.there, (401, 1))
    angles[:150, 0] += 0.6
    assert scored(of, angles, of.aim) == {
        "success": 1.0,
        "reached": 1.0,
        "distance_m": pytest.approx(0.0, abs=1e-7),
        "first_reached_s": pytest.approx(1.5),
        **of.more,
    }
    # One that passes by has the share of its time there, and one that never comes near has none.
    angles = np.tile(of.there + np.eye(len(of.there))[1] * 0.5, (401, 1))
    angles[200:250] = of.there
    score = scored(of, angles, of.aim)
    assert (score["success"], score["reached"]) == (pytest.approx(50 / 201), 0.0)
    assert score["first_reached_s"] == pytest.approx(2.0)
    score = scored(of, np.tile(of.there, (401, 1)), [1.0, 1.0, 1.0, *of.aim[3:]])
    assert (score["success"], score["reached"]) == (0.0, 0.0)
    assert np.isnan(score["first_reached_s"])


def test_aims_are_above_the_table_and_the_same_for_one_key(of):
    draw = of.robot.task.aim.draw
    targets = np.array([draw(jax.random.key(i)) for i in range(60)])
    assert targets[:, 2].min() > 0.1
    assert np.ptp(targets, axis=0).min() > 0.2
    np.testing.assert_array_equal(draw(jax.random.key(7)), draw(jax.random.key(7)))
    servos = of.robot.drive.servos
    assert np.all(np.array(of.module.LOW) >= servos.low)
    assert np.all(np.array(of.module.HIGH) <= servos.high)


def test_what_is_true_goes_by_the_same_names_and_lies_within_the_bounds(of):
    truth = of.plant.truth()
    assert set(truth) == {p.name for p in of.robot.model.dynamics()} == set(of.robot.nominal())
    for p in of.robot.model.dynamics():
        assert p.low < truth[p.name] < p.high, p.name
