"""From a fit to an identification: intervals, predictions, what the model lacks, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sim2real.artifacts.identification import WITHOUT_DELAYS, Estimate, Identification, Internal, Judgement
from sim2real.artifacts.posterior import Posterior
from sim2real.graph.episode import Episode
from sim2real.identification import predictions as prediction
from sim2real.identification import verdict
from sim2real.identification.delays import links
from sim2real.identification.expected import wider_for, with_expected_errors
from sim2real.identification.fit import Fit, as_numbers, refit
from sim2real.identification.held_out import HeldOutPart
from sim2real.identification.lacks import TILT, Lack, find_lack, turned_gravity
from sim2real.identification.predictions import positions, replays
from sim2real.identification.residuals import Linearised, Problem, few_of
from sim2real.identification.segments import Span, extents
from sim2real.identification.uncertainty import (
    ABSENT,
    NOT_REACHED,
    Determined,
    Uncertainty,
    compare_recordings,
    from_linearised,
    noises,
)
from sim2real.identification.uncertainty import determined as what_is_determined
from sim2real.identification.uncertainty import widening as posterior_widening
from sim2real.identification.verdict import ACCEPTED
from sim2real.log.importing.checks import slow_sides
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.identify.fitting import Fits, determined, has_parts, widened, windows_of, without_parts
from sim2real.stages.identify.inputs import Inputs, configured, with_load, with_terms
from sim2real.stages.identify.true_values import true_values
from sim2real.stages.load import defaults_of
from sim2real.stages.shared.identification import split_of, usable
from sim2real.stages.terminal.console import progress
from sim2real.stages.terminal.interruption import patiently

_NO_DELAY_S = 1e-4
"""Estimated delays below this count as no delay [s]."""
_HORIZONS = (0.1, 1.0)
"""Shares of the horizon up to which errors are stored; a deployment is compared at the shorter one."""
_MOST = 3
"""Number of errors above the expected ones that are named."""


def judge(fits: Fits) -> Identification:
    """Return the estimates with intervals, predictions, free runs and a verdict; the caller adds logs and timing."""
    inputs, config = fits.inputs, fits.inputs.config
    with progress(None, "identify: held-out parts") as bar:
        # Refit without each part of the recordings.
        parts = patiently(lambda: without_parts(fits))
        # Compute intervals; they widen if the estimates without one part differ.
        bar.set_description_str("identify: intervals")
        findings, held = patiently(lambda: Findings.of(fits.estimate, parts)), list[str]()
        # Fix the parameters that the data does not determine.
        if (config.terms == "auto" or fits.added) and fits.estimate.converged and findings.check.undetermined:
            fits, held = patiently(lambda f=findings: determined(fits, f.check, f.spread))
            findings = patiently(lambda: Findings.of(fits.estimate, parts)) if held else findings
        fit = findings.fit
        truth = true_values(inputs.logs[0])
        posterior = fit.problem.table.posterior(fit.x, findings.spread.scale_covariance, findings.widening)
        document = _estimates(inputs.loaded.name, findings, posterior, truth)
        # Predict held-out parts, by the model and by baselines.
        bar.set_description_str("identify: predictions and baselines")
        document = patiently(lambda: _predicted(document, inputs, fit))
        bar.set_description_str("identify: each log, distribution of delays")
        over_logs = patiently(lambda: compare_recordings(fit.problem, findings.at)) if inputs.fitted > 1 else ()
        links_ = patiently(lambda: links(fit.problem, fit.x)) if config.links else ()
        document = replace(document, terms=fits.terms, links=links_, over_logs=over_logs)
        document = _compared(document, inputs, fit, parts)
        bar.set_description_str("identify: what the model lacks")
        lacks = patiently(lambda: _lack(document, inputs, fit))
    if inputs.standing is not None:
        document = with_load(document, inputs.robot, inputs.standing, truth)
    names = [n for n in inputs.undetermined if n not in document.values]
    # The verdict proposes to widen only bounds of the robot, not bounds that the user has set.
    usual = defaults_of(inputs.loaded).identify.bounds
    set_by_user = {n for n, both in config.bounds.items() if usual.get(n) != both}
    open_ = [f"not determined by this log: {', '.join(names)}"] if names else []
    if fits.added:
        held.insert(0, f"the term {fits.added} is part of the model: without it the errors are at least twice as large")
    fields = {p.name: p.column for p in positions(inputs.model, inputs.units)}
    alone = verdict.decisive_part(parts, document.expected_error, fields)
    return _judged(document, findings, inputs, [*held, *open_, *([alone] if alone else [])], lacks, set_by_user)


@dataclass(frozen=True)
class Findings:
    """A fit with its uncertainty.

    Attributes:
        at: The residuals at the estimate.
        check: The combinations of parameters that the data determines.
        widening: Factor on standard deviations, so that draws cover the errors of the model.
    """

    fit: Fit
    at: Linearised
    spread: Uncertainty
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
            without: The fits without one part of the recordings each.
        """
        at = fit.problem.linearise(fit.x)
        spread = widened(from_linearised(fit.problem, at), fit.problem.table, at, without)
        table = fit.problem.table
        one_sided = [n for n, state in zip(table.names, spread.state, strict=True) if state in (ABSENT, NOT_REACHED)]
        check = what_is_determined(fit.problem, at, one_sided)
        # The loss does not depend on a limit that no motion reaches: such a limit stays nominal.
        x = np.where([state == NOT_REACHED for state in spread.state], np.maximum(table.nominal(), at.x), at.x)
        return Findings(replace(fit, x=x), replace(at, x=x), spread, check, posterior_widening(at, spread))


