"""How well a log determines the parameters: covariance, intervals, and what cannot be told at all."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem import Problem

_VAGUE = 0.15
"""A standard error above this share of the bounds says little more than they do (a uniform value has 0.29)."""
_AT_BOUND = 0.005
"""An estimate within this share of the bounds' width of a bound counts as at the bound."""


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


def centred(table: ParameterTable, z: np.ndarray) -> np.ndarray:
    """Return ``z (P,)`` with time shifted to the middle of what the bounds of the delays admit.

    The log does not tell delays on either side of the world apart; where a search happens to leave them means nothing.
    """
    x, _ = table.scale(z)
    shift = _time_shift(table)
    down, up = _shift_range(table, x, shift)
    values = table.unscale(x + shift * (down + up) / 2)
    return table.encode(dict(zip(table.names, values.tolist(), strict=True)))


def uncertainty(problem: Problem, z: np.ndarray) -> Uncertainty:
    """Linearise the residuals at the estimate ``z (P,)``.

    On each parameter's own scale the bounds act as a weak prior, so that a direction that the log says nothing about
    gets the width of its bounds and not infinity. Residuals that are correlated in time carry less information than
    their number: the variance is scaled by (1 + rho) / (1 - rho), rho their correlation from one sample to the next.

    A shift of time between the sensor's delay and the others changes nothing in a continuous model, as initial states
    are free. What the residuals seem to say about it is how well the world's ticks happen to meet the measurements, so
    the shift counts as unknown within the bounds, and the rest is computed at the shift that was found.
    """
    point = jnp.asarray(z, jnp.float32)
    columns = jax.jit(problem.sensitivities)(point)
    linearise = jax.jit(lambda y, c: (problem.stacked(y, c), jax.jacfwd(problem.stacked)(y, c)))
    r, J = (np.asarray(a, np.float64) for a in linearise(point, columns))
    rho = _correlation_in_time(r)
    inflation = (1 + rho) / (1 - rho)
    table = problem.table
    x, stretch = table.scale(z)
    flat, J = r.reshape(-1), J.reshape(-1, len(z)) / stretch
    variance = float(np.mean(flat[flat != 0.0] ** 2)) * inflation
    shift = _time_shift(table)
    fixed = np.flatnonzero(shift > 0)[:1]  # the sensor's delay carries the shift
    rest = np.setdiff1d(np.arange(len(z)), fixed)
    precision = J[:, rest].T @ J[:, rest] / variance + np.diag(12.0 / table.span[rest] ** 2)
    cov = np.zeros((len(z), len(z)))
    cov[np.ix_(rest, rest)] = np.linalg.inv(precision)
    down, up = _shift_range(table, x, shift)
    reach = 1.96 * np.sqrt(np.diag(cov))
    low = table.unscale(x - reach + np.minimum(down * shift, up * shift))
    high = table.unscale(x + reach + np.maximum(down * shift, up * shift))
    cov += np.outer(shift, shift) * (up - down) ** 2 / 12.0
    error = np.sqrt(np.diag(cov))
    to_value = np.where(table.logarithmic, table.unscale(x), 1.0)
    covariance = cov * np.outer(to_value, to_value)
    share = (
        np.stack([x - table.scale(np.full(len(z), -50.0))[0], table.scale(np.full(len(z), 50.0))[0] - x]) / table.span
    )
    return Uncertainty(
        covariance=covariance,
        standard_error=np.sqrt(np.diag(covariance)),
        low=low,
        high=high,
        verdict=tuple(_verdict(e, m) for e, m in zip(error / table.span, share.min(axis=0), strict=True)),
        correlation=cov / np.outer(error, error),
        inflation=inflation,
    )


def _verdict(error: float, margin: float) -> str:
    """Judge by standard error and distance from the nearer bound, both as shares of the bounds' width."""
    if error > _VAGUE:
        return "not identifiable"
    return "at a bound" if margin < _AT_BOUND else "accepted"


def _time_shift(table: ParameterTable) -> np.ndarray:
    """Return the direction ``(P,)`` in which only time moves: the sensor's delay up, the others down; else zeros."""
    delays = np.array([p.kind == "delay" for p in table])
    sensor = np.array([p.name.startswith("sensor") for p in table])
    direction = np.where(delays, np.where(sensor, 1.0, -1.0), 0.0)
    return direction if {-1.0, 1.0} <= set(direction) else np.zeros_like(direction)


def _shift_range(table: ParameterTable, x: np.ndarray, shift: np.ndarray) -> tuple[float, float]:
    """Return how far time may shift either way before a delay meets its bound; (0, 0) without a direction."""
    moved = shift != 0.0
    if not moved.any():
        return 0.0, 0.0
    low, high = (table.scale(np.full(len(x), s))[0] for s in (-50.0, 50.0))
    room = np.stack([(low - x)[moved] / shift[moved], (high - x)[moved] / shift[moved]])
    return float(room.min(axis=0).max()), float(room.max(axis=0).min())


def _correlation_in_time(r: np.ndarray) -> float:
    """Return the correlation of successive residuals within segments, ``(E, C, F)``, between 0 and 0.95."""
    now, later = r[:, :-1], r[:, 1:]
    both = (now != 0.0) & (later != 0.0)
    rho = float((now * later)[both].sum() / np.maximum((now**2)[both].sum(), 1e-12))
    return float(np.clip(rho, 0.0, 0.95))
