"""One estimate from several recordings of the same robot, with the spread between them."""

import numpy as np
from scipy.special import chdtri, stdtrit

from sim2real.artifacts.identification import Quantity
from sim2real.errors import UsageError

_DISAGREES = 0.01
"""Probability by chance, in a chi-square test, below which recordings disagree."""


def aggregate(estimates: np.ndarray, errors: np.ndarray, name: str = "", unit: str = "") -> Quantity:
    """Combine estimates ``(K,)`` and their standard errors ``(K,)`` by a random-effects model (DerSimonian and Laird).

    The standard error of one recording excludes the differences between recordings: temperature, wear, the errors of
    the model on other motions. The interval is the prediction interval for one further recording (Higgins, Thompson
    and Spiegelhalter, 2009), widened by the median standard error of a recording. Training randomises within it.
    """
    x, s = np.asarray(estimates, np.float64), np.maximum(np.asarray(errors, np.float64), 1e-30)
    if len(x) < 2:
        raise UsageError(f"an aggregate needs two recordings at least, got {len(x)}")
    # Weight each recording by its own precision, and measure how much more they differ than that explains.
    w = 1.0 / s**2
    fixed = float(np.sum(w * x) / np.sum(w))
    q = float(np.sum(w * (x - fixed) ** 2))
    surplus = float(np.sum(w) - np.sum(w**2) / np.sum(w))
    between = max(0.0, (q - (len(x) - 1)) / surplus)
    # Weight them again with the variance between recordings added.
    w = 1.0 / (s**2 + between)
    mean, error = float(np.sum(w * x) / np.sum(w)), float(np.sqrt(1.0 / np.sum(w)))
    reach = float(stdtrit(max(len(x) - 2, 1), 0.975)) * np.sqrt(between + error**2 + float(np.median(s**2)))
    agree = q <= float(chdtri(len(x) - 1, _DISAGREES))
    return Quantity(
        name,
        unit,
        x,
        np.asarray(errors, np.float64),
        mean,
        error,
        float(np.sqrt(between)),
        mean - reach,
        mean + reach,
        agree,
    )
