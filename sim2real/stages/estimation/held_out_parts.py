"""Optional terms of a model, and the errors of an identification on held-out parts of the recordings."""

from collections.abc import Callable, Sequence

import numpy as np

from sim2real.artifacts.identification import HeldOutPart
from sim2real.errors import UsageError
from sim2real.identify.fit import Fit
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.uncertainty.uncertainty import Uncertainty, between_parts
from sim2real.identify.validation import optional_terms
from sim2real.identify.validation.folds import MOST, Fold, folds_of, leave_out
from sim2real.identify.validation.refits import Refits
from sim2real.identify.validation.term_trials import Trials
from sim2real.robots.contract import RecordedRobot
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.terminal.console import note

LEAST = 4
"""Fewest segments from which parts are held out."""
_LEAST_TO_CHOOSE = 3
"""Fewest parts for a selection of terms: one is held out, and the others predict each other."""
_ANY_DELAY_S = 0.1
"""The parameters of a model do not depend on its longest delay, so any does [s]."""
_FEWEST = 4
"""Fewest parts from which the spread of estimates is computed."""


def widest(table: ParameterTable, wanted: str) -> ParameterTable:
    """Return the table with the optional terms of a flag; with ``auto``, all of them.

    Args:
        wanted: ``own``, ``auto``, ``all``, ``none``, or names separated by commas.
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
    """Return the robot with the optional terms that its kind offers, if a flag selects among them.

    Args:
        wanted: As in ``widest``.
    """
    return robot if wanted in ("own", "none") else robot.with_optional_terms(wanted)


def having(robot: RecordedRobot, names: Sequence[str]) -> RecordedRobot:
    """Return the robot with the optional terms of some parameters.

    Args:
        names: Names of identified parameters.
    """
    present, offered = (
        {p.name: p.term for p in r.identifiable(_ANY_DELAY_S).parameters} for r in (robot, offering(robot, "all"))
    )
    lacking = sorted({offered[name] for name in names if name in offered and name not in present})
    return offering(robot, ",".join(lacking)) if lacking else robot


def chosen(
    estimate: Fit,
    config: IdentifyConfig,
    names: Sequence[str],
    refits: Refits | None = None,
    on_set: Callable[[str], None] = lambda names: None,
) -> optional_terms.Selection:
    """Return the optional terms without which held-out parts are predicted worse.

    Args:
        estimate: The fit with all optional terms.
        names: A name for each recording; recordings of different names are different parts.
        refits: Finished refits, which are not computed again.
        on_set: Called with the names of each set of terms before it is fitted.
    """
    parts = parts_of(estimate, config, names, _LEAST_TO_CHOOSE)
    trials = Trials(estimate, parts, config.settle_s, config.free_run_s, refits or Refits(), on_set)
    if trials.segments < (count := len(estimate.problem.train)):
        note(f"sets of terms are compared on {trials.segments} of {count} segments, those with most motion")
    return optional_terms.select(trials.grown())


def examined(
    estimate: Fit,
    config: IdentifyConfig,
    names: Sequence[str],
    selection: optional_terms.Selection | None = None,
    refits: Refits | None = None,
) -> tuple[HeldOutPart, ...]:
    """Return the estimates without each part of the recordings, and their errors on that part.

    Args:
        estimate: The fit; with ``--terms auto`` the fit with all optional terms.
        names: A name for each recording; recordings of different names are different parts.
        selection: The selection of terms; None if there was none.
        refits: Finished refits, which are not computed again.
    """
    segments = len(estimate.problem.train)
    if segments < LEAST:
        note(f"{segments} segments are too few to hold parts out of the fit")
        return ()
    if selection is not None:  # the trials have these errors
        return tuple(trial.rows[k] for k, trial in enumerate(selection.by_part))
    return tuple(leave_out(estimate, parts_of(estimate, config, names), config.settle_s, config.free_run_s, refits))


def parts_of(estimate: Fit, config: IdentifyConfig, names: Sequence[str], least: int = 2) -> list[Fold]:
    """Return the parts to hold out: recordings of different names, or blocks if there are fewer than ``least``."""
    return folds_of(estimate.problem, max(2, min(config.folds, len(estimate.problem.train) // 2)), names, least)


def widened(spread: Uncertainty, table: ParameterTable, x: np.ndarray, rows: Sequence[HeldOutPart]) -> Uncertainty:
    """Return an uncertainty that includes the spread of the estimates without one part.

    Args:
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
    """
    if len(rows) < _FEWEST:
        return spread
    values = [[np.ravel(row.values[c.parameter.name])[c.recording or 0] for c in table.columns] for row in rows]
    moved = np.array(
        [[c.parameter.to_scale(v) for c, v in zip(table.columns, estimates, strict=True)] for estimates in values]
    )
    share = np.array([[row.share.get(name, 0.0) for name in table.names] for row in rows])
    if len(rows) > MOST:  # parts that were held out together have one estimate
        moved, of = np.unique(moved, axis=0, return_inverse=True)
        share = np.array([share[np.ravel(of) == g].sum(axis=0) for g in range(len(moved))])
    return between_parts(spread, table, x, moved, share)
