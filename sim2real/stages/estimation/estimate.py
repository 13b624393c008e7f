"""The artifact of an identification: estimates with intervals, and the verdict."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.artifacts.identification import (
    ROUND_TRIP,
    Determined,
    Estimate,
    HeldOutPart,
    Identification,
    Judgement,
    Matrix,
)
from sim2real.artifacts.posterior import Posterior
from sim2real.identify.fit import Fit
from sim2real.identify.uncertainty import identifiability, noise, uncertainty
from sim2real.identify.uncertainty.negligible import NOT_REACHED, indifferent, negligible
from sim2real.identify.validation.verdict import ACCEPTED, CHANGE, judge, positions, scores, state_of
from sim2real.identify.validation.worst_second import worst_second
from sim2real.stages.estimation import held_out_parts
from sim2real.stages.estimation.free_run import Lack

_MOST = 3
"""Most errors above the expected ones that are named."""


@dataclass(frozen=True)
class Findings:
    """A fit with its uncertainty.

    Attributes:
        at: The residuals at the estimate.
        check: The combinations of parameters that the data determines.
        widening: Factor on deviations with which draws cover the errors of the model.
    """

    fit: Fit
    at: uncertainty.Linearised
    spread: uncertainty.Uncertainty
    check: Determined
    widening: float

    @property
    def x(self) -> np.ndarray:
        """The estimate on the parameters' scales, ``(P,)``."""
        return self.at.x

    @staticmethod
    def of(fit: Fit, without: Sequence[HeldOutPart] = ()) -> Findings:
        """Compute the uncertainty of a fit.

        Args:
            without: The estimates without one part of the recordings each.
        """
        at = uncertainty.linearise(fit.problem, fit.z)
        spread = held_out_parts.widened(uncertainty.from_linearised(fit.problem, at), fit.problem.table, at.x, without)
        check = identifiability.from_linearised(fit.problem, at)
        # Give parameters that the model does not need a single bound.
        spread, check = negligible(fit.problem, fit.z, at, spread, check)
        fit, at = _with_nominal_limits(fit, at, spread)
        return Findings(fit, at, spread, check, noise.widening(at, spread))


def _with_nominal_limits(
    fit: Fit, at: uncertainty.Linearised, spread: uncertainty.Uncertainty
) -> tuple[Fit, uncertainty.Linearised]:
    """Return a fit with limits that no motion reaches at their nominal values: the loss does not depend on them."""
    table, x = fit.problem.table, at.x.copy()
    for i in np.flatnonzero([v == NOT_REACHED for v in spread.verdict]):
        p = table.columns[i].parameter
        x[i] = p.to_scale(indifferent(p, float(spread.low[i])))
    z = np.where(x == at.x, fit.z, table.at_scale(x))
    return replace(fit, z=z), replace(at, x=x)


def document(
    pipeline: str, findings: Findings, posterior: Posterior, truth: Mapping[str, float], seconds: float
) -> Identification:
    """Return the estimates with their uncertainty; predictions and verdict are added later.

    Args:
        truth: Known parameters of the embedded robot.
        seconds: Duration of the search [s].
    """
    fit, spread, check = findings.fit, findings.spread, findings.check
    names = tuple(fit.problem.table.names)
    search = replace(fit.record, seconds=seconds)
    if not fit.converged:  # away from a minimum no interval, covariance or condition means anything
        rows = tuple(_without_interval(row) for row in _rows(findings, truth))
        return Identification(
            pipeline=pipeline, logs=(), verdict=Judgement("", ()), parameters=rows, search=search, misfit=spread.misfit
        )
    return Identification(
        pipeline=pipeline,
        logs=(),
        verdict=Judgement("", ()),
        parameters=tuple(_rows(findings, truth)),
        search=search,
        covariance=Matrix(names, spread.covariance),
        correlation=Matrix(names, spread.correlation),
        misfit=spread.misfit,
        check=check,
        posterior=posterior,
        widening=findings.widening,
    )


