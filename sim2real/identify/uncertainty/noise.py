"""Noise of the sensor, and the spread of parameters that covers the remaining errors of the model."""

from collections.abc import Mapping, Sequence

import numpy as np

from sim2real.artifacts.identification import Noise
from sim2real.identify.uncertainty.uncertainty import Linearised, Uncertainty

_ORDER = 3
"""Differences of this order remove slow changes, such as the errors of a model."""
_GAIN = 20.0
"""Variance of third differences of white noise of variance 1: 1 + 9 + 9 + 1."""
_MULTIPLES = 0.98
"""Share of the differences between readings that must be multiples of a quantum."""


def noises(samples: Mapping[str, np.ndarray], units: Mapping[str, str]) -> tuple[Noise, ...]:
    """Return how each measured quantity scatters around the identified model.

    Third differences of the residuals separate white noise from slow errors of the model.

    Args:
        samples: Columns of the segments; see ``Identification.samples``.
        units: Column, or field of a message -> unit.
    """
    rows = []
    for name in (n.removesuffix("_measured") for n in samples if n.endswith("_measured")):
        measured = samples[f"{name}_measured"]
        # Split the residuals by segment, without values that diverged.
        parts = [
            (measured - samples[f"{name}_identified"])[rows]
            for rows in (samples["segment"] == s for s in np.unique(samples["segment"]))
        ]
        parts = [p[np.isfinite(p)] for p in parts]
        parts = [p for p in parts if p.size > _ORDER]
        if not parts:
            continue
        quantum = _quantum(measured[np.isfinite(measured)])
        white = np.concatenate([np.diff(p, _ORDER) for p in parts])
        # Subtract the variance of rounding, as the simulation rounds readings, too.
        variance = max(0.0, float(np.mean(white**2)) / _GAIN - quantum**2 / 12.0)
        # Estimate the bias: the variance of the segments' means beyond that of noise.
        means = np.array([p.mean() for p in parts])
        expected = float(np.mean([p.var() / p.size for p in parts]))
        bias = max(0.0, float(np.mean(means**2)) - expected)
        unit = units.get(name) or units.get(name.partition("[")[0], "")
        rows.append(Noise(name, unit, variance**0.5, quantum, bias**0.5))
    return tuple(rows)


def widening(at: Linearised, spread: Uncertainty) -> float:
    """Return the factor on the deviations of the posterior with which its predictions cover the model's errors.

    The posterior is the uncertainty of the best parameters. It becomes narrow with long recordings, even if no
    parameters explain them: a robot that the model does not describe acts, from moment to moment, like one with other
    parameters. With this factor, the predictions of draws spread on average as widely as slow residuals. White noise of
    the measurement does not count. Without slow residuals the factor is 1.
    """
    raw = at.raw.transpose(0, 2, 1)  # (S, F, C): one row a field of a segment
    inside = np.broadcast_to(at.compared[:, None], raw.shape)
    total, white, count = _squares(raw, at.compared)
    slow = max(0.0, total - white) / count if count else 0.0
    # Compare it with the spread of the predictions.
    J = at.jacobian.transpose(0, 2, 1, 3)[inside]
    predicted = float(np.einsum("np,pq,nq->n", J, spread.scale_covariance, J).mean()) if J.size else 0.0
    return float(np.sqrt(1.0 + slow / predicted)) if predicted > 0.0 else 1.0


def above_noise(at: Linearised) -> float:
    """Return the ratio of the residuals to the noise of the sensor, which no model predicts."""
    total, white, _ = _squares(at.raw.transpose(0, 2, 1), at.compared)
    return float(np.sqrt(total / white)) if white > 0.0 else np.inf


def _squares(raw: np.ndarray, compared: np.ndarray) -> tuple[float, float, int]:
    """Return the sum of squares of residuals ``(S, F, C)``, the share of white noise in it, and their number.

    In each field third differences separate white noise from slow errors.

    Args:
        compared: Shape ``(S, C)``, bool: which residuals count.
    """
    total, noise, count = 0.0, 0.0, 0
    for field in range(raw.shape[1]):
        rows = [r[counts] for r, counts in zip(raw[:, field], compared, strict=True)]
        rows = [r for r in rows if r.size > _ORDER]
        if not rows:
            continue
        white = float(np.mean(np.concatenate([np.diff(r, _ORDER) for r in rows]) ** 2)) / _GAIN
        squares = np.concatenate(rows) ** 2
        total, count = total + float(squares.sum()), count + squares.size
        noise += min(white, float(squares.mean())) * squares.size
    return total, noise, count


def _quantum(readings: Sequence[float] | np.ndarray) -> float:
    """Return the step that divides nearly all differences between readings; 0 without such a step."""
    levels = np.unique(np.asarray(readings, np.float64))
    steps = np.diff(levels)
    steps = steps[steps > 1e-6 * max(1e-12, float(np.ptp(levels)))] if levels.size > 1 else np.zeros(0)
    if steps.size < 8:
        return 0.0
    step = float(np.median(steps[steps < 1.5 * steps.min()]))
    off = np.abs(steps / step - np.round(steps / step))
    return step if np.mean(off < 0.05) >= _MULTIPLES else 0.0
