"""Several recordings of one robot: against textbook formulas, and what is said of their spread."""

import numpy as np
import pytest
from scipy import optimize, stats

from sim2real.errors import UsageError
from sim2real.identification.uncertainty import aggregate

# Eight randomised trials of intravenous magnesium, log odds ratios and their standard errors' squares: any effects do.
EFFECTS = np.array([0.095, 0.277, 0.367, 0.664, 0.462, 0.185])
VARIANCES = np.array([0.033, 0.031, 0.050, 0.011, 0.043, 0.023])


def test_a_textbook_meta_analysis():
    """Borenstein, Hedges, Higgins and Rothstein, "A basic introduction to fixed-effect and random-effects models"."""
    found = aggregate(EFFECTS, np.sqrt(VARIANCES))
    assert found.mean == pytest.approx(0.358, abs=1e-3)
    assert found.standard_error == pytest.approx(0.105, abs=1e-3)
    assert found.spread**2 == pytest.approx(0.037, abs=1e-3)


def test_the_between_variance_solves_the_moment_equation():
    """DerSimonian and Laird: the expectation of Q under that variance is the Q that was found."""
    rng = np.random.default_rng(0)
    s = rng.uniform(0.1, 0.6, 7)
    x = 3.0 + rng.normal(size=7) * np.sqrt(s**2 + 0.25)
    w = s**-2
    q = float(w @ (x - np.average(x, weights=w)) ** 2)
    residual_maker = np.diag(w) - np.outer(w, w) / w.sum()  # Q = x' M x, so E Q = tr(M (S + between^2))
    expected = lambda tau2: float(np.trace(residual_maker @ np.diag(s**2 + tau2)))  # noqa: E731
    tau2 = optimize.brentq(lambda t: expected(t) - q, 0.0, 100.0)
    found = aggregate(x, s)
    assert found.spread**2 == pytest.approx(tau2, rel=1e-6)
    design, cov = np.ones((7, 1)), np.diag(s**2 + tau2)
    information = float((design.T @ np.linalg.solve(cov, design))[0, 0])
    mean = float((design.T @ np.linalg.solve(cov, x))[0]) / information
    assert found.mean == pytest.approx(mean)
    assert found.standard_error == pytest.approx(information**-0.5)
    reach = stats.t.ppf(0.975, 5) * np.sqrt(tau2 + 1 / information + np.median(s**2))
    assert (found.low95, found.high95) == (pytest.approx(mean - reach), pytest.approx(mean + reach))


def test_recordings_that_agree_have_nothing_between_them():
    found = aggregate(np.array([1.0, 1.1, 0.95]), np.full(3, 0.2))
    assert found.spread == 0.0
    assert found.mean == pytest.approx(np.mean([1.0, 1.1, 0.95]))
    assert found.standard_error == pytest.approx(0.2 / np.sqrt(3))


def test_one_recording_is_none():
    with pytest.raises(UsageError, match="two recordings at least, got 1"):
        aggregate(np.array([1.0]), np.array([0.1]))
