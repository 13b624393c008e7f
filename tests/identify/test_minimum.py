"""The minimum of one's own loss."""

import jax.numpy as jnp
import numpy as np
import pytest

from sim2real import minimise
from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification.config import FitConfig

FEW = FitConfig(population=16, generations=60)
START = {"mass": 1.0, "offset": np.zeros(2)}
BOUNDS = {"mass": (1e-4, 10.0), "offset": ([-1.0, -2.0], 2.0)}


def loss(p):
    return (np.log10(0.01) - jnp.log10(p["mass"])) ** 2 + jnp.sum((p["offset"] - jnp.asarray([0.5, -1.5])) ** 2)


def test_a_minimum_inside_of_bounds_is_found():
    found = minimise(loss, START, BOUNDS, FEW)
    assert found.parameters["mass"] == pytest.approx(0.01, rel=0.05)
    np.testing.assert_allclose(found.parameters["offset"], [0.5, -1.5], atol=0.05)
    assert found.loss < 1e-2 < found.start
    assert float(loss(found.parameters)) == pytest.approx(found.loss, abs=1e-5)
    assert repr(found).startswith("Minimum(loss: ")


def test_a_loss_in_plain_python():
    def plain(p):
        return float(abs(float(p["x"]) - 3.0))  # JAX could not trace it

    found = minimise(plain, {"x": 1.0}, {"x": (0.0, 4.0)}, FEW, compiled=False)
    assert found.parameters["x"] == pytest.approx(3.0, abs=0.02)


@pytest.mark.parametrize(
    ("parameters", "bounds", "said"),
    [
        ({}, {}, "no parameter"),
        ({"a": 1.0}, {"b": (0, 1)}, "a, b: parameters and bounds must have the same names"),
        ({"a": 1.0}, {"a": 3.0}, "a: bounds must be two numbers"),
        ({"a": 1.0}, {"a": (2.0, 1.0)}, "the lower below the higher"),
        ({"a": 1.0}, {"a": (0.0, float("inf"))}, "must be finite"),
        ({"a": 5.0}, {"a": (0.0, 1.0)}, "a begins outside of its bounds"),
        ({"a": np.zeros(2)}, {"a": (np.zeros(3), np.ones(3))}, "arrays of shape"),
    ],
)
def test_what_does_not_fit_is_named(parameters, bounds, said):
    with pytest.raises(UsageError, match=said):
        minimise(lambda p: 0.0, parameters, bounds)


def test_a_dict_of_settings():
    found = minimise(lambda p: p["a"] ** 2, {"a": 0.5}, {"a": (-1.0, 1.0)}, {"population": 4, "generations": 3})
    assert found.history.shape == (3,)
    with pytest.raises(UsageError, match="config has no steps"):
        minimise(lambda p: 0.0, {"a": 0.5}, {"a": (-1.0, 1.0)}, {"steps": 3})


def test_a_loss_that_is_no_number_is_named():
    with pytest.raises(UsageError, match="must be one number, got an array of shape"):
        minimise(lambda p: p["a"], {"a": np.zeros(2)}, {"a": (-1.0, 1.0)}, FEW)
    with pytest.raises(Sim2RealError, match="infinite or no number"):
        minimise(lambda p: p["a"] * jnp.nan, {"a": 0.0}, {"a": (-1.0, 1.0)}, FitConfig(population=4, generations=2))
