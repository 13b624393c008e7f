"""What a model lacks: a term, an inclined base, an elastic transmission; and the second that it predicts worst.

Residuals far above the noise, and errors of free runs, show it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from sim2real.artifacts.identification import Identification, Noise, with_small_unit
from sim2real.identification.fit import ROUGH, as_numbers, refine
from sim2real.identification.predictions import Position
from sim2real.identification.residuals import Linearised, Problem
from sim2real.identification.terms import ALIKE, MENDS
from sim2real.identification.uncertainty import FLOOR

_FAR = 3.0
"""A term is missing if the residuals are above this many times the noise."""
_ALONE = 1.5
"""A log has a fault in its worst second if the error there is this many times the joint's error in the whole log."""
_PROMISING = 0.95
"""Directions of gravity are tried if, by linear algebra, a turn lowers the residuals to less than this share."""
_GRAVITY = 10.0
"""Directions of gravity are tried if the residuals are above this many times the noise."""
TILT, _TURNS = "tilt", (-1.6, -0.8, -0.3, 0.3, 0.8, 1.6, 3.1)
"""The optional term of an inclined base, and the turns about each of its axes that are simulated [rad]."""
_UNEXPLAINED = 50.0
"""A fit is not accepted if the residuals are above this many times the noise: real motors leave 5 to 32 times. A base
at 40 degrees left 120 times, and an elastic belt 57 times, with wrong estimates in narrow intervals.
"""
_RINGS = 1 / 3
"""A transmission is elastic if a resonance explains at least this share of the residuals."""
_RUNG, _LEAST_RUNG, _SLOWEST_HZ, _DAMPED = 20, 30, 2.5, 0.05
"""Search of a resonance: most segments, fewest samples of a segment, lowest frequency, damping ratio."""
_GIVES_WAY = (
    "a belt, a gear or a mount gives way; the delay includes its lag, so these are no estimates. Measure at the motor, "
    "or make it stiffer"
)
_CAUSES = (
    "look for a gear or a unit of the command, the direction of gravity, a transmission that gives way, an encoder's "
    "zero, or commands that are logged more seldom than they act"
)


@dataclass(frozen=True)
class Lack:
    """What the model lacks.

    Attributes:
        reasons: Sentences on residuals and free runs.
        flags: Flags with which to identify again; "": no term improves the model enough.
        unexplained: Whether the residuals are so far above the noise that no parameter can be trusted.
    """

    reasons: tuple[str, ...] = ()
    flags: str = ""
    unexplained: bool = False


def find_lack(
    document: Identification,
    positions: Sequence[Position],
    noises: Sequence[Noise],
    inclined: Callable[[], tuple[float, dict[str, float]] | None],
) -> Lack:
    """Return what a model lacks.

    Args:
        document: With samples, errors on held-out parts, terms, and the worst second.
        inclined: Called if gravity may have another direction; see ``turned_gravity``.
    """
    chosen, reasons, flags, unexplained = [*(document.used_terms or ())], list[str](), "", False
    worst = largest_residual(document, noises, positions)
    if worst is not None and worst[1] > _FAR:
        # Compare the residuals with the noise, and find the term that lowers them.
        position, ratio, level = worst
        unit = f" {position.unit}".rstrip()
        sentence = f"residuals of {position.name} are {ratio:.2g} times its noise of {level:.2g}{unit}"
        tried = [t for t in document.terms or () if t.gain is not None]
        best = max((t for t in tried if not t.used), key=lambda t: t.gain or 0.0, default=None)
        gain = best.gain or 0.0 if best is not None else 0.0
        if not tried:
            reasons.append(f"{sentence}: the model lacks something; no optional term was tried")
        elif best is None or gain <= 1.0 - 1.0 / ALIKE:
            reasons.append(f"{sentence}; no further term lowers the error on held-out parts by a tenth")
        else:
            with_it = f"--terms {','.join([*chosen, best.name])}"
            flags = with_it if gain > 1.0 - MENDS else ""
            reasons.append(f"{sentence}; {best.name} lowers the error on held-out parts by {gain:.0%}: {with_it}")
        # A base that is mounted at an angle makes all other estimates wrong.
        if ratio > _GRAVITY and not flags and (leaning := inclined()) is not None:
            share, turns = leaning
            how = " and ".join(f"{angle:+.2f} rad ({name})" for name, angle in turns.items())
            wide = (f"--bounds {name} -3.15 3.15" for name in turns)
            flags = " ".join([f"--terms {','.join([*chosen, TILT])}", *wide])
            reasons.insert(
                0,
                f"with gravity turned by {how} the squared residuals are {share:.0%} smaller: is the base at an angle? "
                f"turn the gravity of the model, or identify the angle: {flags}",
            )
        share, hz = ringing(document.samples, position.column)
        if share > _RINGS:
            reasons.insert(0, f"{position.name} rings at {hz:.2g} Hz, beyond what the model explains: {_GIVES_WAY}")
        elif ratio > _UNEXPLAINED:
            reasons[-1] += f"; parameters that explain so little are no estimates: {_CAUSES}"
        unexplained = share > _RINGS or ratio > _UNEXPLAINED
    if (run := farthest_run(document, positions)) is not None:
        position, error, share = run
        size = "diverges"
        if math.isfinite(error):
            size = f"is off by {with_small_unit(error, position.unit)}, {share:.1%} of its range"
        seconds = max(r.seconds for r in document.errors if r.free_run and r.joint == position.name)
        reasons.append(f"in free runs of {seconds:.3g} s on held-out parts {position.name} {size}")
    # A fault in fitted data changes no held-out error, so it decides nothing; but it may explain large residuals.
    fault, alone = unexplained_second(document)
    if fault:
        reasons.insert(0 if alone and unexplained else len(reasons), fault)
    return Lack(tuple(reasons), flags, unexplained)


