"""Intervals of trajectories from draws of the posterior, beside a model whose answer is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.posterior import Posterior
from sim2real.identify.validation.draws import DRAWS, intervals

T = np.arange(0.0, 2.0, 0.1)
SIGMA, SETTLE_S = 0.01, 0.5
POSTERIOR = Posterior(("slope",), ("linear",), np.array([2.0]), np.array([[0.04]]), np.array([-9.0]), np.array([9.0]))


class Line:
    """Two segments in which a position grows with a slope; the measured slope is 2.1."""

    segments, ts = 2, np.stack([T, T])
    fields = ((None, SIGMA, None),)
    channels = (SimpleNamespace(position="x", velocity=None, name="x", index=None, fields=(("x", SIGMA),)),)

    def predict(self, rows, every, fit_s):
        assert (fit_s == SETTLE_S).all()
        return ((rows["slope"][:, None] - 2.1) * self.ts / SIGMA)[..., None]


@pytest.fixture(scope="module")
def columns():
    segment = np.repeat([0, 1], len(T))
    into = np.tile(T, 2)
    return {"into": into, "segment": segment, "x_measured": 2.1 * into, "x_identified": 2.0 * into}


def test_the_interval_of_a_trajectory_and_of_its_error_are_those_of_the_draws(columns, monkeypatch):
    monkeypatch.setattr("sim2real.identify.validation.draws.labels", lambda problem: ["x"])
    bands, errors = intervals(Line(), columns, {"slope": 2.0}, POSTERIOR, SETTLE_S)
    slopes = POSTERIOR.sample(np.random.default_rng(0), DRAWS)["slope"]
    low, high = np.quantile(slopes, (0.025, 0.975))
    np.testing.assert_allclose(bands["x_low95"], low * columns["into"], atol=1e-12)
    np.testing.assert_allclose(bands["x_high95"], high * columns["into"], atol=1e-12)
    rms = np.sqrt(np.mean((slopes - 2.0) ** 2))
    np.testing.assert_allclose(bands["x_spread"], rms * columns["into"], atol=1e-12)
    after = T[T > SETTLE_S]
    each = np.abs(slopes - 2.1) * np.sqrt(np.mean(after**2))
    assert errors[0, "x"] == pytest.approx(tuple(np.quantile(each, (0.025, 0.975))))
    assert errors[0, "x"] == errors[1, "x"]


def test_without_a_posterior_there_are_no_intervals(columns):
    assert intervals(Line(), columns, {"slope": 2.0}, None, SETTLE_S) == ({}, {})
