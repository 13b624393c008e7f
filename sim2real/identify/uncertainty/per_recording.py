"""Each recording identified alone, from the estimate of all: how much a robot differs between recordings."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import Quantity
from sim2real.identify.fit import Fit, Value, as_numbers
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty.aggregate import aggregate
from sim2real.identify.uncertainty.uncertainty import Uncertainty, from_linearised, linearise
from sim2real.identify.validation.folds import MOST
from sim2real.identify.validation.optional_terms import statistics


def compare_recordings(estimate: Fit) -> tuple[Quantity, ...]:
    """Identify each recording alone, and combine the estimates of each quantity."""
    alone, table = identify_each(estimate), estimate.problem.table
    rows = []
    for p in (p for p in table if p.free and not p.per_recording):
        values = np.array([np.ravel(estimates[p.name])[0] for estimates, _ in alone])
        errors = np.array([spread.standard_error[table.names.index(p.name)] for _, spread in alone])
        rows.append(aggregate(values, errors, p.name, p.unit))
    return tuple(rows)


def identify_each(estimate: Fit) -> list[tuple[Mapping[str, Value], Uncertainty]]:
    """Return the estimates of each recording alone, by name, with their uncertainty.

    Each descent begins near the estimate of all recordings and stays in its optimum. So recordings differ by changes of
    the robot, and not by the optimum that a search reached. Of more than ``MOST`` recordings each takes two steps of
    Gauss and Newton, which cost a Jacobian of its segments.
    """
    problem, table = estimate.problem, estimate.problem.table
    recording = problem.recording[problem.train]
    masks = [recording == r for r in np.unique(recording)]
    at = linearise(problem, estimate.z)
    stats = statistics(problem, at, np.array(masks))
    all_terms, alone, many = np.ones(len(table.terms), bool), [], len(masks) > MOST
    for k, mask in enumerate(masks):
        data = problem.part(problem.train[~mask])
        z = table.at_scale(at.x + stats.only(k).step(table, all_terms, bounded=many))
        if not many:
            # Begin at the better of two points: the linear prediction for this recording, and the estimate of all.
            start = min((z, estimate.z), key=lambda z, data=data: np.nan_to_num(problem.loss(z, data), nan=np.inf))
            z = refine(problem, start[None], data, settle=False).z
        end = linearise(problem, z, data)  # all segments at the end of each recording took K^2 simulations
        if many:
            step = statistics(problem, end, mask[None]).step(table, all_terms, bounded=True)
            change, z = end.jacobian @ step, table.at_scale(end.x + step)
            end = replace(end, residuals=end.residuals + change, raw=end.raw + change, x=end.x + step)
        # Compute the uncertainty from the residuals of this recording.
        part = replace(end, residuals=end.residuals[mask], jacobian=end.jacobian[mask], raw=end.raw[mask],
            compared=end.compared[mask])  # fmt: skip
        alone.append((as_numbers(table, z), from_linearised(problem, part)))
    return alone
