"""A value function that sees more than the policy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import Coin, Constant

from sim2real.errors import Sim2RealError, UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.ppo.trainer import train
from sim2real.training.ppo.update import Normaliser, normalise_parameters, update_normaliser

CONFIG = PPOConfig(
    num_envs=64, minibatches=4, rollout_steps=16, total_steps=16_000, hidden=(16,), evaluations=1, eval_steps=20,
    gamma=0.9, reward_scale=0.5, gae_lambda=0.5,
)  # fmt: skip


@pytest.mark.night
def test_it_knows_what_the_policy_cannot_see():
    blind, seeing = (
        train(Coin(), dataclasses.replace(CONFIG, privileged=privileged), jax.random.key(0))
        for privileged in (False, True)
    )
    assert seeing.history["value_loss"][-1, 0] < 0.6 * blind.history["value_loss"][-1, 0]
    assert seeing.best.params[0][0].shape == blind.best.params[0][0].shape == (1, 16)


class Scalar(Coin):
    def privileged(self, state):
        return state["coin"]


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Constant(), "a Constant has no privileged entries"),
        (Scalar(), r"must return a vector, it has shape \(\)"),
    ],
)
def test_an_environment_that_shows_nothing_more_is_refused(env, message):
    with pytest.raises(UsageError, match=message):
        train(env, dataclasses.replace(CONFIG, privileged=True), jax.random.key(0))


class Infinite(Coin):
    def privileged(self, state):
        return jnp.stack([state["coin"], jnp.inf])


@pytest.mark.night
def test_what_is_no_number_is_named():
    config = dataclasses.replace(CONFIG, privileged=True, total_steps=1, num_envs=8, epochs=1)
    with pytest.raises(Sim2RealError, match=r"entries \[1\] of the privileged observation[\s\S]*privileged"):
        train(Infinite(), config, jax.random.key(0))


def test_parameters_of_any_size_are_told_apart():
    seen = np.array([[[1e-4, 5.0, 40.0], [1.02e-4, 5.0, 60.0]]], np.float32)
    blank = Normaliser(jnp.float32(0), jnp.zeros(3), jnp.ones(3))
    found = update_normaliser(blank, jnp.asarray(seen), jnp.ones((1, 2), bool))
    own = np.stack([normalise_parameters(found, x) for x in seen[0]])
    np.testing.assert_allclose(own[:, [0, 2]], [[-1, -1], [1, 1]], rtol=0.02)
    np.testing.assert_allclose(own[:, 1], 0.0, atol=0.01)