def judged(
    document: Identification,
    findings: Findings,
    units: Mapping[str, str],
    max_delay_s: float,
    outside: Sequence[str],
    lack: Lack,
    widened: Collection[str] = (),
) -> Identification:
    """Return the document with its verdict, whose ``next`` are flags with which to identify again.

    Args:
        units: Field -> unit.
        max_delay_s: Longest delay of the model [s].
        widened: Parameters whose bounds the user has set.
        outside: Sentences about held-out data outside the range of the fitted data.
    """
    measured = positions(findings.fit.problem.model, units)
    # Judge the errors on held-out data, the intervals and the bounds.
    rows = scores(document.prediction, measured)
    table = findings.fit.problem.table
    fit = findings.fit
    verdict = judge(
        rows,
        table,
        findings.x,
        findings.spread,
        findings.check,
        max_delay_s=max_delay_s,
        widened=widened,
        beyond=outside,
        left=None if fit.converged else fit.left,
    )
    # Add errors above the expected ones, and what the free runs show; the reason for the status comes first.
    status, reasons = verdict.status, list(verdict.reasons)
    exceeded = [str(row) for row in sorted(document.compared, key=lambda r: -(r.ratio or 0.0)) if row.exceeded]
    more = exceeded[:_MOST] + [f"{len(exceeded) - _MOST} more errors are above"] * (len(exceeded) > _MOST)
    if status == ACCEPTED and lack.flags:
        status, reasons = CHANGE, [*lack.reasons, *more, *reasons]
    elif status == ACCEPTED and exceeded:
        status, reasons = CHANGE, [*more, *reasons, *lack.reasons]
    else:
        reasons += [*more, *lack.reasons]
    flags = " ".join(f for f in (verdict.next, lack.flags) if f)
    # A fault in fitted data changes no held-out error, so it does not change the status.
    worst = worst_second(document.samples, measured, document.settle_s)
    if worst is not None and worst.unexplained:
        where = f"the model does not explain {worst.name} in the second from {worst.begin_s:.1f} s on: {worst.error}"
        reasons.append(f"{where}; look at the log there")
    # In a fit that is not accepted no parameter is ok.
    parameters = document.parameters
    if status != ACCEPTED:
        doubted = {"ok": "not determined"}
        parameters = tuple(replace(p, verdict=doubted.get(p.verdict, p.verdict)) for p in parameters)
    judgement = Judgement(status, tuple(reasons), flags)
    return replace(document, verdict=judgement, parameters=parameters, held_out=tuple(rows), worst=worst)


def _rows(findings: Findings, truth: Mapping[str, float]) -> list[Estimate]:
    parameters, spread = findings.fit.problem.table, findings.spread
    # How the delay is shared between both sides of the world is a convention: only the sum has a true value.
    own_truth = lambda p: None if p.kind == "delay" and ROUND_TRIP in truth else truth.get(p.name)  # noqa: E731
    rows = []
    for i, column in enumerate(parameters.columns):
        p = column.parameter
        value = np.ravel(findings.fit.values[p.name])[column.recording or 0]
        upper = bool(parameters.high[i] - findings.x[i] < findings.x[i] - parameters.low[i])
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
                verdict=state_of(spread.verdict[i], p, upper),
                truth=own_truth(p),
            )
        )
    for p in (p for p in parameters if not p.free):
        numbers = {"standard_error": 0.0, "low95": p.nominal, "high95": p.nominal, "lower": p.low, "upper": p.high}
        columns_ = (p.name, p.unit, p.kind, p.about, p.nominal, p.nominal)
        rows.append(Estimate(*columns_, verdict="fixed", truth=own_truth(p), **numbers))
    return rows + round_trip(rows, truth)


def _without_interval(row: Estimate) -> Estimate:
    """Return the row of a parameter of a fit that did not converge."""
    if row.verdict == "fixed":
        return row
    return replace(row, standard_error=None, low95=None, high95=None, verdict="not determined")


def round_trip(rows: Sequence[Estimate], truth: Mapping[str, float]) -> list[Estimate]:
    """Return the row of the sum of all delays, of which one is identified: at most one row."""
    delays = [row for row in rows if row.kind == "delay"]
    free = [row for row in delays if row.verdict != "fixed"]
    if len(free) != 1 or "@" in free[0].name:
        return []
    held = sum(row.estimate for row in delays if row.verdict == "fixed")
    moved = {n: getattr(free[0], n) for n in ("estimate", "low95", "high95", "lower", "upper")}
    moved = {n: None if value is None else value + held for n, value in moved.items()}
    about = " + ".join(row.name for row in delays)
    own = truth.get(ROUND_TRIP)
    return [replace(free[0], name=ROUND_TRIP, kind="derived", about=about, nominal=0.0, truth=own, **moved)]
