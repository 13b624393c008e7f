"""Each recording identified by itself, from the estimate of all: how much a robot differs from one to the next."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sim2real.identify.fit import Fit, as_numbers
from sim2real.identify.search.refine import refine
from sim2real.identify.uncertainty.uncertainty import Uncertainty, from_linearised, linearise
from sim2real.identify.validation.optional_terms import statistics


def identify_each(found: Fit) -> list[tuple[Mapping[str, Any], Uncertainty]]:
    """Return what each recording says by itself, with its uncertainty, in order.

    A descent from where the others led stays in their optimum: what differs is the robot, not which optimum was found.
    """
    problem, table = found.problem, found.problem.table
    of = problem.recording[problem.train]
    rows = [of == r for r in np.unique(of)]
    at = linearise(problem, found.z)
    stats = statistics(problem, at, np.array(rows))
    every, single = np.ones(len(table.terms), bool), []
    for k, own in enumerate(rows):
        data = problem.part(problem.train[~own])
        starts = (table.at_scale(at.x + stats.only(k).step(table, every)), found.z)
        start = min(starts, key=lambda z, data=data: np.nan_to_num(problem.loss(z, data), nan=np.inf))
        z = refine(problem, start[None], data, settle=False).z
        there = linearise(problem, z)
        alone = replace(there, residuals=there.residuals[own], jacobian=there.jacobian[own], raw=there.raw[own])
        single.append((as_numbers(table, z), from_linearised(problem, alone)))
    return single
