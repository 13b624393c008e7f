"""Whether an identification can be used: judged on held-out data, position by position."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim2real.artifacts.identification import Determined, HeldOut, Judgement, Prediction
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.uncertainty.bounds import is_physical, way_out, way_out_of
from sim2real.identify.uncertainty.round_trip import RoundTrip
from sim2real.identify.uncertainty.uncertainty import Uncertainty
from sim2real.identify.validation.prediction import position_of
from sim2real.log.schema import unit_of

Status = Literal["accepted", "not converged", "no improvement on held-out data", "not identifiable", "hit a bound"]
_BETTER = 0.95
"""The error on held-out data must be below this share of every baseline's."""
_ALIKE = 1.05
"""Up to this factor two errors count as the same."""
_NOISE = 2.0
"""Errors below this many deviations of the measurement cannot be told from its noise."""
_MOST = 3
"""How many positions the reasons name one by one, the worst first."""
NO_DELAY = "no delay"
"""The same model fitted without delays. Where it is as good, the data needs no delays; that is no failure."""


@dataclass(frozen=True)
class Position:
    """A measured position that is judged.

    Attributes:
        column: Its name in tables of errors, ``position[1]``.
        name: What people call it.
        unit: Its unit.
        sigma: Deviation of a measurement.
    """

    column: str
    name: str
    unit: str
    sigma: float


def positions(model: IdentifiableModel, units: Mapping[str, str]) -> list[Position]:
    """Return the measured positions of a model, which are judged one by one.

    Args:
        units: Field -> unit.
    """
    return [Position(position_of(c), c.name, unit_of(position_of(c), units), c.position_sigma) for c in model.channels]


def scores(prediction: Sequence[Prediction], positions: Sequence[Position]) -> list[HeldOut]:
    """Return how far each position is off on held-out data at the longest horizon, the worst first.

    Args:
        prediction: What ``prediction.errors`` returned.
    """
    columns = [p.column for p in positions]
    held_out = [row for row in prediction if row.held_out and any(row.rmse.get(c) is not None for c in columns)]
    horizon_s = max((row.horizon_s for row in held_out), default=None)
    last = {row.model: row.rmse for row in held_out if row.horizon_s == horizon_s}
    if horizon_s is None or "identified" not in last:
        return []
    rows = []
    for p in positions:
        errors = {model: rmse[p.column] for model, rmse in last.items() if rmse.get(p.column) is not None}
        if "identified" in errors:
            rows.append(_scored(p, horizon_s, errors))
    # The worst first: positions that a baseline beats, then those with the largest error beside the best baseline.
    return [row for _, row in sorted(rows, key=lambda pair: (not pair[1].beaten_by, -pair[0]))]


def _scored(p: Position, horizon_s: float, errors: Mapping[str, float | None]) -> tuple[float, HeldOut]:
    """Return the error of a position over that of the best baseline, and the row of the position.

    Errors below the noise of the measurement count as the noise.
    """
    # A prediction that diverged to NaN is infinitely wrong.
    finite = {m: e if e is not None and math.isfinite(e) else math.inf for m, e in errors.items()}
    error, noise = finite.pop("identified"), _NOISE * p.sigma
    best = min(finite.values(), default=math.inf)
    excess = max(error, noise) / max(best, noise) if math.isfinite(best) else 0.0
    # The model without delays counts as better only where it is better by more than chance.
    limits = {m: (_ALIKE if m == NO_DELAY else _BETTER) * e for m, e in finite.items()}
    beaten_by = () if error <= noise else tuple(m for m, limit in limits.items() if error > limit)
    rmse = {m: e if math.isfinite(e) else None for m, e in {"identified": error, **finite}.items()}
    return excess, HeldOut(p.name, p.column, p.unit, horizon_s, rmse, beaten_by)


def errors_of(row: HeldOut) -> dict[str, float]:
    """Return model -> root mean square error of a position; infinite where the model diverged."""
    return {model: math.inf if error is None else error for model, error in row.rmse.items()}


def judge(
    found: Sequence[HeldOut],
    table: ParameterTable,
    x: np.ndarray,
    spread: Uncertainty,
    check: Determined,
    *,
    trip: RoundTrip | None = None,
    max_delay_s: float = 1.0,
    beyond: Sequence[str] = (),
    left: float | None = None,
) -> Judgement:
    """Judge an identification.

    Args:
        found: How far each position is off, the worst first.
        x: Shape ``(P,)``: the estimate, on the parameters' scales.
        max_delay_s: For which delays the model is made [s].
        beyond: Where held-out data goes beyond what was fitted: sentences.
        left: Length of the next step of a fit that did not converge [standard errors]; None: it converged.
    """
    improves, reasons = _on_held_out(found)
    reasons += beyond
    if left is not None:
        return Judgement("not converged", (_not_converged(left), *reasons))
    known = [i for i, n in enumerate(table.names) if not any(n in group for group in check.undetermined)]
    bounded, least, flags = _at_bounds(table, x, spread, known, trip, max_delay_s)
    reasons += bounded
    reasons += _absent(table, spread)
    reasons += [f"{name} comes out at 0, less than which there is not: held there, the same fit" for name in least]
    together = trip.parts if trip and not trip.apart else ()
    groups = zip(check.undetermined, check.messages, strict=True)
    loose = [message for group, message in groups if not set(group) <= set(together)]
    if trip and together:
        loose += [f"not even their sum is known: {trip}"] * (trip.verdict == "not identifiable")
        reasons.append(f"{' and '.join(together)} cannot be told apart from a log; what is known is their sum, {trip}")
    reasons += loose
    if spread.misfit > 3.0:
        reasons.append(
            f"residuals are {spread.misfit:.2g} times the measurement's deviation: the model explains the data only in "
            "part, and intervals follow how much estimates vary from block to block"
        )
    status: Status = "accepted"
    if not improves:
        status = "no improvement on held-out data"
    elif bounded:
        status = "hit a bound"
    elif loose:
        status = "not identifiable"
    return Judgement(status, tuple(reasons), flags)


