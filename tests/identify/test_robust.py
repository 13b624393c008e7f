"""Robust losses: their closed forms, their slopes, and that nothing large ever pays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.identify.problem.robust import tamed

REACH = 2.5
CLOSED = {
    "squared": lambda r: 0.5 * r**2,
    "huber": lambda r: REACH**2 * (np.sqrt(1.0 + (r / REACH) ** 2) - 1.0),
    "cauchy": lambda r: 0.5 * REACH**2 * np.log1p((r / REACH) ** 2),
}
RESIDUALS = np.array([-40.0, -3.0, -2.5, -0.1, -1e-3, 0.0, 1e-4, 2e-3, 0.5, 2.5, 7.0, 1e4])


@pytest.mark.parametrize("loss", CLOSED)
def test_half_the_square_is_the_closed_form(loss):
    found = np.asarray(tamed(jnp.asarray(RESIDUALS, jnp.float32), loss, REACH), np.float64)
    np.testing.assert_allclose(0.5 * found**2, CLOSED[loss](RESIDUALS), rtol=1e-5, atol=1e-12)
    np.testing.assert_array_equal(np.sign(found), np.sign(RESIDUALS))


@pytest.mark.parametrize("loss", CLOSED)
def test_slopes_are_finite_everywhere_and_one_at_zero(loss):
    slope = jax.vmap(jax.grad(lambda r: tamed(r, loss, REACH)))
    points = np.array([0.0, 1e-30, -1e-8, 1e-4, 2.4e-3, 2.6e-3, 0.3, 3.0, 100.0])
    found = np.asarray(slope(jnp.asarray(points, jnp.float32)), np.float64)
    assert found[0] == 1.0
    assert np.all(found > 0.0)
    root = lambda r: np.sign(r) * np.sqrt(2.0 * CLOSED[loss](r))  # noqa: E731
    for r, s in list(zip(points, found, strict=True))[6:]:
        assert s == pytest.approx((root(r * (1 + 1e-5)) - root(r * (1 - 1e-5))) / (2e-5 * r), rel=1e-4)


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_one_large_residual_costs_little_more_than_its_size(loss):
    square, robust = 0.5 * 1e4**2, 0.5 * float(tamed(jnp.float32(1e4), loss, REACH)) ** 2
    assert robust < 1e-3 * square


@pytest.mark.parametrize("loss", CLOSED)
def test_no_residual_is_too_large_to_count(loss):
    sizes = 10.0 ** np.arange(0, 38, dtype=np.float64)
    found = 0.5 * np.asarray(tamed(jnp.asarray(sizes, jnp.float32), loss, REACH), np.float64) ** 2
    finite = np.isfinite(found)
    assert finite[:18].all()
    assert np.all(np.diff(found[finite]) > 0)  # what overflows is no number, and loses in the search
