"""Identify dynamics, delays and initial states from recordings."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.estimation.quantity import Quantity
from sim2real.artifacts.identification import PARAMETERS, FreeRun, Identification
from sim2real.artifacts.run.manifest import sha256
from sim2real.artifacts.run.run_folder import Source, StageFolder, newest, open_stage
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.delays.links import links, measured
from sim2real.identify.fit import Fit, Told, as_numbers, refit
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span, beyond
from sim2real.identify.uncertainty import ensemble
from sim2real.identify.uncertainty.aggregate import aggregate
from sim2real.identify.uncertainty.noise import noises
from sim2real.identify.uncertainty.per_recording import identify_each
from sim2real.identify.uncertainty.uncertainty import sum_of
from sim2real.identify.validation import prediction
from sim2real.identify.validation.optional_terms import Selection
from sim2real.identify.validation.verdict import NO_DELAY
from sim2real.robots.contract import RecordedRobot
from sim2real.robots.worlds import in_world
from sim2real.stages.estimation import estimate, held_out_parts, recording_advice
from sim2real.stages.estimation.fitted_logs import require_apart
from sim2real.stages.estimation.free_run import Lack, fitted_to, free_runs, lacking, with_one_more
from sim2real.stages.estimation.segment_split import spans
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.identify.interrupted import Best, left_behind
from sim2real.stages.identify.true_values import true_values
from sim2real.stages.pipeline.open_log import open_recording, require_units
from sim2real.stages.pipeline.pipeline import Pipeline
from sim2real.stages.pipeline.python_arguments import AnyRecording, config_of, recordings_of, robot_first
from sim2real.stages.terminal.console import note, progress
from sim2real.stages.terminal.interruption import patiently

_NO_DELAY_S = 1e-4
"""Delays below this are none [s]."""
_HORIZONS = (0.1, 0.25, 0.5, 1.0)
"""Shares of the horizon at which prediction errors are listed."""


def identify(
    robot: RecordedRobot | Pipeline | str,
    recording: AnyRecording | Sequence[AnyRecording],
    config: IdentifyConfig | Mapping[str, Any] | None = None,
    hold_out: AnyRecording | Sequence[AnyRecording] = (),
    best: Best | None = None,
    begin: Mapping[str, float] | None = None,
) -> Identification:
    """Identify a robot's parameters.

    Args:
        robot: The robot, its pipeline, or the pipeline's name.
        recording: What is fitted: one recording, or several; or the paths of their logs.
        config: How; default: that of the pipeline that loaded the robot. A dict has what is different from it. The
            files that it may name are not read.
        hold_out: Recordings that are only predicted.
        best: Updated with the best values so far while the search runs.
        begin: Values at which the search begins; default: the pipeline's.

    Returns:
        Estimates, their uncertainty, what they predict, and a verdict.

    Raises:
        UsageError: When the recordings are too short, or the model does not fit them.
        Sim2RealError: When a recording holds no numbers where the model reads some, or other units.
    """
    pipeline, recording = robot_first(robot, recording)
    config = config_of(config, pipeline.identify)
    fitted = recordings_of(recording, pipeline)
    logs = [*fitted, *(recordings_of(hold_out, pipeline, "hold_out") if hold_out else ())]
    episodes = [log.episode for log in logs]
    robot = held_out_parts.offering(in_world(pipeline.load(), config.world), config.terms)
    for log in logs:
        require_units(log, robot)
    units = {**robot.units, **logs[0].units}
    model = robot.identifiable(config.max_delay_s)
    require_apart(fitted, logs[len(fitted) :], model, config.force)
    table = _table(model, config).with_begin(begin or {})
    best = best or Best()
    names = [f"log {i + 1}: {log.path.stem}" for i, log in enumerate(fitted)]
    windows = spans(episodes, len(fitted), config, config.settle_s + config.horizon_s)
    started = time.monotonic()
    every, found, choice = _with_terms(model, episodes, windows, config, table, names, best)
    best.fitted(found.z, found.loss)
    with progress(None, "identify: left-out parts") as bar:
        judged = config.folds and found.converged  # errors of other fits promise nothing of this one
        without = patiently(lambda: held_out_parts.examined(every, config, names, choice)) if judged else ()
        bar.set_description_str("identify: intervals")
        findings = patiently(lambda: estimate.Findings.of(found, without))
        found = findings.fit
        terms = found.problem.table.terms if every.problem.table.terms else None
        truth = true_values(logs[0], robot.roles) if config.reveal else {}
        bar.set_description_str("identify: posterior")
        posterior = patiently(lambda: ensemble.posterior(found, findings.at, findings.spread, every, choice))
        document = estimate.document(pipeline.name, findings, posterior, truth, time.monotonic() - started)
        bar.set_description_str("identify: predictions and baselines")
        document = patiently(lambda: _predicted(document, model, episodes, len(fitted), config, found))
        bar.set_description_str("identify: each recording, distribution of delays")
        each = patiently(lambda: _each(found)) if config.each and len(fitted) > 1 else ()
        own = patiently(lambda: links(found.problem, found.z)) if config.links else ()
        document = replace(document, left_out=without, terms=terms, links=own)
        bar.set_description_str("identify: free runs")
        base = in_world(pipeline.load(), config.world)
        lack = patiently(lambda: _lack(document, base, episodes, windows, config, found))
    outside = beyond(model, episodes, windows, config.settle_s + config.horizon_s)
    return replace(
        estimate.judged(document, findings, units, config.max_delay_s, outside, lack),
        logs=tuple(Source(log.path.name, sha256(log.path)) for log in logs),
        units=units,
        world=config.world,
        noise=noises(document.samples, units),
        aggregate=each,
        timing=fitted[0].timing,
    )


def _table(model: IdentifiableModel, config: IdentifyConfig) -> ParameterTable:
    """Return the parameters with what the user knows of them."""
    table = held_out_parts.widest(model.parameters.with_bounds(config.bounds), config.terms).with_fixed(config.fix)
    if config.links:
        measured(table)  # a model that has no such delay is refused before the search
    return table


def _with_terms(
    model: IdentifiableModel,
    episodes: Sequence[Episode],
    windows: Sequence[Span],
    config: IdentifyConfig,
    table: ParameterTable,
    names: Sequence[str],
    best: Best,
) -> tuple[Fit, Fit, Selection | None]:
    """Return the fit with all optional terms, that with those that are needed, and how they were chosen."""
    best.restart(table.for_recordings(len(episodes)))
    with _told("identify", best) as told:
        found = patiently(lambda: fitted_to(model, episodes, len(names), windows, config, table, told, _begins))
    if config.terms != "auto":
        return found, found, None
    with progress(None, "identify: sets of terms"):
        choice = patiently(lambda: held_out_parts.chosen(found, config, names))
    terms = choice.names(found.problem.table)
    # What a flag holds stays held, whatever term it belongs to; what is left out is what it is without its term.
    fewer = table.with_terms(terms).with_fixed(config.fix)
    fewer = fewer.with_nominal({p.name: found.values[p.name] for p in fewer if p.free and not p.per_recording})
    again = replace(config, generations=0)
    best.restart(fewer.for_recordings(len(episodes)))
    with _told(f"identify with {', '.join(terms) or 'no term'}", best) as told:
        narrow = patiently(lambda: fitted_to(model, episodes, len(names), windows, again, fewer, told))
    return found, narrow, choice


def run(pipeline: Pipeline, config: IdentifyConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Identify the pipeline's parameters, in a stage folder.

    Args:
        run_dir: Run folder to add to; None takes the one of the log.
    """
    robot = held_out_parts.offering(in_world(pipeline.load(), config.world), config.terms)
    paths, run_dir = find_logs(pipeline, config, root, run_dir)
    logs = [open_recording(path, pipeline, robot) for path in paths]
    fitted = len(logs) - len(config.hold_out)
    model = robot.identifiable(config.max_delay_s)
    _table(model, config)  # a wrong flag is refused before a folder is made
    if not config.force:
        require_apart(logs[:fitted], logs[fitted:], model, False)
    begin = _begin(config.begin, pipeline) if config.begin else None
    # Logs that are too short are refused before a folder is made.
    spans([log.episode for log in logs], fitted, config, config.settle_s + config.horizon_s)
    inputs = {"log" if i == 0 else f"log_{i}": path for i, path in enumerate(paths)}
    with (
        open_stage(root, pipeline.name, "identify", config, inputs, run_dir) as stage,
        left_behind(
            stage, pipeline.name, paths, lambda file: recording_advice.onward(pipeline, config, root, file)
        ) as best,
    ):
        found = identify(pipeline, logs[:fitted], config, logs[fitted:], best, begin)
        again = recording_advice.again(pipeline, config, root, found.verdict.next)
        if found.verdict.status == "not converged":
            again = recording_advice.onward(pipeline, config, root, stage.folder / PARAMETERS)
        verdict = replace(found.verdict, next=again)
        sources = tuple(Source.of(path, stage.run_dir) for path in paths)
        found = replace(found, logs=sources, verdict=verdict)
        for name, path in found.save(stage.folder).items():
            stage.output(name, path)
        for name, text in pipeline.texts().items():
            stage.output(Path(name).stem + "_" + Path(name).suffix[1:], name).write_text(text, encoding="utf-8")
        if (mjcf := robot.identified_mjcf(found.values)) is not None:
            stage.output("mjcf", "identified.xml").write_text(mjcf, encoding="utf-8")
        from sim2real.view.page.page import identify_page  # matplotlib and jinja2 take 0.5 s to import

        stage.output("page", identify_page(stage.folder).name)
        estimate.show(found)
        stage.summary(estimate.summary(found))
    return stage.result