def _estimates(pipeline: str, findings: Findings, posterior: Posterior, truth: Mapping[str, float]) -> Identification:
    """Return the estimates with their uncertainty; predictions and verdict are added later.

    Args:
        truth: Known parameters of the embedded robot.
    """
    fit = findings.fit
    # Away from a minimum, intervals have no meaning.
    spread = findings.spread if fit.converged else None
    rows = verdict.estimates(fit.problem.table, fit.values, spread, truth)
    document = Identification(pipeline, (), Judgement("", ()), rows)
    return replace(document, posterior=posterior) if fit.converged else document


def _doubted(row: Estimate) -> Estimate:
    """Return a parameter's row for a fit that is not accepted: its state is never ``ok``."""
    return replace(row, state="not determined") if row.state == "ok" else row


def _predicted(document: Identification, inputs: Inputs, fit: Fit) -> Identification:
    """Return the document with the columns of all segments and of the free runs, and their errors."""
    config, problem = inputs.config, fit.windows
    nominal = {p.name: p.nominal for p in inputs.model.parameters}
    models: dict[str, Mapping[str, float]] = {"identified": fit.values, **_without_delays(fit), "nominal": nominal}
    samples = prediction.samples(problem, models, config.settle_s)
    horizons = [round(share * config.horizon_s, 3) for share in _HORIZONS]
    measured = positions(inputs.model, inputs.units)
    errors = [row for s in horizons for row in prediction.errors(samples, list(models), measured, config.settle_s, s)]
    drawn = {name: values for name, values in models.items() if name != "nominal"}
    columns, long = free_runs(fit, inputs.episodes, inputs.fitted, config, drawn)
    worst = prediction.worst_second(samples, measured, config.settle_s, [log.path.name for log in inputs.logs])
    return replace(
        document,
        samples=samples if worst is None else samples | {"worst": worst[1]},
        free=columns,
        replays={**replays(problem, fit.values, config.settle_s, "ahead"), **long},
        internal=Internal(settle_s=config.settle_s, world=config.world),
        errors=tuple(errors),
        worst=worst and worst[0],
    )


def _without_delays(fit: Fit) -> dict[str, Mapping[str, float]]:
    """Return a baseline: the same model fitted without delays, if it has delays."""
    table = fit.problem.table
    kept = np.array([c.kind != "delay" for c in table.columns])
    if kept.all():
        return {}
    delays = [p for p in table if p.free and p.kind == "delay"]
    largest_s = max(float(np.max(np.abs(np.subtract(fit.values[p.name], p.without)))) for p in delays)
    # A fit without delays is its own baseline: a second fit of a quadruped took 120 s and changed no estimate.
    if largest_s < _NO_DELAY_S:
        return {WITHOUT_DELAYS: as_numbers(table, fit.x, kept)}
    return {WITHOUT_DELAYS: refit(fit.problem, kept, fit.x)}


