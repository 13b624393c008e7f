"""Identify dynamics, delays and initial states from logs."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.identify import identifiability, prediction, uncertainty
from sim2real.identify.aggregate import aggregate
from sim2real.identify.fit import Fit, Told, as_numbers, fit, refit
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.posterior import Posterior
from sim2real.identify.problem import Problem
from sim2real.identify.round_trip import round_trip
from sim2real.identify.segments import Span, beyond, require_moved
from sim2real.identify.verdict import NO_DELAY, judge, scores
from sim2real.log.importer import import_file, load_mapping
from sim2real.log.reader import TruncatedLogWarning, read_log
from sim2real.stages import advice, identified
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.console import note, progress, shown
from sim2real.stages.interruption import patiently
from sim2real.stages.partial import Best, left_behind
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.record import TRUTH
from sim2real.stages.robot import Identifiable
from sim2real.stages.runs import StageFolder, newest, open_stage
from sim2real.stages.truth import true_values

_WINDOW_SPACING_S = 0.5
_HORIZONS = (0.1, 0.25, 0.5, 1.0)
"""Shares of the horizon at which prediction errors are listed."""
_EDGES_S = (0.3, 0.2)
"""What is left out at either end of a log where initial states are estimated [s]."""


@dataclass(frozen=True)
class Logs:
    """The logs of an identification: those that are fitted, then those that are held out whole."""

    paths: list[Path]
    episodes: list[Episode]
    fitted: int


def run(pipeline: Pipeline, config: IdentifyConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Identify the pipeline's parameters.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder to add to; None takes the one of the log.
    """
    robot = cast(Identifiable, pipeline.load())
    model = robot.identifiable(config.max_delay_s)
    table = model.parameters.with_bounds(config.bounds).with_fixed(config.fix)
    paths, run_dir = find_logs(pipeline, config, root, run_dir)
    fitted = len(paths) - len(config.hold_out)
    logs = Logs(paths, [load_log(p, pipeline) for p in paths], fitted)
    windows = spans(logs, config, config.settle_s + config.horizon_s)
    inputs = {"log" if i == 0 else f"log_{i}": p for i, p in enumerate(paths)}
    own = table.for_recordings(len(logs.episodes))
    with (
        open_stage(root, pipeline.name, "identify", config, inputs, run_dir) as stage,
        left_behind(stage, pipeline.name, paths, own) as best,
    ):
        begin = time.monotonic()
        with _told("identify", best) as told:
            found = patiently(lambda: _fit(model, logs, windows, config, table, told))
        with progress(None, "identify: errors, predictions and baselines"):
            at = patiently(lambda: uncertainty.linearise(found.problem, found.z))
            seconds = time.monotonic() - begin
            samples, free, rows = patiently(lambda: _predicted(model, logs, config, table, found))
        outside = beyond(model, logs.episodes, windows, config.settle_s + config.horizon_s)
        document = _judged(pipeline, logs, stage.run_dir, config, found, at, rows["prediction"], outside)
        document["verdict"]["next"] = advice.again(pipeline, config, root, document["verdict"].pop("flags"))
        document |= {**rows, "aggregate": _each(model, logs, config, table, found) if config.each else []}
        document["search"]["seconds"] = seconds
        stage.output("parameters", "parameters.json").write_text(json.dumps(document, indent=1))
        np.savez_compressed(stage.output("predictions", "predictions.npz"), **cast(Any, samples))
        if free:
            np.savez_compressed(stage.output("free_runs", "free_runs.npz"), **cast(Any, free))
        if write := getattr(robot, "identified_mjcf", None):
            stage.output("mjcf", "identified.xml").write_text(write(found.values))
        from sim2real.view.page import identify_page  # matplotlib and jinja2 take 0.5 s to import

        stage.output("page", identify_page(stage.folder).name)
        identified.show(document)
        stage.summary(identified.summary(document, [shown(p) for p in paths]))
    return stage.result


def _predicted(
    model: IdentifiableModel, logs: Logs, config: IdentifyConfig, table: ParameterTable, found: Fit
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Any]]:
    """Return the columns of all segments and of the free runs, and the rows of their errors for the document."""
    problem = found.windows
    models = {"identified": found.values, **_baselines(found), "nominal": _nominal(model)}
    samples = prediction.samples(problem, models, config.settle_s)
    horizons = [round(share * config.horizon_s, 3) for share in _HORIZONS]
    errors = prediction.errors(problem, samples, list(models), config.settle_s, horizons)
    runs, free = _free_runs(model, logs, config, table, models)
    rows = {
        "prediction": errors,
        "free_run": runs,
        "segments": problem.segments,
        "held_out_from_s": float(np.delete(problem.begins_s, problem.train).min(initial=np.inf)),
        "sigma": dict(zip(prediction.labels(problem), (s for _, s, _ in problem.fields), strict=True)),
    }
    return samples, free, rows


