"""Tests of every arm whose geometry is written down twice: for its simulated world, and for its embedded robot."""

import mujoco
import numpy as np
import pytest

from sim2real import composer


class ArmConformance:
    """A module inherits it for its pipeline; its fixture ``env`` is the task on C, ``plant`` the embedded robot."""

    pipeline = None
    there = ()
    """Joint angles of an episode that arrives [rad]."""
    aim = ()
    """Entries of the aim after the tip."""
    scores = ()
    """Entries of the score besides those of all arms: names and values."""

    @property
    def robot(self):
        return self.pipeline.load()

    def tip_of(self, angles):
        return self.pipeline.load("task").tip_of(np, angles)

    def score(self, angles, aim):
        """Score joint angles ``(N, n)`` at 100 Hz, as a deployment has them."""
        states = {f"position[{i}]": angles[:, i] for i in range(angles.shape[1])}
        states |= {f"aim[{i}]": np.full(40, entry) for i, entry in enumerate(aim)}
        return self.robot.task.score(0.01 * np.arange(len(angles)), states)

    def test_the_tip_is_where_mujoco_has_it(self, env, plant):
        task, physics, n = env.task, env.physics, len(self.there)
        rng = np.random.default_rng(0)
        for angles in (np.zeros(n), *rng.uniform(-1.6, 1.6, (20, n))):
            physics.bind(task.joints).qpos = angles
            physics.forward()
            np.testing.assert_allclose(physics.bind(task.robot.tip).xpos, self.tip_of(angles), atol=1e-12)
            plant.data.qpos[:] = angles
            np.testing.assert_allclose([plant.state()[f"tip[{i}]"] for i in range(3)], self.tip_of(angles), atol=1e-12)
        many = rng.uniform(-1, 1, (4, 5, n))
        np.testing.assert_allclose(self.tip_of(many)[2, 3], self.tip_of(many[2, 3]), rtol=1e-12)

    def test_model_and_embedded_robot_weigh_the_same(self, env, plant):
        """Gravity and inertia at random angles, but for the rotors."""
        models = (env.physics.model.ptr, env.physics.data.ptr), (plant.model, plant.data)
        servos, n = self.robot.drive.servos, len(self.there)
        for angles in np.random.default_rng(1).uniform(servos.low, servos.high, (5, n)):
            bias, inertia = [], []
            for model, data in models:
                data.qpos[:], data.qvel[:] = angles, 0.0
                mujoco.mj_forward(model, data)
                bias.append(data.qfrc_bias.copy())
                inertia.append(np.zeros((n, n)))
                for row, unit in zip(inertia[-1], np.eye(n), strict=True):
                    mujoco.mj_mulM(model, data, row, unit)
                inertia[-1] -= np.diag(model.dof_armature)
            np.testing.assert_allclose(*bias, atol=1e-10)
            np.testing.assert_allclose(*inertia, atol=1e-10)

    def test_an_arm_that_arrives_and_stays_has_success(self):
        angles = np.tile(self.there, (401, 1))
        angles[:150, 0] += 0.6
        assert self.score(angles, [*self.tip_of(np.array(self.there)), *self.aim]) == {
            "success": 1.0,
            "reached": 1.0,
            "distance_m": pytest.approx(0.0, abs=1e-12),
            "first_reached_s": pytest.approx(1.5),
            **dict(self.scores),
        }

    def test_an_arm_that_never_comes_near_has_none(self):
        score = self.score(np.tile(self.there, (401, 1)), [1.0, 1.0, 1.0, *self.aim])
        assert (score["success"], score["reached"]) == (0.0, 0.0)
        assert np.isnan(score["first_reached_s"])


def task_on_c(pipeline):
    """Return the task on C MuJoCo, which draws no aims."""
    env = composer.Environment(pipeline.load().model.make_task())
    env.reset()
    return env
