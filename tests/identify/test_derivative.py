"""Derivatives that are not traced: finite differences, and a Jacobian that is kept."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.identify.config import FitConfig
from sim2real.identify.problem.derivative import finite_differences
from sim2real.identify.problem.residuals import SegmentResiduals

POINT = jnp.array([0.4, -0.7, 1.1])


def smooth(x):
    return jnp.stack([jnp.sin(x[0]) * x[1], jnp.exp(0.5 * x[2]), x[0] * x[1] * x[2], jnp.sum(x**2)])


def outside(x):
    """Return the same, computed by numpy."""

    def host(v):
        a, b, c = np.moveaxis(np.asarray(v, np.float64), -1, 0)
        return np.stack([np.sin(a) * b, np.exp(0.5 * c), a * b * c, a**2 + b**2 + c**2], axis=-1).astype(np.float32)

    shape = jax.ShapeDtypeStruct((4,), jnp.float32)
    return jax.pure_callback(host, shape, x, vmap_method="broadcast_all")


def test_finite_differences_are_the_derivative():
    np.testing.assert_array_equal(finite_differences(smooth)(POINT), smooth(POINT))
    np.testing.assert_allclose(
        jax.jacfwd(finite_differences(smooth))(POINT), jax.jacfwd(smooth)(POINT), rtol=2e-3, atol=1e-3
    )


@pytest.mark.parametrize("length", [1e-4, 1.0, 100.0])
def test_the_tangents_length_does_not_matter(length):
    direction = length * jnp.array([0.3, -1.0, 0.2])
    exact = jax.jvp(smooth, (POINT,), (direction,))[1]
    found = jax.jvp(finite_differences(smooth), (POINT,), (direction,))[1]
    np.testing.assert_allclose(found, exact, rtol=3e-3, atol=1e-3 * length)


def test_no_tangent_no_change():
    found = jax.jvp(finite_differences(smooth), (POINT,), (jnp.zeros(3),))[1]
    np.testing.assert_array_equal(found, np.zeros(4))


def test_a_callback_has_a_derivative_in_compiled_and_batched_programs():
    with pytest.raises(ValueError, match="JVP"):
        jax.jacfwd(outside)(POINT)
    jacobian = jax.jacfwd(finite_differences(outside))
    exact = jax.jacfwd(smooth)
    np.testing.assert_allclose(jax.jit(jacobian)(POINT), exact(POINT), rtol=2e-3, atol=1e-3)
    points = jnp.stack([POINT, 2 * POINT, -POINT])
    np.testing.assert_allclose(jax.jit(jax.vmap(jacobian))(points), jax.vmap(exact)(points), rtol=2e-3, atol=2e-3)
    push = jax.linearize(finite_differences(outside), POINT)[1]
    np.testing.assert_allclose(jax.vmap(push)(jnp.eye(3)).T, exact(POINT), rtol=2e-3, atol=1e-3)


def test_a_callback_can_be_differentiated_by_what_is_closed_over():
    """The residuals' sensitivities close over traced parameters and batched segments."""

    def slope(scale):
        return jax.jacfwd(finite_differences(lambda x: outside(x * scale)))(POINT)

    found = jax.jit(jax.vmap(slope))(jnp.array([1.0, 0.5]))
    exact = jnp.stack([jax.jacfwd(lambda x, s=s: smooth(x * s))(POINT) for s in (1.0, 0.5)])
    np.testing.assert_allclose(found, exact, rtol=2e-3, atol=1e-3)


@pytest.mark.parametrize(("step", "slope"), [(3e-3, 1.0), (0.5, 0.2)])
def test_a_wide_difference_looks_past_a_kink(step, slope):
    problem = SimpleNamespace(forward=False, config=FitConfig(difference=step))
    differentiable = SegmentResiduals.differentiable(problem, jnp.abs)
    assert jax.jacfwd(differentiable)(jnp.array([0.1]))[0, 0] == pytest.approx(slope, rel=1e-3)


def test_a_difference_of_nothing_is_refused():
    with pytest.raises(UsageError, match="difference must lie in"):
        FitConfig(difference=0.0)