def _judged(
    pipeline: Pipeline,
    logs: Logs,
    run_dir: Path,
    config: IdentifyConfig,
    found: Fit,
    at: uncertainty.Linearised,
    errors: Sequence[Mapping[str, Any]],
    outside: Sequence[str],
) -> dict[str, Any]:
    """Return the document with estimates, what the recordings leave open, and the verdict."""
    units = dict(cast(Identifiable, pipeline.load()).UNITS)
    spread = uncertainty.from_linearised(found.problem, at)
    check = identifiability.from_linearised(found.problem, at)
    judged = scores(errors, identified.positions(found.problem, units))
    table = found.problem.table
    trip = round_trip(table, at.x, spread)
    verdict = judge(judged, table, at.x, spread, check, trip=trip, max_delay_s=config.max_delay_s, beyond=outside)
    path = logs.paths[0].with_name(TRUTH)
    truth = true_values(path, logs.episodes[0]) if config.reveal else {}
    return {
        **identified.document(pipeline.name, logs.paths, run_dir, found, spread, check, verdict, trip, truth),
        "units": units,
        "held_out": identified.scored(judged),
        "posterior": Posterior.of(table, found.z, spread.scale_covariance).to_json(),
    }


def find_logs(
    pipeline: Pipeline, config: IdentifyConfig, root: Path, run_dir: Path | None
) -> tuple[list[Path], Path | None]:
    """Return the logs to work on, those that are held out last, and the run folder to write into."""
    held_out = [Path(p) for p in config.hold_out]
    if config.log:
        return [Path(p) for p in config.log] + held_out, run_dir
    recorded = newest(root, pipeline.name, "record", run_dir)
    return [recorded.output("log"), *held_out], run_dir or recorded.run_dir


def load_log(path: Path, pipeline: Pipeline) -> Episode:
    """Read a log of this pipeline; a log that was cut is used as far as it goes.

    A file of another recorder is imported in memory, where the pipeline has a mapping for it.

    Raises:
        Sim2RealError: When it is no log, of another pipeline, or of a dry run, or has holes.
    """
    if path.suffix != ".mcap" and path.is_file() and (mapping := pipeline.folder / "import.toml").is_file():
        return import_file(path, load_mapping(mapping))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", TruncatedLogWarning)
        episode = read_log(path)
    for warning in caught:
        note(f"warning: {warning.message}; what is there is used")
    owner = episode.metadata.get("pipeline")
    if owner is None:
        raise Sim2RealError(
            f"{path} does not say which pipeline it is of: its metadata is damaged", hint="record again"
        )
    if owner != pipeline.name:
        raise Sim2RealError(
            f"{path} is a log of pipeline {owner!r}, not of {pipeline.name!r}", hint=f"run `sim2real identify {owner}`"
        )
    require_moved(episode, str(path))
    holes = {n: m for n, m in (episode.metadata["log"].get("missing_steps") or {}).items() if m}
    if holes:
        raise Sim2RealError(f"{path} lacks steps of {', '.join(holes)}: a part of it is damaged", hint="record again")
    return episode


def spans(logs: Logs, config: IdentifyConfig, length_s: float, spacing_s: float = _WINDOW_SPACING_S) -> list[Span]:
    """Return segments of a length: side by side where they are fitted, every half a second where they are held out.

    Raises:
        UsageError: When the logs are too short.
    """
    found: list[Span] = []
    for r, episode in enumerate(logs.episodes):
        begin, end = reach(episode, config)
        split = begin if r >= logs.fitted else begin + (1.0 - config.held_out) * (end - begin)
        last = end - length_s + 1e-6
        step_s = config.spacing_s or length_s
        found += [Span(r, float(b)) for b in np.arange(begin, min(split - length_s, last) + 1e-6, step_s)]
        found += [Span(r, float(b), False) for b in np.arange(split, last, spacing_s)]
    fitted = sum(s.fitted for s in found)
    if not fitted or fitted == len(found) or (config.initial_state == "free" and fitted < 3):
        lengths = ", ".join(f"{e.duration_s:.1f} s" for e in logs.episodes)
        raise UsageError(
            f"the logs last {lengths}: that makes {fitted} segments of {length_s:g} s to fit and "
            f"{len(found) - fitted} to hold out",
            hint="record for at least 12 s, or shorten --settle-s and --horizon-s",
        )
    return found


