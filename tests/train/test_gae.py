"""Advantages against a loop in numpy that follows the definition."""

import jax.numpy as jnp
import numpy as np
import pytest
from advantages import slow

from sim2real.training.ppo.losses import gae
from sim2real.training.ppo.rollout import Rows

GAMMA, LAMBDA = 0.9, 0.8


def make_rows(reward, terminated, truncated, valid):
    empty = jnp.zeros((*reward.shape, 0))
    return Rows(empty, empty, *map(jnp.asarray, (reward, terminated, truncated, valid)), following=empty, metrics={})


@pytest.mark.parametrize("valid_share", [1.0, 0.6])
def test_gae_equals_the_definition(valid_share):
    rng = np.random.default_rng(0)
    shape = (40, 30)
    reward, value, following = rng.normal(size=(3, *shape)).astype(np.float32)
    terminated, truncated = rng.random((2, *shape)) < 0.06
    valid = rng.random(shape) < valid_share
    # An observation that is not final is the one that the next row starts from, as is its value.
    inside = ~(terminated | truncated)[:-1]
    following[:-1][inside] = value[1:][inside]
    # In rows without a policy step the observation is that of the step to come, as is its value.
    for t in range(shape[0] - 2, -1, -1):
        pending = ~valid[t + 1] & inside[t]
        following[t][pending] = following[t + 1][pending]
    rows = make_rows(reward, terminated, truncated, valid)
    found = np.asarray(gae(rows, jnp.asarray(value), jnp.asarray(following), GAMMA, LAMBDA))
    rows_of = [[a[:, i] for a in (reward, terminated, truncated, valid, value, following)] for i in range(shape[1])]
    expected = np.stack([slow(*copy, GAMMA, LAMBDA) for copy in rows_of], axis=1)
    assert terminated.any()
    assert truncated.any()
    np.testing.assert_allclose(found[valid], expected[valid], rtol=1e-4, atol=1e-5)


def test_termination_is_worth_nothing_and_truncation_its_final_observation():
    flags = np.array([[False, True]])
    rows = make_rows(np.ones((1, 2), np.float32), ~flags, flags, np.ones((1, 2), bool))
    found = gae(rows, jnp.array([[2.0, 2.0]]), jnp.array([[7.0, 7.0]]), GAMMA, LAMBDA)
    np.testing.assert_allclose(found, [[1.0 - 2.0, 1.0 + GAMMA * 7.0 - 2.0]], rtol=1e-6)


def test_a_row_without_a_policy_step_adds_its_reward_undiscounted():
    reward = np.array([[1.0], [10.0], [100.0]], np.float32)
    no = np.zeros((3, 1), bool)
    rows = make_rows(reward, no, no, np.array([[True], [False], [True]]))
    found = gae(rows, jnp.zeros((3, 1)), jnp.zeros((3, 1)), GAMMA, LAMBDA)
    assert found[0, 0] == pytest.approx(11.0 + GAMMA * LAMBDA * 100.0)
    assert found[2, 0] == pytest.approx(100.0)
