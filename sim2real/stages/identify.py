"""Identify dynamics, delays and initial states from a log."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.identify.problem import Problem
from sim2real.identify.search import SearchResult, cma_es
from sim2real.identify.uncertainty import Uncertainty, centred, uncertainty
from sim2real.log.reader import TruncatedLogWarning, read_log
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.console import note, progress, shown, table
from sim2real.stages.manifest import sha256
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.record import TRUTH
from sim2real.stages.robot import Robot
from sim2real.stages.runs import StageFolder, newest, open_stage
from sim2real.stages.truth import true_values

_WINDOW_SPACING_S = 0.5
_HORIZONS = (0.1, 0.25, 0.5, 1.0)
"""Shares of the horizon at which prediction errors are listed."""


def run(pipeline: Pipeline, config: IdentifyConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Identify the pipeline's parameters.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder to add to; None takes the one of the log.
    """
    robot = cast(Robot, pipeline.load())
    model = robot.identifiable(config.max_delay_s)
    model.parameters = model.parameters.with_bounds(config.bounds)
    path, run_dir = find_log(pipeline, config.log, root, run_dir)
    episode = load_log(path, pipeline)
    with open_stage(root, pipeline.name, "identify", config, {"log": path}, run_dir) as stage:
        problem = _problem(model, episode, config)
        begin = time.monotonic()
        found = _search(problem, config)
        found = replace(found, z=centred(problem.table, found.z))
        spread = uncertainty(problem, found.z)
        seconds = time.monotonic() - begin
        values = _floats(problem.table.decode(jnp.asarray(found.z)))
        truth = true_values(path.with_name(TRUTH), episode) if config.reveal else {}
        samples: dict[str, Any] = _predictions(problem, {"identified": values, "nominal": _nominal(problem)}, config)
        errors = _errors(problem, samples, config)
        document = _document(pipeline, path, problem, found, spread, values, truth, errors, seconds)
        document["units"] = dict(robot.UNITS)
        stage.output("parameters", "parameters.json").write_text(json.dumps(document, indent=1))
        np.savez_compressed(stage.output("predictions", "predictions.npz"), **samples)
        from sim2real.view.page import identify_page  # matplotlib and jinja2 take 0.5 s to import

        stage.output("page", identify_page(stage.folder).name)
        _print(document)
        last = [e for e in errors if e["held_out"] and e["horizon_s"] == config.horizon_s]
        stage.summary(
            {
                "log": shown(path),
                "round trip delay": f"{1e3 * document['parameters'][-1]['estimate']:.1f} ms",
                **{
                    f"{e['model']}, {config.horizon_s:g} s ahead": f"{e['rmse']:.4f} (held out)"
                    for e in last
                    if e["rmse"]
                },
                "search": f"{found.evaluations} candidates in {seconds:.0f} s",
            }
        )
    return stage.result


def find_log(pipeline: Pipeline, log: str | None, root: Path, run_dir: Path | None) -> tuple[Path, Path | None]:
    """Return the log to work on and the run folder to write into."""
    if log is not None:
        return Path(log), run_dir
    recorded = newest(root, pipeline.name, "record", run_dir)
    return recorded.output("log"), run_dir or recorded.run_dir


def load_log(path: Path, pipeline: Pipeline) -> Episode:
    """Read a log of this pipeline; a log that was cut is used as far as it goes.

    Raises:
        Sim2RealError: When it is no log, of another pipeline, or has holes.
    """
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
    holes = {n: m for n, m in (episode.metadata["log"].get("missing_steps") or {}).items() if m}
    if holes:
        raise Sim2RealError(f"{path} lacks steps of {', '.join(holes)}: a part of it is damaged", hint="record again")
    return episode


