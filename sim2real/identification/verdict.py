"""The verdict on an identification: judged on held-out parts, joint by joint."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from sim2real.artifacts.identification import (
    ROUND_TRIP,
    WITHOUT_DELAYS,
    ComparedError,
    Estimate,
    ExpectedError,
    Judgement,
    with_small_unit,
)
from sim2real.identification.held_out import HeldOutPart
from sim2real.identification.lacks import Lack
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.uncertainty import ABSENT, BOUND, NOT_REACHED, OK, Determined, Uncertainty

Status = Literal["accepted", "record again", "change the model", "not finished"]
ACCEPTED: Status = "accepted"
RECORD: Status = "record again"
CHANGE: Status = "change the model"
NOT_FINISHED: Status = "not finished"
_BETTER = 0.95
"""Delays are needed if the error is below this share of the error without delays."""
_MOST = 3
"""Number of joints, the worst first, that reasons name."""
_WIDER = 4.0
"""Factor by which a bound on a logarithmic scale is widened."""
_LONGEST_S = 1.0
"""Longest delay that a suggested flag allows [s]."""
_SECOND = "record a second log like "
"""Words with which an advice begins within a reason."""
_ALONE = 0.99
"""One part of the recordings determines a parameter alone if it holds this share of the information on it."""
_APART = 2.0
"""That part decides the expected error if the error on it is this many times the error on each other part."""


def judge(
    held_out: Sequence[ComparedError],
    table: ParameterTable,
    x: np.ndarray,
    spread: Uncertainty,
    check: Determined,
    *,
    max_delay_s: float = 1.0,
    widened: Collection[str] = (),
    doubts: Sequence[str] = (),
    left: float | None = None,
    exceeded: Sequence[str] = (),
    lacks: Lack = Lack(),  # noqa: B008 - frozen
    too_seldom: str = "",
    offers_terms: Callable[[], bool] = lambda: False,
) -> Judgement:
    """Judge an identification; ``next`` of the result are flags with which to identify again.

    Args:
        held_out: Errors of the joints, the worst first.
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
        max_delay_s: Longest delay of the model [s].
        widened: Parameters whose bounds the user has set already: wider bounds did not help.
        doubts: Further sentences, which do not change the status.
        left: Largest move in the next step of a fit that did not converge [standard errors]; None if it converged.
        exceeded: Sentences about errors on held-out parts above the expected ones.
        lacks: What the model lacks.
        too_seldom: A sentence on a log whose commands are logged too seldom for its motion, or "".
        offers_terms: Whether ``--terms auto`` would compare terms that the model lacks.
    """
    improves, errors = _on_held_out(held_out)
    if left is not None:
        why = (_not_converged(left), *errors, *doubts, *exceeded, *lacks.reasons)
        return Judgement(RECORD, (too_seldom, *why)) if too_seldom else Judgement(NOT_FINISHED, why)
    # Collect the reasons: estimates at bounds, absent parameters, undetermined groups.
    determined = [i for i, n in enumerate(table.names) if not any(n in group for group in check.undetermined)]
    bounded, at_zero, flags = _at_bounds(table, x, spread, determined, max_delay_s, widened)
    undetermined = list(check.messages)
    reasons = [*errors, *doubts, *bounded, *_absent(table, spread)]
    reasons += [f"{name} is estimated at its lowest possible value, 0; the fit is the same with 0" for name in at_zero]
    reasons += undetermined
    # The first rule that holds decides the status, and its sentences come first. Terms come before bounds, because a
    # missing     # term drives other parameters to their bounds; a new recording helps only once terms and bounds are
    # right.
    lacking = [*lacks.reasons, *exceeded]
    rules: tuple[tuple[bool, Status, Sequence[str]], ...] = (
        (bool(lacks.flags), CHANGE, lacking),
        (improves and not bounded and bool(undetermined), RECORD, undetermined),
        (not improves, CHANGE, errors),
        (bool(bounded), CHANGE, bounded),
        (lacks.unexplained, CHANGE, lacking),
        (bool(exceeded), CHANGE, exceeded),
        (True, ACCEPTED, errors),
    )
    status, deciding = next((status, why) for holds, status, why in rules if holds)
    flags = lacks.flags or flags
    if status == CHANGE and too_seldom:  # no model explains a motion whose commands are missing in the log
        status, deciding, flags = RECORD, [too_seldom, *deciding], ""
    elif status == CHANGE and not (flags or lacks.unexplained) and offers_terms():
        flags = "--terms auto"
    if status == CHANGE and undetermined and not (flags or bounded):  # no flag helps; a motion that determines them may
        status, deciding = RECORD, [*deciding, *undetermined]
    return Judgement(status, tuple(dict.fromkeys([*deciding, *reasons, *exceeded, *lacks.reasons])), flags)


def estimates(
    table: ParameterTable,
    values: Mapping[str, float],
    spread: Uncertainty | None = None,
    truth: Mapping[str, float] = MappingProxyType({}),
) -> tuple[Estimate, ...]:
    """Return a row for each parameter, the identified ones first; the last row is the sum of the delays.

    Args:
        spread: None: the estimates have no intervals.
        truth: Known values of parameters, in a simulation. Only the sum of the delays has a true value: how it is split
            between commands and measurements is a convention.
    """
    rows = []
    for p in (*table.columns, *(p for p in table if not p.free)):
        value, numbers, state = values[p.name], dict[str, float](), "not determined" if p.free else "fixed"
        if not p.free:
            numbers = {"standard_error": 0.0, "low95": value, "high95": value}
        elif spread is not None:
            i = table.names.index(p.name)
            ends = spread.standard_error[i], spread.low[i], spread.high[i]
            numbers = dict(zip(("standard_error", "low95", "high95"), map(float, ends), strict=True))
            x = p.to_scale(value)
            state = _state_of(spread.state[i], p, bool(table.high[i] - x < x - table.low[i]))
        own = None if p.kind == "delay" and ROUND_TRIP in truth else truth.get(p.name)
        row = Estimate(p.name, p.unit, p.kind, p.about, p.nominal, value, state, lower=p.low, upper=p.high, truth=own)
        rows.append(replace(row, **numbers))
    # The sum of all delays, of which one is identified.
    delays = [row for row in rows if row.kind == "delay"]
    free, held = [r for r in delays if r.state != "fixed"], [r.estimate for r in delays if r.state == "fixed"]
    if len(free) == 1:
        ends = {n: getattr(free[0], n) for n in ("estimate", "low95", "high95", "lower", "upper")}
        ends = {n: None if value is None else value + sum(held) for n, value in ends.items()}
        about, own = " + ".join(row.name for row in delays), truth.get(ROUND_TRIP)
        rows.append(replace(free[0], name=ROUND_TRIP, kind="derived", about=about, nominal=0.0, truth=own, **ends))
    return tuple(rows)


def _state_of(verdict: str, p: Parameter, upper: bool) -> str:
    if verdict == BOUND:
        return "ok" if is_physical(p, upper) else verdict
    return "ok" if verdict in (OK, ABSENT) else "not determined"


def decisive_part(parts: Sequence[HeldOutPart], expected: Sequence[ExpectedError], fields: Mapping[str, str]) -> str:
    """Return a sentence about a part that decides the expected error because it alone determines parameters, or "".

    A fit without the part leaves these parameters near their nominal values, and predicts the part far worse than a fit
    of all recordings.

    Args:
        fields: Joint -> its measured field.
    """
    for row in expected:
        errors = [(part.free if row.free_run else part.ahead).get(fields[row.joint]) for part in parts]
        sizes = [e if e is not None and math.isfinite(e) else 0.0 for e in errors]
        order = sorted(range(len(parts)), key=lambda k: -sizes[k])
        if len(parts) < 2 or sizes[order[0]] < _APART * sizes[order[1]] or sizes[order[0]] < row.error / _APART:
            continue
        part = parts[order[0]]
        if names := [name for name, share in part.share.items() if share > _ALONE]:
            error = f"{with_small_unit(row.error, row.unit)} {row.how}"
            return (
                f"{part.name} alone determines {', '.join(names)}: the expected error of {row.joint}, {error}, is that "
                f"of a fit without it; {_SECOND}{part.name}"
            )
    return ""


def advised(reasons: Sequence[str]) -> str:
    """Return the advice in reasons on which log to record; "" without an advice."""
    return next((_SECOND + reason.partition(_SECOND)[2] for reason in reasons if _SECOND in reason), "")


def _not_converged(left: float) -> str:
    """Return the reason why a fit has no intervals."""
    return (
        f"the fit ended before its loss had a minimum: the next step would move an estimate by {left:.2g} standard "
        "errors, so there are no intervals"
    )


def _absent(table: ParameterTable, spread: Uncertainty) -> list[str]:
    """Return a sentence about each parameter that may be absent."""
    messages = []
    for i, name in enumerate(table.names):
        unit = table.columns[i].unit
        if spread.state[i] == ABSENT:
            bound = f"at most {spread.high[i]:.2g} {unit} (95 %)"
            messages.append(f"{name} is small: {bound}, and it may be 0")
        elif spread.state[i] == NOT_REACHED:
            bound = f"it is at least {spread.low[i]:.2g} {unit} (95 %)"
            above = "no larger value changes the predictions for these recordings"
            messages.append(f"{name} is not reached: {bound}, and {above}")
    return messages


def _on_held_out(held_out: Sequence[ComparedError]) -> tuple[bool, list[str]]:
    """Return whether every joint beats every baseline on held-out parts, and sentences about it."""
    if not held_out:
        return True, ["no part was held out: the error of its predictions is unknown"]
    worse = [row for row in held_out if row.as_good]
    reasons = [_beside_baselines(row) for row in (worse or held_out)[:_MOST]]
    if (more := len(worse or held_out) - _MOST) > 0:
        reasons.append(f"nor are {more} more joints" if worse else f"{more} more joints improve at least as much")
    if not worse and not any(_needs_delay(row) for row in held_out):
        reasons.append("without delays it predicts as well: this data needs none")
    return not worse, reasons


def _beside_baselines(row: ComparedError) -> str:
    """Return the error of a joint with the baselines that are as good, or else with the best baseline."""
    sentence = str(replace(row, expected=None))
    finite = {name: e for name, e in row.baselines.items() if e is not None and name != WITHOUT_DELAYS}
    if row.as_good:
        better = (f"{name} ({with_small_unit(finite[name], row.unit)})" for name in row.as_good)
        return f"{sentence}, no better than {', '.join(better)}"
    best = min(finite, key=lambda name: finite[name], default="")
    return f"{sentence}; the best baseline, {best}, by {with_small_unit(finite[best], row.unit)}" if best else sentence


def _needs_delay(row: ComparedError) -> bool:
    """Return whether the same model without delays is worse."""
    other = row.baselines.get(WITHOUT_DELAYS, math.inf)
    return other is None or (row.error is not None and row.error < _BETTER * other)


def _at_bounds(
    table: ParameterTable,
    x: np.ndarray,
    spread: Uncertainty,
    determined: Sequence[int],
    max_delay_s: float,
    widened: Collection[str],
) -> tuple[list[str], list[str], str]:
    """Return sentences about estimates at a bound, names of estimates at their lowest possible value, and flags.

    The flags widen the bounds of parameters that are ``determined`` and not ``widened`` yet: others would not improve.
    """
    messages, at_zero, flags = [], [], []
    for i in determined:
        if spread.state[i] != BOUND:
            continue
        p = table.columns[i]
        upper = bool(table.high[i] - x[i] < x[i] - table.low[i])
        if is_physical(p, upper):
            at_zero.append(p.name)
        else:
            flags.append("" if p.name in widened else way_out(p, upper, max_delay_s))
            messages.append(_bound(p.name, upper, f"{p.high if upper else p.low:.4g} {p.unit}", flags[-1]))
    return messages, at_zero, " ".join(dict.fromkeys(f for f in flags if f))


_CAUSES = (
    "wider bounds do not help: look for a gear or a unit of the command, the direction of gravity, an encoder's zero, "
    "or commands that are logged more seldom than they act"
)


def _bound(name: str, upper: bool, bound: str, flags: str) -> str:
    what = f"identify again with {flags}, or doubt the model" if flags else _CAUSES
    return f"at a bound: {name} is at its {'upper' if upper else 'lower'} one, {bound.rstrip()}; {what}"


def is_physical(p: Parameter, upper: bool) -> bool:
    """Return whether no value beyond a bound is possible: delays and frictions are not below 0."""
    return not upper and p.low == 0.0 and not p.narrowed and (p.kind == "delay" or p.transform == "linear")


def way_out(p: Parameter, upper: bool, max_delay_s: float) -> str:
    """Return flags that widen the bound at which an estimate lies.

    Args:
        max_delay_s: Longest delay of the model [s].
    """
    if p.kind == "delay":
        return _longer(p, max_delay_s) if upper else f"--bounds {p.name} 0 {p.high:g}"
    low, high = p.low, p.high
    if p.transform == "log":
        low, high = (low, high * _WIDER) if upper else (low / _WIDER, high)
    else:
        below = low - (high - low)  # shares and frictions are not negative
        low, high = (low, high + (high - low)) if upper else (max(below, 0.0) if low > 0.0 else below, high)
    return f"--bounds {p.name} {low:.6g} {high:.6g}"


def _longer(p: Parameter, max_delay_s: float) -> str:
    """Return flags that allow a longer delay; "" if the delay is the longest possible."""
    if p.high < 0.999 * max_delay_s:  # it was narrowed
        return f"--bounds {p.name} {p.low:g} {min(2.0 * p.high, max_delay_s):g}"
    return f"--max-delay-s {min(2.0 * max_delay_s, _LONGEST_S):g}" if max_delay_s < _LONGEST_S else ""
