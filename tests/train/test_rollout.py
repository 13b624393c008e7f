"""Where episodes start, end and start again."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import Counter

from sim2real.training.config import PPOConfig
from sim2real.training.networks.architectures import MLP, init_mlp
from sim2real.training.networks.policy import Policy
from sim2real.training.ppo.rollout import Copies, collect, evaluate


@pytest.fixture(scope="module")
def config():
    return PPOConfig(num_envs=8, minibatches=1, rollout_steps=12, eval_steps=16, reward_scale=0.5)


@pytest.fixture(scope="module")
def policy():
    one = np.ones(1, np.float32)
    return Policy(init_mlp(np.random.default_rng(0), (1, 4, 1), 1.0), 0 * one, 0 * one, one, -one, one, MLP((4, 1)))


@pytest.fixture(scope="module")
def rows(config, policy):
    blank = Copies({"start": jnp.zeros(8), "row": jnp.zeros(8, jnp.int32)}, jnp.full((8, 1), -1.0))
    play = jax.jit(lambda copies, update, key: collect(Counter(length=5), config, policy, copies, update, key))
    copies, first = play(blank, jnp.int32(0), jax.random.key(0))
    _, second = play(copies, jnp.int32(1), jax.random.key(1))
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), first, second)


def test_the_first_rollout_replaces_the_blank_copies(rows):
    starts = rows.observation[0, :, 0]
    assert (starts >= 0).all()
    assert len(set(starts)) > 4
    assert (rows.reward == 1.0).all()


def test_first_episodes_are_cut_at_staggered_rows(rows):
    ended_at, copies = np.nonzero(rows.truncated)
    assert dict(zip(copies.tolist(), (ended_at + 1).tolist(), strict=True)) == {i: 1 + 2 * i for i in range(8)}


def test_the_final_observation_is_kept_and_the_next_one_is_a_start(rows):
    end = (rows.terminated | rows.truncated)[:-1]
    after, final = rows.observation[1:, :, 0], rows.following[:-1, :, 0]
    assert end.any()
    assert (after[end] % 100 == 0).all()
    assert (final[end] % 100 > 0).all()
    np.testing.assert_array_equal(after[~end], final[~end])
    assert set(np.unique(rows.observation % 100)) <= set(range(5))


def test_evaluation_counts_one_episode_per_copy(config, policy):
    values = jax.jit(lambda key: evaluate(Counter(length=5), config, policy, key))(jax.random.key(0))
    assert values == {"return": 10.0, "rows": 5.0, "finished": 1.0, "terminated": 1.0}