def _problem(model: Any, episode: Episode, config: IdentifyConfig) -> Problem:
    segment_s = config.settle_s + config.horizon_s
    begin, end = 0.3, episode.duration_s - segment_s - 0.2
    split = begin + (1.0 - config.held_out) * (episode.duration_s - begin)
    train = np.arange(begin, min(split - segment_s, end), segment_s)
    held_out = np.arange(split, end, _WINDOW_SPACING_S)
    if len(train) < 3 or len(held_out) < 1:
        raise UsageError(
            f"the log lasts {episode.duration_s:.1f} s: that makes {len(train)} segments of {segment_s:g} s to fit and "
            f"{len(held_out)} to hold out",
            hint="record for at least 12 s, or shorten --settle-s and --horizon-s",
        )
    begins = np.concatenate([train, held_out])
    return Problem(model, episode, begins, segment_s, config.max_delay_s, np.arange(len(begins)) < len(train))


def _search(problem: Problem, config: IdentifyConfig) -> SearchResult:
    with progress(config.generations, "identify") as bar:

        def advance(generations: int, best: float) -> None:
            bar.update(generations)
            bar.set_postfix_str(f"loss {best:.4f}")

        return cma_es(
            problem.losses, problem.table.start(), config.population, config.generations, config.seed, 0.7, advance
        )


def _nominal(problem: Problem) -> dict[str, float]:
    """Return the data sheet's values, without delays."""
    return {p.name: p.nominal for p in problem.table}


def _predictions(
    problem: Problem, models: Mapping[str, Mapping[str, float]], config: IdentifyConfig
) -> dict[str, np.ndarray]:
    """Return all samples of all segments as columns: time, segment, held_out, and per field measured and predicted."""
    held_out = ~np.isin(np.arange(problem.segments), problem.train)
    # What is fitted is simulated from the best initial state; what is held out from one that only knows its past.
    fit_s = jnp.asarray(np.where(held_out, config.settle_s, problem.segment_s), jnp.float32)
    predict = jax.jit(lambda v: jax.vmap(lambda e, f: problem.predict(v, e, f))(jnp.arange(problem.segments), fit_s))
    fields = [(f, s) for c in problem.channels for f, s in c.fields]
    columns: dict[str, np.ndarray] = {}
    for name, values in models.items():
        residuals, ts = (np.asarray(x, np.float64) for x in predict({k: jnp.float32(v) for k, v in values.items()}))
        at = np.nonzero(ts >= 0)
        if not columns:
            columns = {
                "t": problem.begins_s[at[0]] + ts[at],
                "segment": at[0],
                "held_out": held_out[at[0]],
                "into": ts[at],
            }
            for field, _ in fields:
                columns[f"{field}_measured"] = problem.measured(field)[at]
        for i, (field, sigma) in enumerate(fields):
            columns[f"{field}_{name}"] = columns[f"{field}_measured"] + residuals[..., i][at] * sigma
    return columns


def _errors(problem: Problem, samples: Mapping[str, np.ndarray], config: IdentifyConfig) -> list[dict[str, Any]]:
    """Return the error of each model after each horizon: RMSE of the first channel's position, and of its velocity."""
    channel = problem.channels[0]
    ahead = samples["into"] - config.settle_s
    rows = []
    for model in ("identified", "nominal", "hold"):
        for share in _HORIZONS:
            horizon_s = round(share * config.horizon_s, 3)
            for held_out in (False, True):
                pick = (samples["held_out"] == held_out) & (ahead > 0) & (ahead <= horizon_s)
                rmse = {}
                for field in (channel.position, channel.velocity):
                    measured = samples[f"{field}_measured"]
                    predicted = _held(samples, field, ahead) if model == "hold" else samples[f"{field}_{model}"]
                    squares = (predicted - measured)[pick] ** 2
                    rmse[field] = float(np.sqrt(np.mean(squares))) if squares.size else None
                rows.append(
                    {
                        "model": model,
                        "horizon_s": horizon_s,
                        "held_out": held_out,
                        "rmse": rmse[channel.position],
                        **{f"{f}_rmse": v for f, v in rmse.items()},
                    }
                )
    return rows


