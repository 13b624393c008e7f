"""Optional terms of a model, and what an identification is worth on parts of the recordings that were left out."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.special import stdtrit

from sim2real.artifacts.identification import HeldOutPart
from sim2real.errors import UsageError
from sim2real.identify.fit import Fit
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.uncertainty.uncertainty import Uncertainty, between_parts, linearise
from sim2real.identify.validation import optional_terms
from sim2real.identify.validation.folds import compare_sets, folds_of, leave_out, masks
from sim2real.identify.validation.prediction import labels
from sim2real.identify.validation.verdict import Position
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.terminal.console import note

_LEAST_PARTS = 2
"""Errors of which a mean and a worst are worth saying."""
_LEAST = 4
"""Segments of which parts can be left out."""
_LEAST_TO_CHOOSE = 3
"""Parts of which one is left out, and terms chosen by how the others predict each other."""
_ANY_DELAY_S = 0.1
"""Which parameters a model has does not depend on its longest delay [s]."""
_VAGUE = 4.0
"""How many times the worst error a promise may be before the words say that it is none."""
_FEWEST = 4
"""Parts from which on they say how much estimates differ."""


def widest(table: ParameterTable, wanted: str) -> ParameterTable:
    """Return the table with the optional terms that a flag names; for ``auto`` with all of them, to choose from.

    Args:
        wanted: ``own``, ``auto``, ``all``, ``none``, or names with commas between.
    """
    if wanted == "own":
        return table
    known = tuple(dict.fromkeys(p.term for p in table if p.term))
    if wanted == "auto" and not known:
        raise UsageError(
            "this robot's model has no optional terms to choose from",
            hint="give parameters a term in the pipeline: Parameter(..., term='cogging', off=0.0)",
        )
    names = {"auto": known, "all": known, "none": ()}.get(wanted, tuple(n.strip() for n in wanted.split(",")))
    return table.with_terms(names)


def offering(robot: RecordedRobot, wanted: str) -> RecordedRobot:
    """Return the robot with the optional terms that its kind offers, where a flag chooses among some.

    Args:
        wanted: As ``widest`` takes it.
    """
    offer = getattr(robot, "with_optional_terms", None)
    return robot if offer is None or wanted in ("own", "none") else offer(wanted)


def having(robot: RecordedRobot, names: Sequence[str]) -> RecordedRobot:
    """Return the robot with its optional terms where parameters are of one.

    Args:
        names: Names of parameters that were identified.
    """
    own, every = (
        {p.name: p.term for p in r.identifiable(_ANY_DELAY_S).parameters} for r in (robot, offering(robot, "all"))
    )
    lacking = sorted({every[name] for name in names if name in every and name not in own})
    return offering(robot, ",".join(lacking)) if lacking else robot


def chosen(found: Fit, config: IdentifyConfig, names: Sequence[str]) -> optional_terms.Selection:
    """Return which optional terms are needed: without them parts that are left out are predicted worse.

    Args:
        names: Of the recordings; each is left out by itself.
    """
    problem, table = found.problem, found.problem.table
    parts = folds_of(problem, config.folds, names, _LEAST_TO_CHOOSE)
    choice = optional_terms.choose(
        optional_terms.statistics(problem, linearise(problem, found.z), masks(problem, parts)), table
    )
    sets = optional_terms.below(choice, table)
    if len(sets) == 1:
        return choice
    rows = compare_sets(found, parts, sets, config.settle_s, config.free_run_s)
    sigma = dict(zip(labels(problem), (s for _, s, _ in problem.fields), strict=True))
    scores = np.array([[_mean_square(row.ahead, sigma) for row in own] for own in rows])
    free = np.array([[_mean_square(row.free, sigma) for row in own] for own in rows])
    errors = np.sqrt(np.stack([scores.mean(axis=1), free.mean(axis=1)], axis=1))
    return optional_terms.narrowed(choice, table, scores, errors)


def _mean_square(errors: Mapping[str, float | None], sigma: Mapping[str, float]) -> float:
    """Return the mean square of errors over the deviations of a measurement; 0 where nothing moved."""
    found = [(e / sigma[name]) ** 2 for name, e in errors.items() if e is not None]
    return float(np.mean(found)) if found else 0.0


def examined(
    found: Fit, config: IdentifyConfig, names: Sequence[str], choice: optional_terms.Selection | None = None
) -> tuple[HeldOutPart, ...]:
    """Return what is identified without each part of the recordings, and how far it is off there.

    Args:
        found: The fit; with ``--terms auto`` the one with all optional terms, as each part's absence chooses anew.
        names: Of the recordings; each is left out by itself.
        choice: The terms of the model, of which each part's absence chooses some; None: nothing is chosen.
    """
    segments = len(found.problem.train)
    if segments < _LEAST:
        note(f"{segments} segments are too few to leave parts out of the fit")
        return ()
    least = 2 if choice is None else _LEAST_TO_CHOOSE
    parts = folds_of(found.problem, min(config.folds, segments // 2), names, least)
    among = None if choice is None else choice.kept
    return tuple(leave_out(found, parts, config.settle_s, choice is not None, config.free_run_s, among))


def widened(spread: Uncertainty, table: ParameterTable, x: np.ndarray, rows: Sequence[HeldOutPart]) -> Uncertainty:
    """Return an uncertainty that holds how much estimates differ without one part or another.

    Args:
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
    """
    if len(rows) < _FEWEST:
        return spread
    values = [[np.ravel(row.values[c.parameter.name])[c.recording or 0] for c in table.columns] for row in rows]
    moved = np.array([[c.parameter.to_scale(v) for c, v in zip(table.columns, own, strict=True)] for own in values])
    share = np.array([[row.share.get(name, 0.0) for name in table.names] for row in rows])
    return between_parts(spread, table, x, moved, share)


def sentences(rows: Sequence[HeldOutPart], positions: Sequence[Position], horizon_s: float) -> list[str]:
    """Return how far each position is off on parts that were left out: mean, worst, and what one more would be.

    Args:
        horizon_s: Up to which horizon [s].
    """
    if not rows:
        return []
    said = []
    for p in positions:
        for what, errors in (
            (f"up to {horizon_s:g} s ahead", _of(rows, p, "ahead")),
            ("in one go", _of(rows, p, "free")),
        ):
            if errors.size >= _LEAST_PARTS:
                unit, most = f" {p.unit}".rstrip(), further(errors)
                promise = f"95 % of further parts like these stay below {most:.2g}{unit}"
                if most > _VAGUE * errors.max():
                    promise = f"so few parts that differ so much promise no more than {most:.2g}{unit}: record more"
                said.append(
                    f"{p.name}, {what}, on parts that were left out of the fit: off by {errors.mean():.2g}{unit} on "
                    f"average, {errors.max():.2g}{unit} at worst of {errors.size}; {promise}"
                )
    return said


def further(errors: np.ndarray) -> float:
    """Return the error below which one more part stays with 95 % probability, from those of K parts ``(K,)``.

    Errors are taken to be log-normal: the upper end of a one-sided prediction interval by Student's distribution.
    """
    logs = np.log(np.maximum(errors, 1e-300))
    k = len(logs)
    return float(math.exp(logs.mean() + stdtrit(k - 1, 0.95) * logs.std(ddof=1) * math.sqrt(1.0 + 1.0 / k)))


def promises(rows: Sequence[HeldOutPart]) -> dict[str, float]:
    """Return below which error 95 % of further parts stay, up to the horizon: field -> error, where there are parts.

    The error on the one part that was held out is no such promise: half of all further parts are further off.
    """
    found = {field: _finite([row.ahead.get(field) for row in rows]) for row in rows for field in row.ahead}
    return {field: further(errors) for field, errors in found.items() if errors.size >= _LEAST_PARTS}


def _of(rows: Sequence[HeldOutPart], position: Position, kind: str) -> np.ndarray:
    return _finite([getattr(row, kind).get(position.column) for row in rows])


def _finite(errors: Sequence[float | None]) -> np.ndarray:
    return np.array([e for e in errors if e is not None and math.isfinite(e)])
