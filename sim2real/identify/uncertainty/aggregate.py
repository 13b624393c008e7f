"""One estimate from several recordings of the same robot, with the spread between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from sim2real.errors import UsageError


@dataclass(frozen=True)
class Aggregate:
    """What several recordings say together about one quantity; every number in its unit.

    Attributes:
        mean: Estimate of the mean over recordings.
        standard_error: Of the mean.
        between: Standard deviation between recordings, beyond what their own errors explain.
        low: Lower end of the 95 % interval for what one more such recording will say.
        high: Upper end.
        agree: Whether the spread between recordings is no larger than their own errors explain (chi-square, 1 %).
    """

    mean: float
    standard_error: float
    between: float
    low: float
    high: float
    agree: bool


def aggregate(estimates: np.ndarray, errors: np.ndarray) -> Aggregate:
    """Combine estimates ``(K,)`` with their standard errors ``(K,)`` by a random-effects model (DerSimonian and Laird).

    The standard error of one recording does not include what differs between recordings: temperature, wear, the
    model's error on other motions. The interval is for the estimate from one more recording: the prediction interval of
    Higgins, Thompson and Spiegelhalter (2009), widened by the typical standard error of one recording. It tells how
    much to randomise in training.

    Raises:
        UsageError: When there are fewer than two recordings.
    """
    x, s = np.asarray(estimates, np.float64), np.maximum(np.asarray(errors, np.float64), 1e-30)
    if len(x) < 2:
        raise UsageError(f"an aggregate needs two recordings at least, got {len(x)}")
    w = 1.0 / s**2
    fixed = float(np.sum(w * x) / np.sum(w))
    q = float(np.sum(w * (x - fixed) ** 2))
    surplus = float(np.sum(w) - np.sum(w**2) / np.sum(w))
    between = max(0.0, (q - (len(x) - 1)) / surplus)
    w = 1.0 / (s**2 + between)
    mean, error = float(np.sum(w * x) / np.sum(w)), float(np.sqrt(1.0 / np.sum(w)))
    reach = float(stdtrit(max(len(x) - 2, 1), 0.975)) * np.sqrt(between + error**2 + float(np.median(s**2)))
    return Aggregate(mean, error, float(np.sqrt(between)), mean - reach, mean + reach, q <= _chi_square_99(len(x) - 1))


def _chi_square_99(freedom: int) -> float:
    from scipy.special import chdtri

    return float(chdtri(freedom, 0.01))
