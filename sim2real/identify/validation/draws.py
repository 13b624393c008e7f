"""Predictions with draws of the posterior: intervals of trajectories, and of their errors.

Where an arm sticks is decided by how it came to rest: two models within the posterior may stop at places that are far
apart. One predicted trajectory promises nothing there, so the interval of many is given.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from sim2real.artifacts.posterior import Posterior
from sim2real.identify.problem.problem import Problem
from sim2real.identify.validation.prediction import labels

DRAWS, _FEWEST, _RUNS = 16, 4, 640
"""Draws of the posterior, each of which costs one simulation of the data; fewest draws of many segments; and how many
segments are simulated before there are fewer draws."""
LOW, HIGH, SPREAD = "low95", "high95", "spread"
"""Columns of a field: the interval of the drawn trajectories, and their deviation from that of the estimate."""
_TAIL = 0.025


def intervals(
    problem: Problem,
    columns: Mapping[str, np.ndarray],
    estimates: Mapping[str, ArrayLike],
    posterior: Posterior | None,
    settle_s: float,
) -> tuple[dict[str, np.ndarray], dict[tuple[int, str], tuple[float, float]]]:
    """Simulate all segments with draws of the posterior.

    Args:
        columns: Result of ``prediction.samples`` for the same problem, with the model ``identified``.
        estimates: Parameter -> estimate.
        posterior: None after a search without intervals: the result is empty.
        settle_s: First part of a segment, to which its initial state is fitted [s].

    Returns:
        For each field the columns ``FIELD_low95``, ``FIELD_high95`` and ``FIELD_spread``; and segment and field -> the
        95 % interval of the root mean square errors of the draws.
    """
    if posterior is None:
        return {}, {}
    count = min(DRAWS, max(_FEWEST, _RUNS // problem.segments))
    drawn = posterior.sample(np.random.default_rng(0), count)
    every, fit_s = np.arange(problem.segments), np.full(problem.segments, settle_s)
    at, names = np.nonzero(problem.ts >= 0), labels(problem)
    offsets = []
    for i in range(count):
        values = {n: drawn[n][i] if n in drawn else v for n, v in estimates.items()}
        rows = {n: np.broadcast_to(v, (problem.segments, *np.shape(v))) for n, v in values.items()}
        offsets.append(problem.predict(rows, every, fit_s)[at] * [sigma for _, sigma, _ in problem.fields])
    # Compare the drawn trajectories with the measurement, and with the trajectory of the estimate.
    off, bands, errors = np.stack(offsets), {}, {}
    counted, segment = columns["into"] > settle_s, columns["segment"]
    for k, name in enumerate(names):
        measured = columns[f"{name}_measured"]
        low, high = np.quantile(off[..., k], (_TAIL, 1.0 - _TAIL), axis=0)
        beside = measured + off[..., k] - columns[f"{name}_identified"]
        bands |= {f"{name}_{LOW}": measured + low, f"{name}_{HIGH}": measured + high}
        bands[f"{name}_{SPREAD}"] = np.sqrt(np.mean(beside**2, axis=0))
        for s in np.unique(segment):
            rmse = np.sqrt(np.mean(off[:, counted & (segment == s), k] ** 2, axis=1))
            errors[int(s), name] = tuple(np.quantile(rmse, (_TAIL, 1.0 - _TAIL)).tolist())
    return bands, errors