def _begin(path: str, pipeline: Pipeline) -> dict[str, float]:
    """Return the values at which a search begins, from an earlier identification of the same robot."""
    found = Identification.load(Path(path))
    if found.pipeline != pipeline.name:
        raise UsageError(
            f"{path} is of pipeline {found.pipeline!r}, not of {pipeline.name!r}",
            hint="begin at an identification of the same robot, or leave --begin out",
        )
    return {p.name: p.estimate for p in found.parameters if p.kind != "derived" and p.verdict != "fixed"}


def find_logs(
    pipeline: Pipeline, config: IdentifyConfig, root: Path, run_dir: Path | None
) -> tuple[list[Path], Path | None]:
    """Return the logs to work on, those that are held out last, and the run folder to write into.

    Args:
        config: Names logs, or none: then the newest finished recording is taken.
        run_dir: Run folder that is asked first.
    """
    held_out = [Path(p) for p in config.hold_out]
    if config.log:
        return [Path(p) for p in config.log] + held_out, run_dir
    recorded = newest(root, pipeline.name, "record", run_dir)
    return [recorded.output("log"), *held_out], run_dir or recorded.run_dir


def _predicted(
    document: Identification,
    model: IdentifiableModel,
    episodes: Sequence[Episode],
    fitted: int,
    config: IdentifyConfig,
    found: Fit,
) -> Identification:
    """Return the document with the columns of all segments and of the free runs, and their errors."""
    problem = found.windows
    models = {"identified": found.values, **_baselines(found), "nominal": _nominal(model)}
    samples = prediction.samples(problem, models, config.settle_s)
    horizons = [round(share * config.horizon_s, 3) for share in _HORIZONS]
    runs, free = free_runs(found, episodes, fitted, config, models)
    return replace(
        document,
        samples=samples,
        free=free,
        settle_s=config.settle_s,
        prediction=tuple(prediction.errors(problem, samples, list(models), config.settle_s, horizons)),
        free_run=tuple(runs),
        segments=problem.segments,
        held_out_from_s=float(np.delete(problem.begins_s, problem.train).min(initial=np.inf)),
        sigma=dict(zip(prediction.labels(problem), (s for _, s, _ in problem.fields), strict=True)),
    )


