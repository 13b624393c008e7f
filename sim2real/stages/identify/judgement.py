"""From a fit to an identification: intervals, predictions, free runs and the verdict."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim2real.artifacts.identification import HeldOutPart, Identification
from sim2real.identify.delays.links import links
from sim2real.identify.expected import wider_for, with_expected_errors
from sim2real.identify.fit import Fit, Value, as_numbers, refit
from sim2real.identify.problem.segments import beyond, ranges
from sim2real.identify.uncertainty import ensemble
from sim2real.identify.uncertainty.per_recording import compare_recordings
from sim2real.identify.validation import prediction
from sim2real.identify.validation.replays import replays
from sim2real.identify.validation.verdict import NO_DELAY, positions
from sim2real.stages.estimation import estimate, held_out_parts
from sim2real.stages.estimation.free_run import free_runs
from sim2real.stages.identify.fitting import Fits, determined
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.identify.missing_terms import lack, of_selection
from sim2real.stages.identify.true_values import true_values
from sim2real.stages.terminal.console import note, progress, shown
from sim2real.stages.terminal.interruption import patiently

_NO_DELAY_S = 1e-4
"""Estimates of delays below this count as no delay [s]."""
_HORIZONS = (0.1, 0.25, 0.5, 1.0)
"""Shares of the horizon at which prediction errors are listed."""


def judge(inputs: Inputs, fits: Fits, started_s: float) -> Identification:
    """Return the estimates with intervals, predictions, free runs and a verdict; the caller adds logs and timing.

    Args:
        started_s: When the fit began [s on ``time.monotonic``].
    """
    config = inputs.config
    with progress(None, "identify: held-out parts") as bar:
        # Refit without each part of the recordings. The errors of a fit that did not converge bound no later error.
        examine = config.folds and fits.estimate.converged
        parts = (
            patiently(lambda: held_out_parts.examined(fits.widest, config, inputs.names, fits.selection, inputs.refits))
            if examine
            else ()
        )
        if inputs.refits.source and inputs.refits.reused:
            same = "logs, parameters and settings are the same"
            note(f"{inputs.refits.reused} refits are from {shown(inputs.refits.source)}: {same}")
        # Compute intervals; they widen where estimates without one part differ.
        bar.set_description_str("identify: intervals")
        findings, held = patiently(lambda: estimate.Findings.of(fits.estimate, parts)), list[str]()
        # A choice of the model includes which parameters it has: hold those that the data does not determine.
        if config.terms == "auto" and fits.estimate.converged and findings.check.undetermined:
            fits, held = patiently(lambda f=findings: determined(inputs, fits, f))
            findings = patiently(lambda: estimate.Findings.of(fits.estimate, parts)) if held else findings
        fit = findings.fit
        truth = true_values(inputs.logs[0], inputs.robot.roles) if config.reveal else {}
        # Collect the models that explain the recordings as well, for training to draw from.
        bar.set_description_str("identify: posterior")
        posterior = patiently(
            lambda: ensemble.posterior(fit, findings.at, findings.spread, fits.widest, fits.selection)
        )
        document = estimate.document(inputs.pipeline.name, findings, posterior, truth, time.monotonic() - started_s)
        # Predict held-out data, beside baselines.
        bar.set_description_str("identify: predictions and baselines")
        document = patiently(lambda: _predicted(document, inputs, fit))
        bar.set_description_str("identify: each recording, distribution of delays")
        several = config.each and inputs.fitted > 1
        aggregate = patiently(lambda: compare_recordings(fit)) if several else ()
        links_ = patiently(lambda: links(fit.problem, fit.z)) if config.links else ()
        document = replace(document, left_out=parts, terms=fits.terms, links=links_, aggregate=aggregate)
        # Try further terms where residuals are far above the noise.
        bar.set_description_str("identify: terms that may be missing")
        if fits.selection is not None:
            document = replace(document, tried=of_selection(fits.selection, fits.widest.problem.table))
        document, lacks = patiently(lambda: lack(document, inputs, fit))
    document = inputs.weighed(document, truth)
    document, outside = _compared(document, inputs, fit, parts)
    names = [n for n in inputs.undetermined if n not in document.values]
    # A pipeline's own bounds may be widened once.
    widened = {n for n, both in config.bounds.items() if inputs.pipeline.identify.bounds.get(n) != both}
    open_ = [f"not determined by this log: {', '.join(names)}"] if names else []
    doubts = [*outside, *held, *open_]
    return estimate.judged(document, findings, inputs.units, config.max_delay_s, doubts, lacks, widened)


def _compared(
    document: Identification, inputs: Inputs, fit: Fit, parts: Sequence[HeldOutPart]
) -> tuple[Identification, list[str]]:
    """Return the document with expected errors and ranges, and sentences about held-out data outside the ranges."""
    names, measured = [log.path.stem for log in inputs.logs], positions(inputs.model, inputs.units)
    fitted = [s for s in inputs.windows if s.fitted]
    held_out = [[s for s in inputs.windows if s.recording == r and not s.fitted] for r in range(len(inputs.logs))]
    before, *later = (ranges(inputs.model, inputs.episodes, s, fit.windows.segment_s) for s in (fitted, *held_out))
    document = replace(document, ranges=before)
    wider = [wider_for(before, log, measured) for log in later]
    document = with_expected_errors(document, measured, parts, names, inputs.fitted, wider)
    outside = dict.fromkeys(text for log in later for text in beyond(before, log))
    return document, [f"held-out data extrapolates: {text}" for text in outside]


def _predicted(document: Identification, inputs: Inputs, fit: Fit) -> Identification:
    """Return the document with the columns of all segments and of the free runs, and their errors."""
    config, problem = inputs.config, fit.windows
    nominal = {p.name: p.nominal for p in inputs.model.parameters}
    models: dict[str, Mapping[str, Value]] = {"identified": fit.values, **_without_delays(fit), "nominal": nominal}
    samples = prediction.samples(problem, models, config.settle_s)
    horizons = [round(share * config.horizon_s, 3) for share in _HORIZONS]
    runs, columns, long = free_runs(fit, inputs.episodes, inputs.fitted, config, models)
    return replace(
        document,
        samples=samples,
        free=columns,
        replays={**replays(problem, fit.values, config.settle_s, "ahead"), **long},
        settle_s=config.settle_s,
        prediction=tuple(prediction.errors(problem, samples, list(models), config.settle_s, horizons)),
        free_run=tuple(runs),
        segments=problem.segments,
        held_out_from_s=float(np.delete(problem.begins_s, problem.train).min(initial=np.inf)),
        sigma=dict(zip(prediction.labels(problem), (s for _, s, _ in problem.fields), strict=True)),
    )


def _without_delays(fit: Fit) -> dict[str, Mapping[str, Value]]:
    """Return the baseline: the same model fitted without delays, if it has some."""
    table = fit.problem.table
    kept = np.array([c.parameter.kind != "delay" for c in table.columns])
    if kept.all():
        return {}
    delays = [p for p in table if p.free and p.kind == "delay"]
    largest_s = max(float(np.max(np.abs(np.subtract(fit.values[p.name], p.without)))) for p in delays)
    # A fit without delays is its own baseline: a second fit of a quadruped took 120 s and changed no estimate.
    if largest_s < _NO_DELAY_S:
        return {NO_DELAY: as_numbers(table, fit.z, kept)}
    return {NO_DELAY: refit(fit.problem, kept, fit.z)}