def _held(samples: Mapping[str, np.ndarray], field: str, ahead: np.ndarray) -> np.ndarray:
    """Return the prediction that nothing changes: each segment's last measurement before the horizon begins."""
    predicted = np.zeros_like(ahead)
    for segment in np.unique(samples["segment"]):
        rows = np.flatnonzero(samples["segment"] == segment)
        past = rows[ahead[rows] <= 0]
        predicted[rows] = samples[f"{field}_measured"][past[-1] if past.size else rows[0]]
    return predicted


def _document(
    pipeline: Pipeline,
    log: Path,
    problem: Problem,
    found: SearchResult,
    spread: Uncertainty,
    values: Mapping[str, float],
    truth: Mapping[str, float],
    errors: list[dict[str, Any]],
    seconds: float,
) -> dict[str, Any]:
    rows = [
        {
            "name": p.name,
            "unit": p.unit,
            "kind": p.kind,
            "about": p.about,
            "nominal": p.nominal,
            "estimate": values[p.name],
            "standard_error": float(spread.standard_error[i]),
            "low95": float(spread.low[i]),
            "high95": float(spread.high[i]),
            "lower": p.low,
            "upper": p.high,
            "verdict": spread.verdict[i],
            "truth": truth.get(p.name),
        }
        for i, p in enumerate(problem.table)
    ]
    rows.append(_round_trip(problem, spread, values, truth))
    return {
        "format": 1,
        "pipeline": pipeline.name,
        "log": {"path": str(log.resolve()), "sha256": sha256(log)},
        "parameters": rows,
        "covariance": {"names": list(problem.table.names), "matrix": spread.covariance.tolist()},
        "correlation": {"names": list(problem.table.names), "matrix": spread.correlation.tolist()},
        "residual_inflation": spread.inflation,
        "search": {"history": found.history.tolist(), "evaluations": found.evaluations, "seconds": seconds},
        "prediction": errors,
        "segments": problem.segments,
        "held_out_from_s": float(np.delete(problem.begins_s, problem.train)[0]),
    }


def _round_trip(
    problem: Problem, spread: Uncertainty, values: Mapping[str, float], truth: Mapping[str, float]
) -> dict[str, Any]:
    """Return the row of the sum of all delays: what a log tells even where it cannot tell them apart."""
    delays = [i for i, p in enumerate(problem.table) if p.kind == "delay"]
    names = [problem.table.names[i] for i in delays]
    error = float(np.sqrt(spread.covariance[np.ix_(delays, delays)].sum()))
    total = sum(values[n] for n in names)
    return {
        "name": "round_trip_delay",
        "unit": "s",
        "kind": "derived",
        "about": " + ".join(names),
        "nominal": 0.0,
        "estimate": total,
        "standard_error": error,
        "low95": total - 1.96 * error,
        "high95": total + 1.96 * error,
        "lower": sum(problem.table[n].low for n in names),
        "upper": sum(problem.table[n].high for n in names),
        "verdict": "accepted" if error < 0.005 else "not identifiable",
        "truth": truth.get("round_trip_delay"),
    }


def _print(document: Mapping[str, Any]) -> None:
    rows = []
    for p in document["parameters"]:
        off = "" if p["truth"] is None else f"{100 * (p['estimate'] / p['truth'] - 1):+.1f} %"
        interval = f"[{p['low95']:.4g}, {p['high95']:.4g}]"
        rows.append([p["name"], p["estimate"], interval, p["unit"], p["nominal"], p["truth"], off, p["verdict"]])
    print(table(rows, ["parameter", "estimate", "95 % interval", "unit", "nominal", "truth", "off by", "verdict"]))


def _floats(values: Mapping[str, Any]) -> dict[str, float]:
    return {n: float(v) for n, v in values.items()}
