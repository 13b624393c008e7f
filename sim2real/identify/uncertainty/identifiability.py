"""The parameters that recordings determine: conditioning, and combinations of parameters that they leave open."""

from collections.abc import Collection, Sequence
from fractions import Fraction

import numpy as np

from sim2real.artifacts.identification import Determined
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.uncertainty.uncertainty import VAGUE, Linearised, linearise

_PART = 0.1
"""Smallest entry with which a parameter takes part in a direction, as a share of the largest entry."""


def check(problem: Problem, z: np.ndarray) -> Determined:
    """Return which parameters the problem's segments determine at ``z (P,)``, with the noise of the channels alone."""
    return from_linearised(problem, linearise(problem, z))


def from_linearised(problem: Problem, at: Linearised, without: Collection[str] = ()) -> Determined:
    """Return which parameters the data determines at a linearised point.

    Args:
        without: Names of parameters that may be absent, which the result does not count.
    """
    table = problem.table
    J = at.jacobian.reshape(-1, len(at.x)) * table.span  # per width of the bounds
    held = np.isin(table.names, list(without))
    J[:, held] = 0.0
    # Compute the condition number from the eigenvalues, and the directions that the data leaves open.
    information = J.T @ J
    weights, axes = np.linalg.eigh(information)
    largest = float(weights[-1])
    gone = int(held.sum())  # absent parameters are 0 by construction
    least = float(weights[gone]) if gone < len(weights) else largest
    condition = float(np.sqrt(largest / max(least, largest * 1e-14, 1e-300)))
    loose = weights < 1.0 / VAGUE**2
    # Compute the standard errors to expect from one minute of such data.
    prior = at.prior * np.outer(table.span, table.span)
    duration_s = problem.segment_s * len(problem.train)
    slope = np.abs(table.slope(at.x)) * table.span
    minute = np.sqrt(np.diag(np.linalg.inv(information * 60.0 / duration_s + prior))) * slope
    open_axes = np.where(held[:, None], 0.0, axes)[:, loose]
    # In widths of the bounds, so that a second is no smaller than a logarithm.
    open_axes = open_axes[:, np.abs(open_axes).max(axis=0, initial=0.0) > 1e-9]
    groups = _groups(open_axes)
    combinations = tuple(_determined(table, open_axes * table.span[:, None], g) for g in groups)
    undetermined = tuple(tuple(table.names[i] for i in g) for g in groups)
    expected = dict(zip(table.names, minute.tolist(), strict=True))
    return Determined(condition, undetermined, messages_of(combinations, undetermined), expected)


def messages_of(combinations: Sequence[str], groups: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return a sentence for each group of parameters that the data does not determine one by one.

    Args:
        combinations: The combination of each group that the data determines, such as ``K/(R J)``; "" if there is none.
    """
    return tuple(
        f"only {what} is determined: fix {len(names) - what.count(' and ') - 1} of {', '.join(names)}, or accept "
        "what is determined"
        if what
        else f"nothing in this data determines {', '.join(names)}: excite it, fix it or give it a prior"
        for what, names in zip(combinations, groups, strict=True)
    )


def _groups(directions: np.ndarray) -> list[list[int]]:
    """Return which parameters move together along directions ``(P, k)`` that the data does not determine."""
    if not directions.shape[1]:
        return []
    spread = directions @ directions.T  # (P, P): the projection onto them, the same in any basis
    part = np.sqrt(np.diag(spread))
    taking = part > _PART * part.max()
    groups: list[list[int]] = []
    # Parameters that move together in an undetermined direction form a group.
    for i in np.flatnonzero(taking):
        for group in groups:
            if any(abs(spread[i, j]) > _PART**2 * part[i] * part[j] for j in group):
                group.append(int(i))
                break
        else:
            groups.append([int(i)])
    return groups


def _determined(table: ParameterTable, directions: np.ndarray, group: list[int]) -> str:
    """Return the determined combination of a group: a product of powers, or a sum; "" if there is none."""
    part = directions[group]
    u, size, _ = np.linalg.svd(part, full_matrices=True)
    rank = int((size > 0.05 * size[0]).sum())
    determined = u[:, rank:].T  # orthogonal to the directions: determined
    if not len(determined):
        return ""
    reduced = _row_reduce(determined)
    columns = [table.columns[i] for i in group]
    scales = {c.parameter.transform for c in columns}
    names = [c.label for c in columns]
    write = _product if scales == {"log"} else _sum
    return " and ".join(write(names, row) for row in reduced)


def _row_reduce(rows: np.ndarray) -> np.ndarray:
    """Return the rows in reduced echelon form; entries near small fractions are rounded to them."""
    rows = rows.copy()
    pivots: list[int] = []
    for r in range(len(rows)):
        free = [c for c in range(rows.shape[1]) if c not in pivots]
        largest = max(abs(rows[r, c]) for c in free)
        # Take the first of nearly equal entries, so that rounding does not decide.
        pivot = next(c for c in free if abs(rows[r, c]) >= 0.9 * largest)
        pivots.append(pivot)
        rows[r] /= rows[r, pivot]
        for other in range(len(rows)):
            if other != r:
                rows[other] -= rows[other, pivot] * rows[r]
    rounded = np.vectorize(lambda v: float(Fraction(float(v)).limit_denominator(4)))(rows)
    return np.where(np.abs(rounded - rows) < 0.1, rounded, rows)


def _product(names: list[str], powers: np.ndarray) -> str:
    def factor(name: str, power: float) -> str:
        return name if abs(abs(power) - 1.0) < 1e-9 else f"{name}^{abs(power):.2g}"

    above = [factor(n, p) for n, p in zip(names, powers, strict=True) if p > 0.05]
    below = [factor(n, p) for n, p in zip(names, powers, strict=True) if p < -0.05]
    if not below:
        return " ".join(above)
    return f"{' '.join(above) or '1'}/{below[0] if len(below) == 1 else '(' + ' '.join(below) + ')'}"


def _sum(names: list[str], weights: np.ndarray) -> str:
    text = ""
    for name, weight in zip(names, weights, strict=True):
        if abs(weight) < 0.05:
            continue
        size = "" if abs(abs(weight) - 1.0) < 1e-9 else f"{abs(weight):.2g} "
        text += (" - " if weight < 0 else " + " if text else "") + size + name
    return text.strip()
