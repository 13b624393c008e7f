import sys

import numpy as np
import pytest

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.fitting import fit_mixture, resample


@pytest.fixture
def two_modes():
    rng = np.random.default_rng(0)
    pick = rng.random(2000) < 0.7
    return np.where(pick, rng.normal(0.005, 0.0005, 2000), rng.normal(0.012, 0.001, 2000))


def test_a_mixture_has_the_moments_and_quantiles_of_the_record(two_modes):
    dist = fit_mixture(two_modes)
    drawn = dist.sample(np.random.default_rng(1), (50, 400))
    assert drawn.min() >= 0
    assert abs(drawn.mean() - two_modes.mean()) < 1e-4
    assert abs(drawn.std() - two_modes.std()) < 1e-4
    for q in (0.05, 0.5, 0.99):
        assert abs(dist.quantile(q) - np.quantile(two_modes, q)) < 4e-4


def test_two_modes_are_found_as_two_components(two_modes):
    weights = np.asarray(fit_mixture(two_modes).dist.mixture_distribution.probs)
    assert sorted(np.round(weights[weights > 0.05], 1)) == [0.3, 0.7]


def test_a_constant_delay_is_a_constant():
    dist = fit_mixture(np.full(10, 0.004))
    assert np.allclose(dist.sample(np.random.default_rng(0), (5,)), 0.004, rtol=1e-12)


def test_independent_delays_are_drawn_one_by_one():
    assert resample(np.random.default_rng(0).exponential(0.002, 3000)).block == 1


def test_runs_of_slow_steps_stay_runs():
    rng = np.random.default_rng(0)
    slow = np.repeat(rng.random(300) < 0.2, 10)  # ten steps at a time
    record = 0.002 + 0.008 * slow + rng.uniform(0, 1e-4, slow.size)
    dist = resample(record)
    assert 5 <= dist.block <= 20
    drawn = dist.sample(rng, (20, 1000)) > 0.006
    after_slow = drawn[:, 1:][drawn[:, :-1]].mean()
    assert after_slow > 0.8  # 0.92 in the record, 0.2 without memory
    assert abs(drawn.mean() - 0.2) < 0.05


@pytest.mark.parametrize("bad", [[], [0.1], [0.1, -0.1], [0.1, np.nan], [[0.1, 0.2]]])
def test_what_is_no_record_of_delays_is_refused(bad):
    with pytest.raises(UsageError, match="recorded delays"):
        fit_mixture(np.array(bad))
    with pytest.raises(UsageError, match="recorded delays"):
        resample(np.array(bad))


def test_too_few_delays_are_refused():
    with pytest.raises(UsageError, match="too few"):
        fit_mixture(np.array([0.1, 0.2, 0.3]))


def test_without_scikit_learn_the_error_names_the_extra(two_modes, monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.mixture", None)
    with pytest.raises(Sim2RealError, match="fit_mixture needs scikit-learn") as caught:
        fit_mixture(two_modes)
    assert caught.value.hint == "pip install 'sim2real[mixture]'"
