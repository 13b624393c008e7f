"""Training on problems whose answer is known."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import Bandit, Coin, Constant

from sim2real.errors import Sim2RealError, UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.environment.protocol import check_environment
from sim2real.training.ppo.trainer import train
from sim2real.training.ppo.update import Normaliser, keys, normalise_parameters, update_normaliser

SMALL = PPOConfig(
    num_envs=64, minibatches=4, rollout_steps=16, total_steps=40_000, hidden=(32,), evaluations=4, eval_steps=20,
    gamma=0.9, reward_scale=0.5,
)  # fmt: skip
TINY = dataclasses.replace(SMALL, total_steps=1, hidden=(4,), evaluations=1, epochs=1, minibatches=1)


@pytest.fixture(scope="module")
def bandit():
    reports = []
    config = dataclasses.replace(SMALL, num_seeds=2, rollout_steps=8, reward_scale=1.0)
    return train(Bandit(), config, jax.random.key(0), reports.append), reports, config


def test_bandit_finds_the_best_action(bandit):
    result, reports, config = bandit
    observations = jax.random.uniform(jax.random.key(5), (200, 2), minval=-1.0)
    found = jax.vmap(result.best.get_action)(observations)
    wanted = jax.vmap(Bandit().best)(observations)
    assert result.history["success"][-1].min() > 0.95
    assert (np.abs(found - wanted) < np.array([[0.3, 0.75]])).mean() > 0.95
    # Progress comes after every evaluation.
    assert [report.evaluation for report in reports] == [1, 2, 3, 4]
    assert [report.env_steps for report in reports] == result.env_steps.tolist()
    assert result.env_steps[-1] >= config.total_steps
    assert (np.diff(result.elapsed_s) > 0).all()
    for name in ("return", "success", "finished", "policy_loss", "value_loss", "entropy", "kl", "reward"):
        assert result.history[name].shape == (4, 2)
    # The best policy is one that was evaluated.
    assert result.best.log_std.shape == (2,)
    assert result.policies.log_std.shape == (2, 2)
    success, returns = result.history["success"], result.history["return"]
    assert returns[-1].mean() > returns[0].mean()
    best = returns[:, result.best_seed][success[:, result.best_seed] == success.max()]
    assert best.max() == returns[success == success.max()].max()


@pytest.mark.night
def test_a_seed_does_not_depend_on_its_neighbours(bandit):
    result, _, config = bandit
    alone = train(Bandit(), dataclasses.replace(config, num_seeds=1), jax.random.key(0))
    for name in ("return", "value_loss", "entropy"):
        np.testing.assert_allclose(alone.history[name][:, 0], result.history[name][:, 0], rtol=2e-2, atol=1e-3)
    assert not np.allclose(result.history["entropy"][-1, 0], result.history["entropy"][-1, 1])


def test_no_key_is_used_twice():
    """To play, to shuffle and to evaluate, in every update: however often one evaluates."""
    made = [keys(SimpleNamespace(key=jax.random.key(3), update=jnp.int32(i))) for i in range(5)]
    data = np.asarray(jax.random.key_data(jnp.concatenate(made)))
    assert len(np.unique(data, axis=0)) == 15


def blind_value(length, window, gamma):
    """Return the value of an episode of ``length`` rewards of 1 to a network that cannot tell its rows apart.

    The mean over the rows of a rollout, up to ``window`` from its end, where the sum goes on with the value itself.
    """
    cells = [(left, to_end) for to_end in range(1, window + 1) for left in range(1, length + 1)]
    rewards = np.mean([sum(gamma**i for i in range(min(cell))) for cell in cells])
    return rewards / (1.0 - np.mean([gamma**to_end * (left > to_end) for left, to_end in cells]))


@pytest.mark.night  # the advantages of all three are exact in test_gae.py, and rows in test_rollout.py
@pytest.mark.parametrize(
    ("env", "value"),
    [
        pytest.param(Constant(ends="truncated"), 10.0, id="truncation goes on for ever"),
        pytest.param(Constant(ends="truncated", rows_per_step=2), 10.0, id="rows without a policy step"),
        pytest.param(Constant(ends="terminated"), blind_value(8, 16, 0.9), id="termination"),
    ],
)
def test_value_of_a_constant_reward(env, value):
    result = train(env, dataclasses.replace(SMALL, gae_lambda=1.0), jax.random.key(0))
    assert result.history["value"][-1, 0] == pytest.approx(value, rel=0.05)
    assert result.history["return"][-1, 0] == pytest.approx(8.0)
    assert result.history["policy_steps"][-1, 0] == 8.0


class Scalar(Coin):
    def privileged(self, state):
        return state["coin"]


class Infinite(Coin):
    def privileged(self, state):
        return jnp.stack([state["coin"], jnp.inf])


@pytest.mark.parametrize(
    ("env", "change", "message"),
    [
        (Constant(nan_at=3, wrong="observation"), {}, r"entries \[0\] of the observation are not finite \(seed 0"),
        pytest.param(Constant(nan_at=3, wrong="reward"), {}, "the reward is not finite", marks=pytest.mark.night),
        pytest.param(
            Infinite(), {"privileged": True}, r"entries \[1\] of the privileged observation", marks=pytest.mark.night
        ),
        pytest.param(
            Constant(),
            {"learning_rate": 1e38, "epochs": 4},
            "training's .*loss.* is not finite",
            marks=pytest.mark.night,
        ),
        (Constant(length=50), {}, "no evaluation episode ended within eval_steps=20 rows"),
        (Constant(), {"target": 0.5}, r"target=0.5 is a share of success.*\['policy_steps'\]"),
        (Constant(), {"privileged": True}, "a Constant has no privileged entries"),
        (Scalar(), {"privileged": True}, r"must return a vector, it has shape \(\)"),
    ],
)
def test_what_cannot_be_trained_is_named(env, change, message):
    with pytest.raises(Sim2RealError, match=message) as error:
        train(env, dataclasses.replace(TINY, **change), jax.random.key(0))
    assert error.value.hint or isinstance(env, Scalar)


class Broken(Constant):
    def __init__(self, low=-1.0, **changes):
        super().__init__()
        self.action_low, self.changes = np.array([low], np.float32), changes

    def step(self, state, action, key):
        return super().step(state, action, key)._replace(**self.changes)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Broken(low=np.nan), "action bounds must be two finite vectors"),
        (Broken(low=1.0), "low < high"),
        (Broken(observation=np.zeros(3, np.float32)), r"step's observation has shape \(3,\).*observation_size is 1"),
        (Broken(reward=np.zeros(1, np.float32)), r"step's reward must be a number of shape \(\)"),
        (Broken(terminated=np.float32(0)), r"step's terminated must be a bool"),
        (Broken(metrics={"x": np.zeros(2)}), r"step's metrics\['x'\] must be a number"),
        (Broken(state={"row": np.int32(0)}), "states of different structure"),
        (Broken(state={"row": np.float32(0), "acted": np.float32(0)}), r"state\['row'\] is int32 .* float32"),
    ],
)
def test_a_broken_environment_is_refused_before_compiling(env, message):
    with pytest.raises(UsageError, match=message):
        check_environment(env)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_envs": 0}, "num_envs must be an integer of at least 1"),
        ({"minibatches": 7}, r"minibatches=7 does not divide num_envs=64[\s\S]*hint: .*1, 2, 4"),
        ({"learning_rate": -1.0}, "learning_rate must be above 0"),
        ({"learning_rate": float("nan")}, "learning_rate must be finite"),
        ({"gamma": 1.5}, r"gamma must lie in \[0, 1\]"),
        ({"entropy_coef": -0.1}, "entropy_coef must be at least 0"),
        ({"hidden": (0,)}, "hidden must hold integers"),
        ({"schedule": "cosine"}, "schedule must be 'linear' or 'adaptive'"),
        ({"target_kl": 0.0}, "target_kl must be above 0"),
        ({"target": 95.0}, r"target must lie in \(0, 1\], got 95"),
        ({"minutes": 0.0}, "minutes must be above 0, got 0"),
        ({"eval_envs": 65}, "eval_envs must lie in 1 to num_envs=64, got 65"),
        ({"eval_envs": 0}, "eval_envs must lie in 1 to num_envs=64, got 0"),
    ],
)
def test_impossible_settings_are_refused(change, message):
    with pytest.raises(UsageError, match=message):
        dataclasses.replace(SMALL, **change)


@pytest.mark.night
def test_training_ends_where_the_best_seed_reaches_the_target(bandit):
    full, _, config = bandit
    at = int(np.flatnonzero(full.history["success"].max(1) >= 0.5)[0])
    assert at + 1 < config.evaluations, "the bandit learns too slowly for this test"
    found = train(Bandit(), dataclasses.replace(config, target=0.5), jax.random.key(0))
    assert found.env_steps.tolist() == full.env_steps[: at + 1].tolist()
    np.testing.assert_array_equal(found.history["success"], full.history["success"][: at + 1])


@pytest.mark.night
def test_evaluations_of_few_copies_judge_the_same_policies(bandit):
    full, _, config = bandit
    found = train(Bandit(), dataclasses.replace(config, eval_envs=16), jax.random.key(0))
    # The training is the same; each evaluation plays 16 episodes, so its success is a multiple of 1/16.
    np.testing.assert_array_equal(found.policies.log_std, full.policies.log_std)
    np.testing.assert_array_equal(found.history["policy_loss"], full.history["policy_loss"])
    assert np.allclose(found.history["success"] * 16 % 1, 0.0)
    assert found.history["success"][-1].min() > 0.9


@pytest.mark.night
def test_a_caller_or_a_time_limit_ends_the_training():
    kept = []

    def stop(progress):
        kept.append(progress.best)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(Bandit(), SMALL, jax.random.key(0), stop)
    assert len(train(Bandit(), dataclasses.replace(SMALL, minutes=1e-6), jax.random.key(0)).env_steps) == 1
    assert kept[0].get_action(jnp.zeros(2)).shape == (2,)


@pytest.mark.night
def test_a_privileged_value_function_knows_what_the_policy_cannot_see():
    config = dataclasses.replace(SMALL, num_envs=64, total_steps=16_000, hidden=(16,), evaluations=1, gae_lambda=0.5)
    blind, seeing = (
        train(Coin(), dataclasses.replace(config, privileged=privileged), jax.random.key(0))
        for privileged in (False, True)
    )
    assert seeing.history["value_loss"][-1, 0] < 0.6 * blind.history["value_loss"][-1, 0]
    assert seeing.best.params[0][0].shape == blind.best.params[0][0].shape == (1, 16)


def test_parameters_of_any_size_are_told_apart():
    seen = np.array([[[1e-4, 5.0, 40.0], [1.02e-4, 5.0, 60.0]]], np.float32)
    blank = Normaliser(jnp.float32(0), jnp.zeros(3), jnp.ones(3))
    found = update_normaliser(blank, jnp.asarray(seen), jnp.ones((1, 2), bool))
    own = np.stack([normalise_parameters(found, x) for x in seen[0]])
    np.testing.assert_allclose(own[:, [0, 2]], [[-1, -1], [1, 1]], rtol=0.02)
    np.testing.assert_allclose(own[:, 1], 0.0, atol=0.01)
