"""Train a policy on the identified model, with the timing that the robot really has."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.episode import Episode
from sim2real.graph.fitting import resample
from sim2real.graph.node import TICKS_PER_S, BaseNode
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.identify.posterior import Posterior
from sim2real.policy.bundle import save_bundle
from sim2real.policy.contract import ActionTerm, ObservationTerm, PolicyContract
from sim2real.runtime.compiled import CompiledGraph
from sim2real.stages.config import TrainConfig
from sim2real.stages.console import note, progress, table
from sim2real.stages.identify import load_log
from sim2real.stages.interruption import patiently
from sim2real.stages.manifest import sha256
from sim2real.stages.pipeline import Pipeline
from sim2real.stages.robot import Identifiable, Robot, moving_robot
from sim2real.stages.runs import StageFolder, newest, open_stage, resolved
from sim2real.train.env import GraphEnvironment
from sim2real.train.ppo import Progress, TrainResult, train

_LONGEST_GAP = 1.25
"""Timelines with a longer pause between policy steps than this many medians are drawn again."""
_HICCUP = 0.25
"""Steps that took longer than this share of the policy's period on the robot are not drawn from."""
_LEAST_SPREAD, _MOST = 0.02, 2.0
"""Copies differ by this share at least, and by no more than this factor: a log may have told nothing about one."""
_DRAWS = 1024


def run(pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None) -> StageFolder:
    """Train, and write the policy bundle.

    Args:
        pipeline: The robot.
        config: The stage's configuration.
        root: Folder of all runs.
        run_dir: Run folder to add to; None takes the one of the parameters.
    """
    robot = moving_robot(pipeline)
    path, run_dir = _find_parameters(pipeline, config, root, run_dir)
    identified = load_parameters(path, pipeline)
    log = resolved(identified["log"]["path"], path.resolve().parent.parent)
    if log.is_file() and sha256(log) != identified["log"].get("sha256"):
        note(f"warning: {log} is not the log that {path} was identified from: it has changed since")
    values, draws = model_values(robot, identified, config)
    delays = config.model == "identified"
    longest_s = _HICCUP / robot.RATE_HZ
    computation, dropped = computation_delays(load_log(log, pipeline), longest_s) if delays else ({}, {})
    nodes, task = robot.training(values, draws, computation, delays)
    with open_stage(root, pipeline.name, "train", config, {"parameters": path, "log": log}, run_dir) as stage:
        timeline, redrawn = draw_timelines(nodes, robot.SUPERVISOR, config)
        if dropped:
            steps = ", ".join(f"{count} of {name!r}" for name, count in dropped.items())
            note(f"steps longer than {1e3 * longest_s:g} ms are no part of the timing that is trained with: {steps}")
        env = GraphEnvironment(CompiledGraph(nodes, robot.SUPERVISOR, timeline), task)
        ppo = replace(config.ppo, eval_steps=env.length + 1)
        with progress(ppo.evaluations, "train (compiling)") as bar:
            result = patiently(lambda: train(env, ppo, jax.random.key(config.seed), lambda p: _report(bar, p)))
        hashes = {"log": sha256(log), "parameters": sha256(path)}
        contract = _contract(robot, task, values, hashes)
        save_bundle(stage.output("bundle", "bundle"), result.best.to_weights(), contract)
        stage.output("history", "history.json").write_text(json.dumps(_history(result), indent=1))
        print(table(*_rows(result)))
        best = result.history["success"].max()
        stage.summary(
            {
                "model": config.model,
                "success in simulation": f"{best:.2f} (seed {result.best_seed})",
                "policy steps": int(result.env_steps[-1]) * ppo.num_seeds,
                "policy steps a second": round(result.env_steps_per_s),
                "compile": f"{result.compile_s:.1f} s",
                "train": f"{result.train_s:.1f} s",
                "hiccups left out": sum(dropped.values()),
                "timelines drawn again": redrawn,
            }
        )
    return stage.result


def load_parameters(path: Path, pipeline: Pipeline) -> dict[str, Any]:
    """Read ``parameters.json`` of this pipeline.

    Raises:
        Sim2RealError: When it is missing, damaged or of another pipeline.
    """
    hint = f"make them with `sim2real identify {pipeline.name}`"
    try:
        document = json.loads(path.read_text())
        owner, log = document["pipeline"], document["log"]["path"]
        rows = {row["name"]: row for row in document["parameters"]}
        numbers = {n: [float(row[key]) for key in ("estimate", "standard_error")] for n, row in rows.items()}
        kinds = {row["kind"] for row in rows.values()}
        Posterior.from_json(document["posterior"])
    except Sim2RealError as error:
        raise Sim2RealError(f"{path} is damaged: it holds {error}", hint=hint) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = error.strerror if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise Sim2RealError(f"{path} holds no identified parameters: {reason}", hint=hint) from None
    if owner != pipeline.name:
        raise Sim2RealError(f"{path} holds parameters of pipeline {owner!r}, not of {pipeline.name!r}", hint=hint)
    robot = cast(Identifiable, pipeline.load())
    expected = robot.identifiable(pipeline.identify.max_delay_s).parameters.names
    lacking = [n for n in expected if n not in rows or not np.isfinite(numbers[n]).all()]
    if lacking or not isinstance(log, str) or not kinds <= {"dynamics", "delay", "measurement", "derived"}:
        what = f"no finite estimate of {', '.join(lacking)}" if lacking else "a kind or a log that is none"
        raise Sim2RealError(f"{path} is damaged: it holds {what}", hint=hint)
    return document


