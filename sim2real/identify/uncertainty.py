"""How well a log determines the parameters: covariance, intervals, and what cannot be told at all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.identify.problem import Problem

_PRIOR_STD = np.pi / np.sqrt(3.0)
"""A value that may lie anywhere between its bounds has a logistic z: this is its standard deviation."""
_VAGUE = 0.35
"""A standard error in z above this says little more than the bounds do."""


@dataclass(frozen=True)
class Uncertainty:
    """What the log leaves open.

    Attributes:
        covariance: Shape ``(P, P)``, of the values, in their units.
        standard_error: Shape ``(P,)``.
        low: Shape ``(P,)``: lower end of the 95 % interval, within the bounds.
        high: Shape ``(P,)``: upper end.
        verdict: One a parameter: ``accepted``, ``not identifiable`` or ``at a bound``.
        correlation: Shape ``(P, P)``.
        inflation: Factor on the variance for residuals that are correlated in time.
    """

    covariance: np.ndarray
    standard_error: np.ndarray
    low: np.ndarray
    high: np.ndarray
    verdict: tuple[str, ...]
    correlation: np.ndarray
    inflation: float


def uncertainty(problem: Problem, z: np.ndarray) -> Uncertainty:
    """Linearise the residuals at the estimate ``z (P,)``.

    The bounds act as a weak prior, so that a direction that the log says nothing about gets the width of its bounds and
    not infinity. Residuals that are correlated in time carry less information than their number: the variance is
    scaled by (1 + rho) / (1 - rho), rho their correlation from one sample to the next.
    """
    point = jnp.asarray(z, jnp.float32)
    columns = jax.jit(problem.sensitivities)(point)
    residuals, jacobian = jax.jit(lambda y, c: (problem.stacked(y, c), jax.jacfwd(problem.stacked)(y, c)))(
        point, columns
    )
    r, J = np.asarray(residuals, np.float64), np.asarray(jacobian, np.float64)
    rho = _correlation_in_time(r)
    inflation = (1 + rho) / (1 - rho)
    flat, J = r.reshape(-1), J.reshape(-1, len(z))
    seen = flat != 0.0
    variance = float(np.mean(flat[seen] ** 2)) * inflation
    slope = problem.table.slope(z)
    precision = _without(J.T @ J / variance, _time_shift(problem) / slope) + np.eye(len(z)) / _PRIOR_STD**2
    cov_z = np.linalg.inv(precision)
    error_z = np.sqrt(np.diag(cov_z))
    covariance = cov_z * np.outer(slope, slope)
    low, high = (_decode(problem, np.asarray(z) + side * 1.96 * error_z) for side in (-1, 1))
    verdict = tuple(_verdict(float(zi), float(e)) for zi, e in zip(z, error_z, strict=True))
    return Uncertainty(
        covariance=covariance,
        standard_error=np.sqrt(np.diag(covariance)),
        low=low,
        high=high,
        verdict=verdict,
        correlation=cov_z / np.outer(error_z, error_z),
        inflation=inflation,
    )


def _time_shift(problem: Problem) -> np.ndarray:
    """Return the direction ``(P,)`` in which only time moves: the sensor's delay up, that of what it drives down.

    As initial states are free, this changes nothing in a continuous model. What the residuals seem to say about it is
    how well the world's ticks happen to meet the measurements, so it must not count as information.
    """
    kinds = [(p.kind == "delay", p.name.startswith("sensor")) for p in problem.table]
    direction = np.array([(1.0 if sensor else -1.0) if delay else 0.0 for delay, sensor in kinds])
    return direction if len(set(direction[direction != 0.0])) == 2 else np.zeros_like(direction)


def _without(information: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the information that is left when the parameters may move freely along a direction."""
    along = information @ direction
    weight = float(direction @ along)
    return information - np.outer(along, along) / weight if weight > 0 else information


def _verdict(z: float, error_z: float) -> str:
    if error_z > _VAGUE:
        return "not identifiable"
    return "at a bound" if abs(z) > 5.0 else "accepted"  # the outer 0.7 % of the interval


def _decode(problem: Problem, z: np.ndarray) -> np.ndarray:
    values: dict[str, Any] = problem.table.decode(jnp.asarray(z))
    return np.array([float(values[n]) for n in problem.table.names])


def _correlation_in_time(r: np.ndarray) -> float:
    """Return the correlation of successive residuals within segments, ``(E, C, F)``, between 0 and 0.95."""
    now, later = r[:, :-1], r[:, 1:]
    both = (now != 0.0) & (later != 0.0)
    rho = float((now * later)[both].sum() / np.maximum((now**2)[both].sum(), 1e-12))
    return float(np.clip(rho, 0.0, 0.95))