def free_runs(
    estimate: Fit,
    episodes: Sequence[Episode],
    fitted: int,
    config: IdentifyConfig,
    models: Mapping[str, Any],
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Simulate the held-out part of each log in one run; return its columns, and its commands and starts.

    Args:
        fitted: Number of fitted logs; the later logs are held out as a whole.
        models: Model -> values of all parameters.
    """
    splits = [split_of(episode, r < fitted, config) for r, episode in enumerate(episodes)]
    ends = [usable(episode, config)[1] for episode in episodes]
    least_s = config.settle_s + config.horizon_s
    # Take the held-out part of each log that is long enough.
    held_out = [Span(r, split, False) for r, split in enumerate(splits) if ends[r] - split > least_s]
    if not held_out or not config.free_run_s:
        return {}, {}
    lengths_s = [min(config.free_run_s, ends[s.recording] - s.begin_s) for s in held_out]
    problem = estimate.windows.recut(held_out, max(lengths_s), ends_s=lengths_s)
    columns = prediction.samples(problem, models, config.settle_s)
    return columns, replays(problem, estimate.values, config.settle_s, "free")


def _compared(document: Identification, inputs: Inputs, fit: Fit, parts: Sequence[HeldOutPart]) -> Identification:
    """Return the document with expected errors and the extent of the fitted motion."""
    names, measured = [log.path.name for log in inputs.logs], positions(inputs.model, inputs.units)
    fitted = [s for s in inputs.windows if s.fitted]
    held_out = [[s for s in inputs.windows if s.recording == r and not s.fitted] for r in range(len(inputs.logs))]
    before, *later = (extents(inputs.model, inputs.episodes, s, fit.windows.segment_s) for s in (fitted, *held_out))
    document = replace(document, internal=replace(document.internal, motion=before))
    wider = [wider_for(before, log, measured) for log in later]
    return with_expected_errors(document, measured, parts, names, wider)


def _lack(document: Identification, inputs: Inputs, fit: Fit) -> Lack:
    """Return what a model lacks; another direction of gravity is tried if the robot can have one."""

    def inclined() -> tuple[float, dict[str, float]] | None:
        problem = tilted(inputs, fit) if fit.converged else None
        return None if problem is None else turned_gravity(problem, fit.values)

    measured = positions(inputs.model, inputs.robot.units)
    return find_lack(document, measured, noises(document.samples, inputs.units), inclined)


def tilted(inputs: Inputs, fit: Fit) -> Problem | None:
    """Return a fit's segments with the term of an inclined base; None if the robot has no such term to identify."""
    config, chosen = inputs.config, fit.problem.table.terms
    wanted = ",".join([*chosen, TILT])
    offered = configured(inputs.loaded, replace(config, terms=wanted)).identifiable(config.max_delay_s)
    turns = [p.name for p in offered.parameters if p.term == TILT]
    if not turns or TILT in chosen or set(turns) & set(config.fix):
        return None
    more = with_terms(inputs, wanted, bounds=dict.fromkeys(turns, (-math.pi, math.pi)))
    if not set(fit.values) <= {p.name for p in more.table}:
        return None
    return few_of(windows_of(more))


def _judged(
    document: Identification,
    findings: Findings,
    inputs: Inputs,
    doubts: Sequence[str],
    lacks: Lack,
    set_by_user: Collection[str],
) -> Identification:
    """Return the document with its verdict, whose ``next`` are flags with which to identify again.

    Args:
        doubts: Sentences about fixed parameters and terms.
        set_by_user: Parameters whose bounds the user has set.
    """
    fit = findings.fit
    where = lambda log: f"the held-out part of {log}" if log else "held-out parts"  # noqa: E731
    above = [row.text(where(row.log)) for row in document.judged if row.exceeded]
    judgement = verdict.judge(
        document.held_out,
        fit.problem.table,
        findings.x,
        findings.spread,
        findings.check,
        max_delay_s=inputs.config.max_delay_s,
        widened=fit.problem.table.names if lacks.flags else set_by_user,
        doubts=doubts,
        left=None if fit.converged else fit.left,
        exceeded=above[:_MOST] + [f"{len(above) - _MOST} more errors are above"] * (len(above) > _MOST),
        lacks=lacks,
        too_seldom=_slow_commands(inputs),
        offers_terms=lambda: _offers_more(inputs, fit),
    )
    accepted = judgement.status == ACCEPTED
    parameters = document.parameters if accepted else tuple(map(_doubted, document.parameters))
    return replace(document, verdict=judgement, parameters=parameters)


def _slow_commands(inputs: Inputs) -> str:
    """Return a sentence on a fitted log whose commands are logged too seldom for its motion; "": there is none."""
    for log in inputs.logs[: inputs.fitted]:
        for sentence in slow_sides(log.episode):
            return f"{log.path.name}: {sentence}"
    return ""


def _offers_more(inputs: Inputs, fit: Fit) -> bool:
    """Return whether ``--terms auto`` would compare terms that the model lacks."""
    if inputs.config.terms == "auto" or not has_parts(inputs, fit):
        return False
    return bool({p.term for p in with_terms(inputs, "auto", "all").table if p.term} - set(fit.problem.table.terms))
