"""Derivatives that a descent keeps: it ends where exact ones end it, and takes them anew where they fail."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from sim2real.identify.problem.broyden import corrected

TIMES = np.linspace(0.0, 3.0, 40)
TRUTH = np.array([2.0, 0.7, 0.3])


def value(z):
    """Decay with an offset, beside what was measured with noise."""
    noise = 0.01 * np.random.default_rng(0).normal(size=TIMES.size)
    shown = lambda p: p[0] * np.exp(-p[1] * TIMES) + p[2]  # noqa: E731
    return shown(z) - shown(TRUTH) - noise


def slope(z):
    decay = np.exp(-z[1] * TIMES)
    return np.stack([decay, -z[0] * TIMES * decay, np.ones_like(TIMES)], axis=1)


def descend(exact=slope):
    asked = []

    def counted(z):
        asked.append(z)
        return exact(z)

    f, jac = corrected(value, counted)
    options = {"jac": jac, "ftol": 1e-8, "xtol": 1e-8, "gtol": None}
    return least_squares(f, np.array([1.5, 1.0, 0.0]), **options).x, len(asked)


def test_a_descent_ends_at_the_minimum_with_fewer_derivatives():
    found, asked = descend()
    whole = least_squares(value, np.array([1.5, 1.0, 0.0]), jac=slope, ftol=1e-12, xtol=1e-12, gtol=1e-12)
    np.testing.assert_allclose(found, whole.x, rtol=1e-3)
    assert 1 <= asked < whole.njev


def test_derivatives_that_do_not_predict_a_step_are_taken_anew():
    f, jac = corrected(lambda z: np.array([z[0] ** 2, z[1]]), lambda z: np.array([[2 * z[0], 0.0], [0.0, 1.0]]))
    at = lambda *z: (f(np.array(z)), jac(np.array(z)))[1]  # noqa: E731
    np.testing.assert_allclose(at(1.0, 0.0), [[2.0, 0.0], [0.0, 1.0]])
    np.testing.assert_allclose(at(1.1, 0.0), [[2.1, 0.0], [0.0, 1.0]])  # the secant
    np.testing.assert_allclose(at(5.0, 0.0), [[10.0, 0.0], [0.0, 1.0]])  # exact: the secant is wrong by 66 %


def test_a_jacobian_nearby_replaces_the_first_derivative():
    asked = []
    exact = lambda z: (asked.append(z), slope(z))[1]  # noqa: E731
    near = 1.05 * TRUTH
    f, jac = corrected(value, exact, (TRUTH, value(TRUTH), slope(TRUTH)))
    f(near)
    step = near - TRUTH
    np.testing.assert_allclose(jac(near) @ step, value(near) - value(TRUTH))  # exact along the step
    assert not asked
    far = np.array([9.0, 4.0, 2.0])
    f, jac = corrected(value, exact, (TRUTH, value(TRUTH), slope(TRUTH)))
    f(far)
    np.testing.assert_array_equal(jac(far), slope(far))
    assert len(asked) == 1


def test_residuals_are_evaluated_once_at_a_point():
    points = []
    f, jac = corrected(lambda z: (points.append(z), value(z))[1], slope)
    z = np.array([1.0, 1.0, 0.0])
    f(z)
    jac(z)
    f(z)
    assert len(points) == 1


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_a_point_without_numbers_is_no_base_for_a_correction(broken):
    f, jac = corrected(lambda z: np.full(2, broken) if z[0] > 1.0 else z, lambda z: np.eye(2))
    f(np.zeros(2))
    jac(np.zeros(2))
    f(np.array([2.0, 0.0]))
    np.testing.assert_allclose(jac(np.array([2.0, 0.0])), np.eye(2))