def model_values(
    robot: Robot, identified: Mapping[str, Any], config: TrainConfig
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Return the parameters to train on, and draws of the dynamics from their posterior, ``(K,)`` each.

    What the log tells about combinations of parameters holds in every draw; what it tells about none is cut off.
    """
    if config.model == "nominal":
        return robot.nominal(), {}
    rows = [p for p in identified["parameters"] if p["kind"] != "derived"]
    values = {p["name"]: float(p["estimate"]) for p in rows}
    rng = np.random.default_rng(config.seed)
    drawn = Posterior.from_json(identified["posterior"]).sample(rng, _DRAWS, config.randomise)
    draws = {}
    for p in rows:
        if p["kind"] == "dynamics" and p["name"] in drawn:
            value, error = values[p["name"]], config.randomise * float(p["standard_error"])
            size = abs(value) or 1e-9
            lacking = np.sqrt(max(0.0, _LEAST_SPREAD**2 - (error / size) ** 2))
            own = drawn[p["name"]] + lacking * size * rng.standard_normal(_DRAWS)
            low, high = sorted((value / _MOST, value * _MOST))
            draws[p["name"]] = np.clip(own, low, high)
    return values, draws


def computation_delays(
    episode: Episode, longest_s: float = math.inf
) -> tuple[dict[str, DelayDistribution], dict[str, int]]:
    """Return how long each node's steps took on the robot, thread wake-up and bus included.

    Args:
        episode: The log.
        longest_s: Longer steps are left out [s]: hiccups, which would put a pause into every timeline.

    Returns:
        The distributions by node, and how many steps were left out, for those nodes that had some.

    Raises:
        Sim2RealError: When that would be most steps of a node.
    """
    delays: dict[str, DelayDistribution] = {}
    dropped: dict[str, int] = {}
    for name, steps in episode.steps.items():
        took = (steps.end - steps.start) / TICKS_PER_S
        usual = took[took <= longest_s]
        if usual.size < 2 or usual.size < took.size / 2:
            raise Sim2RealError(
                f"only {usual.size} of {took.size} steps of node {name!r} took less than {1e3 * longest_s:g} ms",
                hint="record on a less busy machine, or lower the rates of the pipeline",
            )
        delays[name] = resample(usual)
        if usual.size < took.size:
            dropped[name] = int(took.size - usual.size)
    return delays, dropped


def draw_timelines(nodes: Mapping[str, BaseNode], supervisor: str, config: TrainConfig) -> tuple[Timeline, int]:
    """Draw timelines without long pauses of the policy.

    Returns:
        The timelines, and how many were drawn again.

    Raises:
        Sim2RealError: When most timelines have a pause.
    """
    rng = np.random.default_rng(config.seed)
    timeline = draw(nodes, config.episode_s, config.timelines, rng)
    redrawn = 0
    while (bad := _hiccups(timeline, supervisor)).any():
        redrawn += int(bad.sum())
        if redrawn > 20 * config.timelines:
            raise Sim2RealError(
                "nearly every timeline drawn from this log holds a pause of the policy",
                hint="record on a less busy machine, or train shorter episodes with --episode-s",
            )
        again = draw(nodes, config.episode_s, int(bad.sum()), rng)
        timeline = Timeline.stack([timeline[~bad], again]) if (~bad).any() else again
    return timeline, redrawn


def _hiccups(timeline: Timeline, supervisor: str) -> np.ndarray:
    vertex = timeline.vertices[supervisor]
    gaps = np.diff(vertex.start[:, : int(vertex.count.min())], axis=1)
    return gaps.max(axis=1) > _LONGEST_GAP * np.median(gaps)


def _find_parameters(
    pipeline: Pipeline, config: TrainConfig, root: Path, run_dir: Path | None
) -> tuple[Path, Path | None]:
    if config.parameters is not None:
        return Path(config.parameters), run_dir
    found = newest(root, pipeline.name, "identify", run_dir)
    return found.output("parameters"), run_dir or found.run_dir


def _contract(robot: Robot, task: Any, values: Mapping[str, float], hashes: Mapping[str, str]) -> PolicyContract:
    return PolicyContract(
        observation=tuple(ObservationTerm(name, units, history) for name, units, history in robot.OBSERVATION),
        action=tuple(
            ActionTerm(name, unit, float(low), float(high))
            for (name, unit), low, high in zip(robot.ACTION, task.action_low, task.action_high, strict=True)
        ),
        rate_hz=robot.RATE_HZ,
        delays_s={n: v for n, v in values.items() if n.endswith("_delay")},
        hashes=hashes,
    )


def _report(bar: Any, p: Progress) -> None:
    bar.set_description_str("train")
    bar.update(1)
    bar.set_postfix_str(f"return {p.values['return'].max():.0f}, success {p.values['success'].max():.2f}")


def _history(result: TrainResult) -> dict[str, Any]:
    return {
        "steps": result.env_steps.tolist(),
        "seconds": result.elapsed_s.tolist(),
        "best_seed": result.best_seed,
        "compile_s": result.compile_s,
        "train_s": result.train_s,
        "env_steps_per_s": result.env_steps_per_s,
        **{name: np.asarray(v, np.float64).tolist() for name, v in result.history.items()},
    }


def _rows(result: TrainResult) -> tuple[list[list[Any]], list[str]]:
    rows = [
        [int(steps), round(float(seconds), 1), float(ret.max()), float(success.max())]
        for steps, seconds, ret, success in zip(
            result.env_steps, result.elapsed_s, result.history["return"], result.history["success"], strict=True
        )
    ]
    return rows, ["steps", "seconds", "return", "success"]
