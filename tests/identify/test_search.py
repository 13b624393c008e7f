"""The search: finds what there is to find, and says when there is nothing."""

import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.identify.search import cma_es


def bowl(candidates, mean):
    del mean
    return 1.0 + jnp.sum((candidates - jnp.array([1.0, -2.0])) ** 2 * jnp.array([1.0, 30.0]), axis=1)


def test_a_bowls_bottom_is_found_and_reported():
    told = []
    found = cma_es(bowl, np.zeros(2), 16, 60, seed=1, on_generations=lambda n, best: told.append((n, best)))
    np.testing.assert_allclose(found.z, [1.0, -2.0], atol=0.02)
    assert found.loss == pytest.approx(1.0, abs=1e-3)
    assert np.all(np.diff(found.history) <= 0)
    assert found.evaluations == 16 * len(found.history)
    assert sum(n for n, _ in told) == len(found.history)
    assert told[-1][1] == pytest.approx(found.loss)


def test_one_seed_one_result():
    first, again = (cma_es(bowl, np.zeros(2), 8, 10, seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.z, again.z)


def test_candidates_that_cannot_be_simulated_lose():
    found = cma_es(lambda c, m: jnp.where(c[:, 0] > 1.0, jnp.nan, bowl(c, m)), np.zeros(2), 16, 40, seed=1)
    assert np.isfinite(found.loss)
    with pytest.raises(Sim2RealError, match="no candidate could be simulated"):
        cma_es(lambda c, m: jnp.full(len(c), jnp.nan), np.zeros(2), 8, 10, seed=1)
