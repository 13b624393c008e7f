"""Advantages against a loop in numpy that follows the definition."""

import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.training.ppo.losses import gae
from sim2real.training.ppo.rollout import Rows

GAMMA, LAMBDA = 0.9, 0.8


def slow(reward, terminated, truncated, valid, value, following, gamma, gae_lambda):
    """Return a copy's advantages: sums of discounted one-step errors, from each policy step to its episode's end."""
    rows = len(reward)
    advantages = np.full(rows, np.nan)
    for first in np.flatnonzero(valid):
        total, weight, t = 0.0, 1.0, int(first)
        while True:
            collected, baseline = reward[t], value[t]
            while not (terminated[t] or truncated[t]) and t + 1 < rows and not valid[t + 1]:
                t += 1
                collected += reward[t]
            over = terminated[t] or truncated[t] or t + 1 == rows
            after = (0.0 if terminated[t] else following[t]) if over else value[t + 1]
            total += weight * (collected + gamma * after - baseline)
            if over:
                break
            weight *= gamma * gae_lambda
            t += 1
        advantages[first] = total
    return advantages


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
    empty, told = jnp.zeros((*shape, 0)), map(jnp.asarray, (reward, terminated, truncated, valid))
    rows = Rows(empty, empty, *told, following=empty, metrics={})
    found = np.asarray(gae(rows, jnp.asarray(value), jnp.asarray(following), GAMMA, LAMBDA))
    rows_of = [[a[:, i] for a in (reward, terminated, truncated, valid, value, following)] for i in range(shape[1])]
    expected = np.stack([slow(*copy, GAMMA, LAMBDA) for copy in rows_of], axis=1)
    assert terminated.any()
    assert truncated.any()
    np.testing.assert_allclose(found[valid], expected[valid], rtol=1e-4, atol=1e-5)
