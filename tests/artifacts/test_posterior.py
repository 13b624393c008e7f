"""The posterior: what is drawn from it, and what its file takes."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.identification.parameters import Parameter, ParameterTable


@pytest.fixture
def posterior():
    """Three parameters, one a transform, correlated."""
    table = ParameterTable(
        [
            Parameter("gain", "1", 2.0, 0.1, 40.0),
            Parameter("offset", "rad", 0.0, -3.0, 3.0, "linear"),
            Parameter("share", "1", 0.4, 0.001, 9.9),
        ]
    )
    root = np.array([[0.2, 0.0, 0.0], [-0.15, 0.1, 0.0], [0.05, 0.1, 0.3]])
    z = table.encode({"gain": 3.0, "offset": 0.5, "share": 0.3})
    return table.posterior(z, root @ root.T)


def on_scales(values):
    return np.stack([np.log(values["gain"]), values["offset"], np.log(values["share"])])


def test_draws_have_its_mean_and_covariance(posterior):
    drawn = on_scales(posterior.sample(np.random.default_rng(0), 40_000))
    np.testing.assert_allclose(drawn.mean(axis=1), [np.log(3.0), 0.5, np.log(0.3)], atol=0.01)
    np.testing.assert_allclose(np.cov(drawn), posterior.covariance, atol=0.003)
    wide = on_scales(posterior.sample(np.random.default_rng(0), 40_000, widen=2.0))
    np.testing.assert_allclose(np.cov(wide), 4.0 * posterior.covariance, atol=0.012)


def test_draws_stay_within_the_bounds(posterior):
    drawn = posterior.sample(np.random.default_rng(1), 5000, widen=30.0)
    for name, low, high in (("gain", 0.1, 40.0), ("offset", -3.0, 3.0), ("share", 0.001, 9.9)):
        assert drawn[name].shape == (5000,)
        width = high - low
        assert low - 1e-9 <= drawn[name].min() < low + 0.02 * width
        assert high - 0.02 * width < drawn[name].max() <= high + 1e-9
        assert len(np.unique(drawn[name])) > 4900, "no heap at a bound"


def test_a_direction_without_spread_is_no_problem(posterior):
    flat = replace(posterior, covariance=np.diag([0.0, 0.04, 0.0]))
    drawn = flat.sample(np.random.default_rng(0), 100)
    np.testing.assert_allclose(drawn["gain"], 3.0, rtol=1e-6)
    assert drawn["offset"].std() == pytest.approx(0.2, rel=0.3)
