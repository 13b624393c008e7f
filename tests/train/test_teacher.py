"""A teacher that sees what only simulation knows, and students that learn from it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import Bandit, Coin, Sign

from sim2real.errors import UsageError
from sim2real.train.config import PPOConfig
from sim2real.train.networks.normaliser import Normaliser, deviations
from sim2real.train.ppo.teacher import TeacherEnvironment, check_teacher
from sim2real.train.ppo.trainer import train

CONFIG = PPOConfig(
    num_envs=64, minibatches=4, rollout_steps=16, total_steps=16_000, hidden=(16,), evaluations=1, eval_steps=20,
    gamma=0.1, reward_scale=1.0, learning_rate=1e-2,
)  # fmt: skip


@pytest.fixture(scope="module")
def teacher():
    return train(Sign(), dataclasses.replace(CONFIG, teacher=True), jax.random.key(0))


@pytest.fixture(scope="module")
def student(teacher):
    config = dataclasses.replace(CONFIG, network="gru", total_steps=30_000, squash=False)
    return train(Sign(), config, jax.random.key(1), teacher=teacher.best)


def test_a_teacher_sees_what_the_policy_cannot(teacher):
    assert teacher.history["success"][-1, 0] > 0.95
    assert teacher.best.spec.privileged == 1
    assert teacher.best.mean.shape == (3,)


@pytest.mark.night
def test_a_student_learns_from_it_what_a_robot_shows(student):
    assert student.history["success"][-1, 0] > 0.9
    assert student.history["imitation_error"][-1, 0] < 0.25
    assert student.best.spec.privileged == 0
    assert student.best.mean.shape == (2,)


@pytest.mark.night
def test_its_noise_becomes_what_it_cannot_tell(student):
    error = student.history["imitation_error"][-1, 0]
    assert float(jnp.exp(student.best.log_std[0])) == pytest.approx(error, rel=0.5)


def test_parameters_of_any_size_are_told_apart():
    found = deviations(Normaliser(jnp.float32(1), jnp.array([0.0, 1e-4]), jnp.array([1.0, 1e-12])), 1)
    np.testing.assert_allclose(found, [1.0, 1e-6], rtol=0.01)


def test_what_is_no_teacher_here_is_refused(teacher, student):
    with pytest.raises(UsageError, match=r"network 'gru' remembers[\s\S]*hint: train the teacher with"):
        check_teacher(Sign(), CONFIG, student.best)
    with pytest.raises(UsageError, match=r"a student observes only what a robot[\s\S]*hint: .*without --ppo.teacher"):
        check_teacher(Sign(), dataclasses.replace(CONFIG, teacher=True), teacher.best)
    with pytest.raises(UsageError, match=r"the teacher observes 3 entries, 1 of them .* here it is 3, 2,"):
        check_teacher(Coin(), CONFIG, teacher.best)
    with pytest.raises(UsageError, match="a Bandit has no privileged entries"):
        TeacherEnvironment(Bandit())
