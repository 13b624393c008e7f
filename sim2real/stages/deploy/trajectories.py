"""Whole episodes on the robot beside simulations of the same policy: where joints are, and how far they move."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sim2real.artifacts.deployment import Course, Deployment, Replay
from sim2real.log.schema import unit_of

_EARLIER_S = 0.1
"""By how much a simulation may be early or late; whole swings more or less lie between different simulations."""
_SHARE = 0.1
"""Share of an episode that may lie further beside the simulations."""
_LEAST = 10
"""Samples of an episode that can be compared."""
_HALVES = ("first", "second")
_OFF = 3.0
"""Up to this many times what the identification promised, the model holds, as for commands that are played again."""
Columns = tuple[np.ndarray, Mapping[str, np.ndarray]]
"""Times ``(N,)`` [s] and columns ``(N,)``."""


def courses(real: Sequence[Columns], simulated: Sequence[Columns], units: Mapping[str, str]) -> tuple[Course, ...]:
    """Return how each measured column went in each episode, beside its simulations.

    Args:
        simulated: The simulations of all episodes; number e is of episode ``e % len(real)``.
        units: Field -> unit.
    """
    rows = []
    for number, (t_s, columns) in enumerate(real):
        own = simulated[number :: len(real)]
        names = [n for n, v in columns.items() if v.dtype.kind == "f" and all(n in c for _, c in own)]
        for name in names if own and len(t_s) >= _LEAST else ():
            beside = np.stack([np.interp(t_s, t, c[name]) for t, c in own])
            rows.append(_course(number, name, t_s, columns[name], beside, unit_of(name, units) == "rad"))
    return tuple(rows)


def off_course(deployed: Deployment) -> Iterator[str]:
    """Return sentences about joints that went otherwise than in simulation, over whole episodes.

    Args:
        deployed: With courses, and what the identification promised for each position.
    """
    promised = {row.column: row for row in deployed.replay if row.promised is not None}
    for course in deployed.courses:
        if row := promised.get(course.column):
            yield from _sentences(course, row)


def _course(number: int, name: str, t_s: np.ndarray, real: np.ndarray, beside: np.ndarray, angle: bool) -> Course:
    """Return one column of one episode, ``real`` ``(N,)`` beside simulations ``(S, N)`` at the same times."""
    shifts = round(_EARLIER_S / float(np.median(np.diff(t_s))))
    padded = np.pad(beside, ((0, 0), (shifts, shifts)), mode="edge")
    low, high = np.full(len(real), np.inf), np.full(len(real), -np.inf)
    for shift in range(2 * shifts + 1):
        gap = padded[:, shift : shift + len(real)] - real
        gap = (gap + np.pi) % (2 * np.pi) - np.pi if angle else gap
        low, high = np.minimum(low, gap.min(axis=0)), np.maximum(high, gap.max(axis=0))
    outside = np.maximum(0.0, np.maximum(low, -high))
    halves = np.array_split(np.arange(len(real)), len(_HALVES))
    ranges = [np.ptp(beside[:, half], axis=1) for half in halves]
    return Course(
        episode=number,
        column=name,
        beside=float(np.quantile(outside, 1.0 - _SHARE)),
        moved=tuple(float(np.ptp(real[half])) for half in halves),
        least=tuple(float(r.min()) for r in ranges),
        most=tuple(float(r.max()) for r in ranges),
    )


def _sentences(course: Course, row: Replay) -> Iterator[str]:
    """Return what is wrong with a course, given what was promised of its position."""
    promised = row.promised or 0.0
    unit = f" {row.unit}".rstrip()
    where = f"{row.name} in episode {course.episode}"
    far = max(promised, row.free_run or 0.0)
    if course.beside > _OFF * far:
        yield (
            f"{where} is {course.beside:.2g}{unit} or more beside all simulations of the policy for {_SHARE:.0%} "
            f"of the time; promised were {far:.2g}{unit}"
        )
    for half, moved, least, most in zip(_HALVES, course.moved, course.least, course.most, strict=True):
        seen = f"{where} moves by {moved:.2g}{unit} in the {half} half"
        if least > _OFF * (moved + promised):
            yield f"{seen}, in each simulation of the policy by {least:.2g}{unit} or more"
        elif moved > _OFF * (most + promised):
            yield f"{seen}, in no simulation of the policy by more than {most:.2g}{unit}"
