"""The robots that training draws: joint, as wide as the recordings leave open, and no wider."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.artifacts.identification import Estimate, Identification, Judgement, OverLogs
from sim2real.artifacts.posterior import Posterior
from sim2real.errors import UsageError
from sim2real.training.environment.draws import COUNT, draw_robots, widen_posterior, without_default_ranges
from sim2real.training.environment.variation import VariationConfig

NAMES = ("gain", "gravity", "actuator_delay", "zero")
KINDS = ("dynamics", "dynamics", "delay", "measurement")
SUM_S = 0.0005
"""Deviation of the delay [s]."""


@pytest.fixture
def found():
    """Gain and gravity are correlated, and there is one delay."""
    covariance = np.zeros((4, 4))
    covariance[:2, :2] = np.array([[1.0, 0.65], [0.65, 1.0]]) * 0.005**2
    covariance[2, 2], covariance[3, 3] = SUM_S**2, 1.0
    mean = np.array([np.log(20.0), np.log(100.0), 0.045, 0.0])
    low, high = mean - np.array([1.0, 1.0, 0.045, 9.0]), mean + np.array([1.0, 1.0, 0.075, 9.0])
    transform = ("log", "log", "linear", "linear")
    values = dict(zip(NAMES, (20.0, 100.0, 0.045, 0.0), strict=True))
    return Identification(
        pipeline="pendulum",
        logs=(),
        verdict=Judgement("accepted", ()),
        parameters=tuple(
            Estimate(n, "1", kind, "", 1.0, values[n], "accepted") for n, kind in zip(NAMES, KINDS, strict=True)
        ),
        posterior=Posterior(NAMES, transform, mean, covariance, low, high, widening=3.0),
    )


def drawn(found, randomise=1.0, **options):
    values = found.values if found else {"gain": 2.0, "payload": 0.0}
    return draw_robots(values, found, VariationConfig(**options), randomise, np.random.default_rng(0))


def test_a_pipelines_own_range_ends_where_the_parameter_was_identified():
    own = VariationConfig(range={"gain": (1.0, 3.0), "payload": (0.0, 1.0)})
    kept = without_default_ranges(own, own, {"gain": 2.0})
    assert kept.range == {"payload": (0.0, 1.0)}
    users = VariationConfig(range={**own.range, "gain": (1.5, 3.0)})
    assert without_default_ranges(users, own, {"gain": 2.0}) == users


def test_draws_are_as_correlated_and_as_narrow_as_the_posterior(found):
    draws = drawn(found, misfit=False)
    assert set(draws) == set(NAMES[:3]), "what belongs to the measurement is no robot's"
    gain, gravity = np.log(draws["gain"]), np.log(draws["gravity"])
    assert np.corrcoef(gain, gravity)[0, 1] == pytest.approx(0.65, abs=0.06)
    assert draws["actuator_delay"].mean() == pytest.approx(0.045, abs=1e-4)


OVER_LOGS = tuple(
    OverLogs(n, "1", mean, 0.0, between, 0.0, 1.0)
    for n, mean, between in (("gain", 20.0, 0.4), ("actuator_delay", 0.045, 0.002))
)


@pytest.mark.parametrize(
    ("over_logs", "options", "randomise", "gain", "delay_s"),
    [
        ((), {"misfit": False}, 1.0, 0.005, SUM_S),
        ((), {}, 1.0, 3 * 0.005, 3 * SUM_S),  # what the model leaves unexplained
        ((), {"misfit": False}, 2.0, 2 * 0.005, 2 * SUM_S),
        (OVER_LOGS, {"misfit": False}, 1.0, np.hypot(0.005, 0.4 / 20.0), np.hypot(SUM_S, 0.002)),
    ],
)
def test_how_wide_draws_are(found, over_logs, options, randomise, gain, delay_s):
    draws = drawn(replace(found, over_logs=over_logs), randomise, **options)
    assert np.log(draws["gain"]).std() == pytest.approx(gain, rel=0.1)
    assert draws["actuator_delay"].std() == pytest.approx(delay_s, rel=0.1)


def test_a_parameter_that_is_open_is_drawn_from_all_of_its_bounds(found):
    posterior = found.posterior
    covariance = posterior.covariance.copy()
    covariance[0, 0] = (2.0 / np.sqrt(12.0)) ** 2
    covariance[0, 1] = covariance[1, 0] = 0.0
    scale = np.log(drawn(replace(found, posterior=replace(posterior, covariance=covariance)))["gain"])
    low, high = posterior.lower[0], posterior.upper[0]
    assert low <= scale.min() < scale.max() <= high
    shares = np.histogram(scale, 4, (low, high))[0] / COUNT
    assert shares.min() > 0.18, "no heap at a bound"


def test_a_point_estimate_a_uniform_range_and_a_data_sheet(found):
    assert drawn(found, 0.0) == {}
    assert drawn(None) == {}
    uniform = drawn(found, uniform=0.3)
    for name in NAMES[:3]:
        value = found.values[name]
        assert 0.7 * value <= uniform[name].min() < 0.75 * value
        assert 1.25 * value < uniform[name].max() <= 1.3 * value
    sheet = drawn(None, uniform=0.3, range={"payload": (0.0, 0.1)})
    assert set(sheet) == {"gain", "payload"}
    assert 0.0 <= sheet["payload"].min() < 0.01 < 0.09 < sheet["payload"].max() <= 0.1


def test_what_cannot_be_drawn_is_refused(found):
    with pytest.raises(UsageError, match=r"payload, which this model does not have"):
        drawn(found, range={"payload": (0.0, 1.0)})
    for wrong in ({"noise": -1.0}, {"uniform": 1.0}, {"range": {"gain": (2.0, 1.0)}}):
        with pytest.raises(UsageError, match=r"vary\."):
            VariationConfig(**wrong)


def test_the_posterior_keeps_its_other_numbers(found):
    wide = widen_posterior(found, found.posterior, 1.0)
    np.testing.assert_array_equal(wide.mean, found.posterior.mean)
    np.testing.assert_allclose(wide.covariance[:2, :2], found.posterior.covariance[:2, :2])