def unexplained_second(document: Identification) -> tuple[str, bool]:
    """Return a sentence if the model does not explain the worst second, and whether it explains the others."""
    worst = document.worst
    if worst is None or not worst.unexplained:
        return "", False
    off = document.samples[f"{worst.field}_measured"] - document.samples[f"{worst.field}_identified"]
    alone = worst.error is None or worst.error > _ALONE * float(np.sqrt(np.nanmean(off**2)))
    return f"the model does not explain the worst second: {worst}; look at the log there", alone


def turned_gravity(problem: Problem, values: Mapping[str, float]) -> tuple[float, dict[str, float]] | None:
    """Return by which share another direction of gravity lowers the loss, and its turns by name [rad].

    None if no direction halves the error. Turns in all directions are simulated, with the estimates and with the
    nominal values, because a wrong direction makes estimates wrong. The better one is refined.

    Args:
        problem: A model with the term of an inclined base.
        values: The estimates without it.
    """
    table = problem.table
    estimate = table.encode({**{p.name: p.without for p in table}, **values})
    columns = np.array([c.term == TILT for c in table.columns])
    # Search only if a small turn would help, by linear algebra, or half a turn, as of a robot at a ceiling.
    if not (_promises(problem.linearise(estimate), columns) or _half_turn_helps(problem, estimate, columns)):
        return None
    starts = []
    for x in (estimate, table.start()):
        candidates = np.repeat(x[None], 1 + len(_TURNS) * int(columns.sum()), axis=0)
        for k, (column, angle) in enumerate(product(np.flatnonzero(columns), _TURNS), 1):
            candidates[k, column] = angle
        losses = np.nan_to_num(problem.losses(candidates, x), nan=np.inf)
        if np.argmin(losses):
            starts.append(candidates[int(np.argmin(losses))])
    if not starts:
        return None
    before = refine(problem, estimate[None], problem.part(present=~columns), gain=ROUGH)
    after = refine(problem, np.stack(starts), gain=ROUGH)
    if not after.loss < MENDS**2 * before.loss:
        return None
    found = as_numbers(table, after.x)
    return 1.0 - after.loss / before.loss, {c.name: found[c.name] for c in table.columns if c.term == TILT}


def _promises(at: Linearised, columns: np.ndarray) -> bool:
    """Return whether a linear step with some further parameters lowers the residuals by another 5 %."""
    J, r = at.jacobian.reshape(-1, len(at.x)), at.residuals.reshape(-1)
    left = [np.linalg.norm(r - J[:, which] @ np.linalg.lstsq(J[:, which], r, rcond=None)[0]) for which in (
        ~columns, np.ones_like(columns))]  # fmt: skip
    return bool(left[1] < _PROMISING * left[0])


def _half_turn_helps(problem: Problem, x: np.ndarray, columns: np.ndarray) -> bool:
    """Return whether half a turn about one of the axes lowers the loss; the derivative cannot show it."""
    turned = x + math.pi * np.eye(len(x))[columns]
    straight, *others = problem.losses(np.concatenate([x[None], problem.table.within(turned)]), x)
    return bool(np.nan_to_num(others, nan=np.inf).min() < _PROMISING**2 * straight)


