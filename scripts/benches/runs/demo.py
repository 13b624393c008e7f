"""The whole demo for several seeds, and beside it the same training on the nominal model without delays."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from benches.rows import Report, Row, row
from benches.runs import stages

from sim2real.artifacts.recording import Recording
from sim2real.stages.identify.true_values import true_values
from sim2real.stages.load import load_module

SETTLE_S = 0.3
QUICK = {
    "seeds": [0],
    "no_nominal": True,
    "flags": [
        *("--record.duration-s=6", "--identify.generations=10", "--identify.population=8"),
        *(
            "--train.force",
            "--train.episode-s=2",
            "--train.timelines=4",
            "--train.ppo.total-steps=512",
            "--train.ppo.num-envs=16",
        ),
        *("--train.ppo.minibatches=2", "--train.ppo.evaluations=1"),
        *("--deploy.episodes=1", "--deploy.duration-s=1", "--deploy.no-measure-delay"),
    ],
}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    stages.add_flags(parser, seeds=[0, 1, 2, 3, 4])
    parser.add_argument("flags", nargs="*", help="behind --: flags of `sim2real run pendulum`")


def run(options: argparse.Namespace) -> Report:
    """Run the demo once a seed; return the rows and a record of every seed."""
    runs = stages.run_seeds(options, run_seed)
    return {"rows": rows(runs), "runs": runs}


def run_seed(seed: int, runs: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Run demo and baseline for one seed; return the results of the stages."""
    run_dir, result = stages.whole_run("pendulum", seed, runs, options.flags)
    record, identify = stages.done(run_dir, "record"), stages.done(run_dir, "identify")
    ratio, ours, theirs = prediction_ratio(record.output("log"), record.output("truth"), identify.output("predictions"))
    result |= {
        "prediction_rmse_rad": ours,
        "true_model_rmse_rad": theirs,
        "prediction_over_true_model": ratio,
        "deployments": stages.deployed(run_dir, "success"),
        "verdict": stages.verdict(run_dir),
    }
    if not options.no_nominal:
        baseline = stages.nominal_run("pendulum", seed, runs, run_dir)
        result["nominal_deployments"] = stages.deployed(baseline, "success")
    return result


def rows(seeds: list[Row]) -> list[Row]:
    """Return every figure, one value a seed; of deployments, one each."""
    lines = stages.rows("demo", seeds, {"train_s": "< 90", "total_s": "< 240", "error": "+-5"})
    ratio = [round(s["prediction_over_true_model"], 2) for s in seeds]
    lines.append(row("demo/prediction_over_true_model", ratio, "1", "true model, same commands", "< 1.5"))
    wrong = sum(s["verdict"] == "re-identify" for s in seeds)
    lines.append(row("demo/re_identify", wrong, f"of {len(seeds)} demos", "the robot is the identified one", "<= 0"))
    for key, label in (("deployments", "identified"), ("nominal_deployments", "nominal")):
        if key in seeds[0]:
            values = [round(d, 3) for s in seeds for d in s[key]]
            goal = "> 0.9 in 9 of 10" if label == "identified" else ""
            lines.append(row(f"demo/upright/{label}", values, "share of the last 5 s", "", goal))
    return lines


def prediction_ratio(log: Path, truth: Path, predictions: Path) -> tuple[float, float, float]:
    """Compare one-second predictions on held-out data with those of the true plant.

    Both start from a state fitted to the same 0.3 s before; windows that start in the lower half-plane count.

    Returns:
        Ratio, RMSE of the identified model, RMSE of the true model [rad].
    """
    recording = Recording.load(log, truth)
    episode, true = recording.episode, true_values(recording)
    samples = np.load(predictions)
    plant_class = load_module("pendulum", "plant").PendulumPlant
    ours, theirs = [], []
    for segment in np.unique(samples["segment"][samples["held_out"]]):
        pick = samples["segment"] == segment
        ahead = samples["into"][pick] - SETTLE_S
        measured = samples["th_measured"][pick]
        if np.cos(measured[np.searchsorted(ahead, 0.0) - 1]) >= 0:
            continue
        predicted = _true_prediction(plant_class, episode, true, samples["t"][pick], measured, ahead <= 0)
        ours.append((samples["th_identified"][pick] - measured)[ahead > 0])
        theirs.append((predicted - measured)[ahead > 0])
    rmse = [float(np.sqrt(np.mean(np.concatenate(x) ** 2))) for x in (ours, theirs)]
    return rmse[0] / rmse[1], rmse[0], rmse[1]


def _true_prediction(
    plant_class: Any, episode: Any, true: dict[str, float], t: np.ndarray, measured: np.ndarray, past: np.ndarray
) -> np.ndarray:
    """Simulate the true plant with the logged commands from a state fitted to the past samples (Gauss-Newton)."""
    slope = np.polyfit(t[past], measured[past], 2)
    begin = float(t[0] - true["sensor_delay"])
    at = t[0]
    state = np.array([np.polyval(slope, at), np.polyval(np.polyder(slope), at)])
    for _ in range(4):
        base = _simulate(plant_class, episode, true, begin, state, t)
        columns = []
        for i, step in enumerate((1e-4, 1e-3)):
            moved = state.copy()
            moved[i] += step
            columns.append((_simulate(plant_class, episode, true, begin, moved, t) - base) / step)
        J = np.stack(columns, axis=1)[past]
        state = state - np.linalg.lstsq(J, (base - measured)[past], rcond=None)[0]
    return _simulate(plant_class, episode, true, begin, state, t)


def _simulate(
    plant_class: Any, episode: Any, true: dict[str, float], begin: float, state: np.ndarray, t: np.ndarray
) -> np.ndarray:
    plant = plant_class()
    plant.data.qpos[0], plant.data.qvel[0] = state
    effects = episode.steps["actuator"].end / 1e6 + true["actuator_delay"] - begin
    volts = episode.outputs["actuator"]["action"][:, 0]
    k = max(int(np.searchsorted(effects, 0.0)) - 1, 0)
    plant.command(1, 16, volts[k] / 5.0)
    angles = []
    for sample in t - true["sensor_delay"] - begin:
        while k + 1 < len(effects) and effects[k + 1] <= sample:
            k += 1
            plant.advance(max(float(effects[k]), 0.0))
            plant.command(1, 16, volts[k] / 5.0)
        plant.advance(max(float(sample), 0.0))
        angles.append(float(plant.data.qpos[0]))
    return np.array(angles)
