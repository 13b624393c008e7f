"""The search: finds the minimum with every strategy, and says when there is none."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification.config import FitConfig
from sim2real.identification.search import search, strategies

BOTTOM = np.array([1.0, -2.0])
BOX = np.zeros(2), np.full(2, -8.0), np.full(2, 8.0)
"""Start, and bounds."""
INCOMPLETE = {"RandomSearch": "sampling_fn", "SV_CMA_ES": "num_populations", "SV_Open_ES": "num_populations"}
"""Strategies whose constructors want what a search does not know."""
USUAL = ["CMA_ES", "SNES", "Open_ES"]
CONFIG = FitConfig(population=16, generations=300, std=1.0, seed=1)


def bowl(candidates, middle=None):
    del middle
    return 1.0 + np.sum((candidates - BOTTOM) ** 2 * np.array([1.0, 30.0]), axis=1)


def test_a_bowls_bottom_is_found_and_reported():
    told, middles = [], []
    losses = lambda c, middle: middles.append(middle) or bowl(c)  # noqa: E731
    found = search(losses, *BOX, CONFIG, on_generation=lambda best, z: told.append(best))
    np.testing.assert_allclose(found.x, BOTTOM, atol=0.02)
    assert found.loss == pytest.approx(float(bowl(found.x[None])[0]))
    assert len(found.history) < 300  # it ends once it is stuck
    assert np.all(np.diff(found.history) <= 0)
    assert found.evaluations == 16 * len(found.history)
    assert told == found.history.tolist()
    assert all(np.array_equal(middle, middles[0]) for middle in middles[:10])
    assert not np.array_equal(middles[10], middles[0])


def test_one_seed_one_result():
    config = replace(CONFIG, strategy="SNES", population=8, generations=3)
    first, again, other = (search(bowl, *BOX, replace(config, seed=s)) for s in (5, 5, 6))
    np.testing.assert_array_equal(first.x, again.x)
    np.testing.assert_array_equal(first.history, again.history)
    assert not np.array_equal(first.x, other.x)


def test_candidates_that_cannot_be_simulated_lose():
    hole = lambda c, *rest: np.where(c[:, 0] > 0.5, np.nan, bowl(c))  # noqa: E731
    assert search(hole, *BOX, CONFIG).loss == pytest.approx(1.25, abs=0.05)
    bad = lambda c, *rest: np.where(c[:, 0] > 0.0, np.nan, np.inf)  # noqa: E731
    with pytest.raises(Sim2RealError, match="no candidate could be simulated"):
        search(bad, *BOX, replace(CONFIG, strategy="SNES", generations=10))


@pytest.mark.parametrize(
    "strategy",
    [s if s in (*USUAL, *INCOMPLETE, "LM_MA_ES") else pytest.param(s, marks=pytest.mark.night) for s in strategies()],
)
def test_every_strategy_runs_or_says_why_not(strategy):
    config = FitConfig(strategy=strategy, population=8, generations=10, std=0.7)
    if strategy in INCOMPLETE:
        with pytest.raises(UsageError, match=f"'{strategy}' needs {INCOMPLETE[strategy]}"):
            search(bowl, *BOX, config)
    elif strategy == "LM_MA_ES":  # sound only for fewer than two candidates a parameter
        with pytest.raises(UsageError, match="breaks down"):
            search(bowl, *BOX, config)
    else:
        found = search(bowl, *BOX, config)
        assert found.evaluations == 80
        assert found.loss <= float(bowl(np.zeros((1, 2)))[0]) + 1e-3
        assert found.loss == pytest.approx(float(bowl(found.x[None])[0]))


def test_unknown_strategies_and_populations_that_one_refuses():
    with pytest.raises(UsageError, match=r"unknown strategy 'PSO'\. Available: .*CMA_ES"):  # it searches from no mean
        search(bowl, *BOX, replace(CONFIG, strategy="PSO"))
    with pytest.raises(UsageError, match="'Open_ES' refuses a population of 7"):
        search(bowl, *BOX, replace(CONFIG, strategy="Open_ES", population=7))