def largest_residual(
    document: Identification, noises: Sequence[Noise], positions: Sequence[Position]
) -> tuple[Position, float, float] | None:
    """Return the position with the largest ratio of residuals to noise, the ratio, and the noise; None if unknown."""
    rows = []
    for p in positions:
        of = next((n for n in noises if n.field == p.column), None)
        if of is None:
            continue
        off = document.samples[f"{p.column}_measured"] - document.samples[f"{p.column}_identified"]
        off = off[np.isfinite(off) & (document.samples["into"] > document.internal.settle_s)]
        level = max(float(np.hypot(of.deviation, of.resolution / np.sqrt(12.0))), FLOOR * p.sigma)
        if off.size:
            rows.append((p, float(np.sqrt(np.mean(off**2))) / level, level))
    return max(rows, key=lambda row: row[1], default=None)


def farthest_run(document: Identification, positions: Sequence[Position]) -> tuple[Position, float, float] | None:
    """Return the position with the largest mean error of free runs as a share of its range, the error, the share."""
    rows = []
    for p in positions:
        errors = [row.error for row in document.errors if row.free_run and row.joint == p.name]
        if errors:
            error = float(np.mean([math.inf if e is None else e for e in errors]))
            rows.append((p, error, error / max(float(np.ptp(document.samples[f"{p.column}_measured"])), 1e-300)))
    return max(rows, key=lambda row: row[2], default=None)


def ringing(samples: Mapping[str, np.ndarray], column: str) -> tuple[float, float]:
    """Return the largest share of a position's residuals that one resonance explains, and its frequency [Hz].

    An elastic transmission moves the link relative to its drive by y, with y'' + 2 d w y' + w^2 y = -q'' for the
    predicted motion q. At each frequency the residuals are fitted by y and y', together with speed, acceleration, dry
    friction and the free oscillation of each segment. With belts the share was 0.37 and more, on five real robots 0.27
    at most.
    """
    from scipy.signal import cont2discrete, lfilter  # 0.2 s

    # Put the fitted segments onto one grid of time.
    chosen = np.unique(samples["segment"][~samples["held_out"].astype(bool)])
    rows = [np.flatnonzero(samples["segment"] == s) for s in chosen[:: -(-len(chosen) // _RUNG) or 1]]
    into = [samples["into"][r].astype(np.float64) for r in rows]
    if not rows or min(map(len, into)) < _LEAST_RUNG:
        return 0.0, 0.0
    step_s, length_s = float(np.median(np.diff(into[0]))), min(float(t[-1] - t[0]) for t in into)
    grid = np.arange(0.0, length_s, step_s)
    parts = list(zip(into, rows, strict=True))
    at = lambda name: np.stack([np.interp(grid, t - t[0], samples[name][r]) for t, r in parts])  # noqa: E731
    predicted = at(f"{column}_identified")
    off = at(f"{column}_measured") - predicted
    if not np.isfinite(predicted).all():
        return 0.0, 0.0
    speed = np.gradient(predicted, step_s, axis=1)
    acceleration, best = np.gradient(speed, step_s, axis=1), (0.0, 0.0)
    for hz in np.geomspace(_SLOWEST_HZ, max(min(0.35 / step_s, 60.0), _SLOWEST_HZ), 25):
        w = 2.0 * np.pi * float(hz)
        discrete: Any = cont2discrete(([1.0], [1.0, 2.0 * _DAMPED * w, w * w]), step_s, "foh")
        beside = lfilter(discrete[0].ravel(), discrete[1], -acceleration, axis=1)
        free = np.exp(-_DAMPED * w * grid)
        own = np.stack([grid**0, grid, free * np.cos(w * grid), free * np.sin(w * grid)], axis=1)
        basis = np.linalg.qr(own)[0]
        columns = (speed, acceleration, np.sign(speed), beside, np.gradient(beside, step_s, axis=1))
        r, *J = (v - v @ basis @ basis.T for v in (off, *columns))
        J = np.stack([j.ravel() / (np.linalg.norm(j) + 1e-12) for j in J], axis=1)
        squares = [
            float(np.sum((r.ravel() - c @ np.linalg.lstsq(c, r.ravel(), rcond=None)[0]) ** 2)) for c in (J[:, :3], J)
        ]
        best = max(best, (1.0 - squares[1] / max(squares[0], 1e-300), float(hz)))
    return best