def _not_converged(left: float) -> str:
    """Return why a fit has no intervals."""
    return (
        f"the fit ended before its loss had a minimum: the next step would move an estimate by {left:.2g} standard "
        "errors, so there are no intervals"
    )


def _absent(table: ParameterTable, spread: Uncertainty) -> list[str]:
    """Return a sentence about each parameter that may as well be absent."""
    said = []
    for i, name in enumerate(table.names):
        unit = table.columns[i].parameter.unit
        if spread.verdict[i] == "negligible":
            bound = f"at most {spread.high[i]:.2g} {unit} (95 %)"
            said.append(f"{name} is negligible: {bound}, and without it the model predicts the same")
        elif spread.verdict[i] == "not reached":
            bound = f"it is at least {spread.low[i]:.2g} {unit} (95 %)"
            above = "no value above that changes what the model says of these recordings"
            said.append(f"{name} is not reached: {bound}, and {above}")
    return said


def _on_held_out(found: Sequence[HeldOut]) -> tuple[bool, list[str]]:
    """Return whether every position beats every baseline on held-out data, and what to say of it."""
    if not found:
        return True, ["nothing was held out: how well it predicts is not known"]
    ahead = f"{found[0].horizon_s:g} s ahead on held-out data"
    worse = [s for s in found if s.beaten_by]
    if worse:
        reasons = [f"{ahead} {s.name} is no better than: {_errors(s)}" for s in worse[:_MOST]]
        return False, reasons + [f"nor are {len(worse) - _MOST} more positions"] * (len(worse) > _MOST)
    reasons = [f"{ahead} {_off(s)}" for s in found[:_MOST]]
    if len(found) > _MOST:
        reasons.append(f"{len(found) - _MOST} more positions improve at least as much")
    if not any(_needs_delay(s) for s in found):
        reasons.append("without any delay it predicts as well: this data does not need one")
    return True, reasons


def _off(row: HeldOut) -> str:
    """Return how far a position is off, and the ratio to the error of the best baseline."""
    errors = errors_of(row)
    sentence = f"{row.name} is off by {errors.pop('identified'):.2g} {row.unit}".rstrip()
    best = min(errors, key=lambda model: errors[model], default=None)
    if best is None or not math.isfinite(errors[best]):
        return sentence
    if not errors[best]:
        return f"{sentence}, where {best} is exact"
    return f"{sentence}, {errors_of(row)['identified'] / errors[best]:.2g} times {best}"


def _needs_delay(row: HeldOut) -> bool:
    """Return whether the same model without delays is worse."""
    errors = errors_of(row)
    return NO_DELAY not in errors or errors["identified"] < _BETTER * errors[NO_DELAY]


def _errors(row: HeldOut) -> str:
    """Return the baselines that beat a position, with the errors."""
    errors, unit = errors_of(row), f" {row.unit}".rstrip()
    better = ", ".join(f"{m} ({errors[m]:.2g}{unit})" for m in row.beaten_by)
    return f"{better}; its own error is {errors['identified']:.2g}{unit}"


def _at_bounds(
    table: ParameterTable,
    x: np.ndarray,
    spread: Uncertainty,
    known: Sequence[int],
    trip: RoundTrip | None,
    max_delay_s: float,
) -> tuple[list[str], list[str], str]:
    """Return a sentence about each estimate at a bound, names of those at 0 that cannot be less, and flags to widen.

    Only parameters in ``known`` count: for one that the data does not determine, other bounds do not help.
    """
    said, least, flags = [], [], []
    for i in known:
        if spread.verdict[i] != "at a bound":
            continue
        label, p = table.columns[i].label, table.columns[i].parameter
        upper = bool(table.high[i] - x[i] < x[i] - table.low[i])
        if is_physical(p, upper):
            least.append(label)
        else:
            flags.append(way_out(p, upper, max_delay_s))
            said.append(_bound(label, upper, f"{p.high if upper else p.low:.4g} {p.unit}", flags[-1]))
    if trip and not trip.apart and trip.verdict == "at a bound":
        parts = {c.label: c.parameter for c in table.columns if c.label in trip.parts}
        upper = trip.at_bound == "upper"
        if all(is_physical(p, upper) for p in parts.values()):
            least.append("the sum of the delays")
        else:
            flags.append(way_out_of(trip, parts, max_delay_s))
            bound = trip.upper if upper else trip.lower
            said.append(_bound("the sum of the delays", upper, f"{1e3 * bound:.4g} ms", flags[-1]))
    return said, least, " ".join(dict.fromkeys(f for f in flags if f))


def _bound(name: str, upper: bool, bound: str, flags: str) -> str:
    what = f"identify again with {flags}, or doubt the model" if flags else "no flag moves it: doubt the model"
    return f"at a bound: {name} is at its {'upper' if upper else 'lower'} one, {bound.rstrip()}; {what}"