def _lack(
    document: Identification,
    robot: RecordedRobot,
    episodes: Sequence[Episode],
    windows: Sequence[Span],
    config: IdentifyConfig,
    found: Fit,
) -> Lack:
    """Return what free runs show, after another fit where a term that the robot offers may mend them."""
    wider = with_one_more(robot, document.terms, config)
    fitted = len({s.recording for s in windows if s.fitted})

    def attempt() -> list[FreeRun]:
        assert wider is not None
        model, own = wider[0].identifiable(config.max_delay_s), wider[1]
        # From the beginning, as the command would: a fit that lacks the term has bent its other parameters.
        another = fitted_to(model, episodes, fitted, windows, own, _table(model, own))
        return free_runs(another, episodes, fitted, own, {"identified": another.values})[0]

    judged = found.converged and wider is not None
    return lacking(document, estimate.positions(found.problem, robot.units), attempt if judged else None)


def _begins(problem: Problem) -> None:
    note(f"engine: {problem.engine}")


def _baselines(found: Fit) -> dict[str, Any]:
    """Return the same model fitted without any delay, where it has some."""
    table = found.problem.table
    kept = np.array([c.parameter.kind != "delay" for c in table.columns])
    if kept.all():
        return {}
    late = [np.max(np.abs(found.values[p.name] - np.float64(p.without))) for p in table if p.free and p.kind == "delay"]
    # What has no delay is its own baseline: to fit it again took a quadruped two minutes, and changed nothing.
    none = max(late) < _NO_DELAY_S
    return {NO_DELAY: as_numbers(table, found.z, kept) if none else refit(found.problem, kept, found.z)}


def _nominal(model: IdentifiableModel) -> dict[str, float]:
    """Return the data sheet's values, without delays."""
    return {p.name: p.nominal for p in model.parameters}


def _each(found: Fit) -> tuple[Quantity, ...]:
    """Identify each log by itself, and combine."""
    single, table = identify_each(found), found.problem.table
    rows = []
    for name, unit, parts in estimate.quantities(table):
        values = np.array([sum(np.ravel(own[n])[0] for n in parts) for own, _ in single])
        errors = np.array([sum_of(spread, [table.names.index(n) for n in parts]) for _, spread in single])
        rows.append(aggregate(values, errors, name, unit))
    return tuple(rows)


@contextmanager
def _told(what: str, best: Best | None = None) -> Iterator[Told]:
    """Show a bar for search and refinement, and keep the best so far."""
    best = best or Best()
    with progress(100, what) as bar:

        def advance(stage: str, share: float, loss: float, z: np.ndarray) -> None:
            if stage in best.done:
                best.advance(stage, share, loss, z)
            bar.set_description_str(f"{what}: {stage}")
            bar.update(round(70 * best.done["search"] + 30 * best.done["refine"]) - bar.n)
            bar.set_postfix_str(f"loss {loss:.4f}" if np.isfinite(loss) else "")

        yield advance
        bar.update(100 - bar.n)
