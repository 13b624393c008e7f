"""What identify found, as its artifact holds it and as the console shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.estimation.posterior import Posterior
from sim2real.artifacts.identification import (
    ROUND_TRIP,
    Determined,
    Estimate,
    HeldOutPart,
    Identification,
    Judgement,
    Matrix,
)
from sim2real.identify.fit import Fit
from sim2real.identify.uncertainty import identifiability, noise, uncertainty
from sim2real.identify.uncertainty.negligible import NOT_REACHED, indifferent, negligible
from sim2real.identify.uncertainty.round_trip import RoundTrip, round_trip
from sim2real.identify.validation.verdict import judge, positions, scores
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.free_run import Lack


@dataclass(frozen=True)
class Findings:
    """A fit, and how uncertain it is.

    Attributes:
        fit: The fit.
        at: Its residuals.
        spread: Its uncertainty.
        check: What the data determines.
        trip: The sum of the delays; None where there are none.
        widening: Factor on its deviations with which draws cover the errors of the model.
    """

    fit: Fit
    at: uncertainty.Linearised
    spread: uncertainty.Uncertainty
    check: Determined
    trip: RoundTrip | None
    widening: float

    @property
    def x(self) -> np.ndarray:
        """The estimate on the parameters' scales, ``(P,)``."""
        return self.at.x

    @staticmethod
    def of(fit: Fit, without: Sequence[HeldOutPart] = ()) -> Findings:
        """Compute how uncertain a fit is.

        Args:
            without: What was identified without one part of the recordings or another.
        """
        at = uncertainty.linearise(fit.problem, fit.z)
        spread = held_out_parts.widened(uncertainty.from_linearised(fit.problem, at), fit.problem.table, at.x, without)
        check = identifiability.from_linearised(fit.problem, at)
        spread, check = negligible(fit.problem, fit.z, at, spread, check)
        fit, at = _where_nothing_is_said(fit, at, spread)
        trip = round_trip(fit.problem.table, at.x, spread)
        return Findings(fit, at, spread, check, trip, noise.widening(fit.problem.table, at, spread))


def _where_nothing_is_said(
    fit: Fit, at: uncertainty.Linearised, spread: uncertainty.Uncertainty
) -> tuple[Fit, uncertainty.Linearised]:
    """Return a fit with limits that no motion reaches where the data sheet has them: the search left them anywhere."""
    table, x = fit.problem.table, at.x.copy()
    for i in np.flatnonzero([v == NOT_REACHED for v in spread.verdict]):
        p = table.columns[i].parameter
        x[i] = p.to_scale(indifferent(p, float(spread.low[i])))
    z = np.where(x == at.x, fit.z, table.at_scale(x))
    return replace(fit, z=z), replace(at, x=x)


def document(
    pipeline: str, found: Findings, posterior: Posterior, truth: Mapping[str, float], seconds: float
) -> Identification:
    """Return the estimates and their uncertainty; predictions and verdict are added later.

    Args:
        truth: The embedded robot's own values, those that are known.
        seconds: What the search took [s].
    """
    fit, spread, check = found.fit, found.spread, found.check
    names = tuple(fit.problem.table.names)
    search = replace(fit.record, seconds=seconds)
    if not fit.converged:  # away from a minimum no interval, covariance or condition means anything
        rows = tuple(_without_interval(row) for row in _rows(found, truth))
        return Identification(
            pipeline=pipeline, logs=(), verdict=Judgement("", ()), parameters=rows, search=search, misfit=spread.misfit
        )
    return Identification(
        pipeline=pipeline,
        logs=(),
        verdict=Judgement("", ()),
        parameters=tuple(_rows(found, truth)),
        search=search,
        covariance=Matrix(names, spread.covariance),
        correlation=Matrix(names, spread.correlation),
        residual_inflation=spread.inflation,
        misfit=spread.misfit,
        check=check,
        posterior=posterior,
        widening=found.widening,
    )


def judged(
    document: Identification,
    found: Findings,
    units: Mapping[str, str],
    max_delay_s: float,
    outside: Sequence[str],
    lack: Lack,
) -> Identification:
    """Return the document with its verdict, whose ``next`` are the flags with which to identify again.

    Args:
        units: Field -> unit.
        max_delay_s: For which delays the model is made [s].
        outside: Where held-out data goes beyond what was fitted: sentences.
    """
    judged_on = positions(found.fit.problem.model, units)
    rows = scores(document.prediction, judged_on)
    table = found.fit.problem.table
    fit = found.fit
    verdict = judge(
        rows,
        table,
        found.x,
        found.spread,
        found.check,
        trip=found.trip,
        max_delay_s=max_delay_s,
        beyond=outside,
        left=None if fit.converged else fit.left,
    )
    horizon_s = max((r.horizon_s for r in document.prediction), default=0.0)
    worth = held_out_parts.sentences(document.left_out, judged_on, horizon_s)
    status = "lacks a term" if lack.flags and verdict.status == "accepted" else verdict.status
    flags = " ".join(f for f in (verdict.next, lack.flags) if f)
    told = Judgement(status, (*worth, *verdict.reasons, *lack.reasons), flags)
    return replace(document, verdict=told, held_out=tuple(rows))


def _rows(found: Findings, truth: Mapping[str, float]) -> list[Estimate]:
    parameters, spread = found.fit.problem.table, found.spread
    rows = []
    for i, column in enumerate(parameters.columns):
        p = column.parameter
        value = np.ravel(found.fit.values[p.name])[column.recording or 0]
        rows.append(
            Estimate(
                name=column.label,
                unit=p.unit,
                kind=p.kind,
                about=p.about,
                nominal=p.nominal,
                estimate=float(value),
                standard_error=float(spread.standard_error[i]),
                low95=float(spread.low[i]),
                high95=float(spread.high[i]),
                lower=p.low,
                upper=p.high,
                verdict=spread.verdict[i],
                truth=truth.get(p.name),
            )
        )
    for p in (p for p in parameters if not p.free):
        ends = {"standard_error": 0.0, "low95": p.nominal, "high95": p.nominal, "lower": p.low, "upper": p.high}
        named = (p.name, p.unit, p.kind, p.about, p.nominal, p.nominal)
        rows.append(Estimate(*named, verdict="fixed", truth=truth.get(p.name), **ends))
    return rows + ([_round_trip(found.trip, truth)] if found.trip else [])


def _without_interval(row: Estimate) -> Estimate:
    """Return the row of a parameter whose fit did not converge."""
    if row.verdict == "fixed":
        return row
    return replace(row, standard_error=None, low95=None, high95=None, verdict="not converged")


def _round_trip(trip: RoundTrip, truth: Mapping[str, float]) -> Estimate:
    """Return the row of the sum of all delays, which a log determines even where it cannot tell them apart."""
    return Estimate(
        name=ROUND_TRIP,
        unit="s",
        kind="derived",
        about=" + ".join([*trip.parts, *trip.held]),
        nominal=0.0,
        estimate=trip.estimate,
        standard_error=trip.standard_error,
        low95=trip.low,
        high95=trip.high,
        lower=trip.lower,
        upper=trip.upper,
        verdict=trip.verdict,
        truth=truth.get(ROUND_TRIP),
    )