def reach(episode: Episode, config: IdentifyConfig) -> tuple[float, float]:
    """Return from when to when a log can be cut into segments [s]."""
    if config.initial_state != "free":
        return 0.0, episode.duration_s
    return _EDGES_S[0], episode.duration_s - _EDGES_S[1]


def _fit(
    model: IdentifiableModel,
    logs: Logs,
    windows: Sequence[Span],
    config: IdentifyConfig,
    table: ParameterTable,
    told: Told | None = None,
) -> Fit:
    longer = [s for s in spans(logs, config, config.long_s) if s.fitted] if config.long_s else []
    return fit(model, logs.episodes, windows, config.settle_s + config.horizon_s, config, table, longer, told)


def _baselines(found: Fit) -> dict[str, Any]:
    """Return the same model fitted without any delay, where it has some."""
    table = found.problem.table
    delays = {p.name: p.nominal for p in table if p.kind == "delay" and p.free}
    if not delays:
        return {}
    without = table.with_fixed(delays)
    if not len(without):
        return {NO_DELAY: as_numbers(without, np.zeros(0))}
    return {NO_DELAY: as_numbers(without, refit(found.problem, without, found.z))}


def _nominal(model: IdentifiableModel) -> dict[str, float]:
    """Return the data sheet's values, without delays."""
    return {p.name: p.nominal for p in model.parameters}


def _free_runs(
    model: IdentifiableModel,
    logs: Logs,
    config: IdentifyConfig,
    table: ParameterTable,
    models: Mapping[str, Any],
) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Simulate what is held out of each log in one go; return its errors and its columns."""
    held_out = []
    for r, episode in enumerate(logs.episodes):
        begin, end = reach(episode, config)
        split = begin if r >= logs.fitted else begin + (1.0 - config.held_out) * (end - begin)
        if end - split > config.settle_s + config.horizon_s:
            held_out.append(Span(r, split, False))
    if not held_out or not config.free_run_s:
        return [], {}
    length_s = min(config.free_run_s, min(reach(logs.episodes[s.recording], config)[1] - s.begin_s for s in held_out))
    problem = Problem(model, logs.episodes, held_out, length_s, config, table)
    columns = prediction.samples(problem, models, config.settle_s)
    return prediction.free_runs(columns, prediction.labels(problem), list(models), config.settle_s), columns


def _each(
    model: IdentifiableModel, logs: Logs, config: IdentifyConfig, table: ParameterTable, found: Fit
) -> list[dict[str, Any]]:
    """Identify each log by itself, and combine."""
    single, quantities = [], identified.quantities(table)
    shared = [p.name for p in table if not p.per_recording and p.kind != "delay"]
    start = table.with_nominal({n: float(found.values[n]) for n in shared})
    for r in range(logs.fitted):
        own = Logs([logs.paths[r]], [logs.episodes[r]], 1)
        windows = spans(own, config, config.settle_s + config.horizon_s)
        with _told(f"log {r + 1} of {logs.fitted}") as told:
            one = _fit(model, own, windows, config, start, told)
        single.append((one, one.uncertainty()))
    rows = []
    for name, unit, parts in quantities:
        values = np.array([sum(np.ravel(f.values[n])[0] for n in parts) for f, _ in single])
        errors = np.array([identified.error_of(f, u, parts) for f, u in single])
        total = aggregate(values, errors)
        rows.append(
            {
                "name": name,
                "unit": unit,
                "estimates": values.tolist(),
                "standard_errors": errors.tolist(),
                "mean": total.mean,
                "standard_error": total.standard_error,
                "between": total.between,
                "low95": total.low,
                "high95": total.high,
                "agree": total.agree,
            }
        )
    return rows


@contextmanager
def _told(what: str, best: Best | None = None) -> Iterator[Told]:
    """Show a bar for search and refinement, and keep the best so far."""
    best = best or Best()
    with progress(100, what) as bar:

        def advance(stage: str, share: float, loss: float, z: np.ndarray) -> None:
            best.advance(stage, share, loss, z)
            bar.set_description_str(f"{what}: {stage}")
            bar.update(round(70 * best.done["search"] + 30 * best.done["refine"]) - bar.n)
            bar.set_postfix_str(f"loss {loss:.4f}")

        yield advance
        bar.update(100 - bar.n)
