"""The whole demo for several seeds, and beside it the same training on the nominal model without delays."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.log.reader import read_log
from sim2real.stages.pipeline import load_pipeline
from sim2real.stages.runs import finished
from sim2real.stages.truth import true_values

SETTLE_S = 0.3


def main(arguments: list[str]) -> dict[str, Any]:
    """Run the demo once a seed; return the rows and a record of every seed."""
    parser = argparse.ArgumentParser(prog="bench.py demo")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--keep", type=Path, help="keep the run folders here")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch:
        root = options.keep or Path(scratch)
        seeds = [run_seed(seed, root.resolve()) for seed in options.seeds]
    return {"rows": rows(seeds), "seeds": seeds}


def run_seed(seed: int, root: Path) -> dict[str, Any]:
    """Run demo and baseline for one seed and collect what the stages measured."""
    runs = root / f"seed{seed}"
    begin = time.monotonic()
    _sim2real("demo", "--seed", str(seed), "--runs", str(runs))
    total_s = time.monotonic() - begin
    run_dir = next((runs / "pendulum").iterdir())
    result: dict[str, Any] = {"seed": seed, "total_s": total_s}
    for stage in ("record", "identify", "train", "deploy"):
        done = finished(run_dir, stage)
        if done is None:
            raise SystemExit(f"{stage} did not finish in {run_dir}")
        result[f"{stage}_s"] = done.manifest["duration_s"]
    result |= _identification(run_dir) | {"deployments": _deployments(run_dir)}
    baseline = runs / "nominal"
    shutil.copytree(run_dir, baseline)
    for flags in (["train", "pendulum", "--model", "nominal"], ["deploy", "pendulum"]):
        _sim2real(*flags, "--seed", str(seed), "--run", str(baseline), "--runs", str(runs))
    result["nominal_deployments"] = _deployments(baseline)
    return result


def rows(seeds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the worst and the middle of every figure over the seeds."""
    found = []

    def add(name: str, values: list[float], unit: str, yardstick: str, goal: str) -> None:
        found.append({"name": name, "value": values, "unit": unit, "yardstick": yardstick, "goal": goal})

    for stage in ("record", "identify", "train", "deploy", "total"):
        goal = {"train": "< 90", "total": "< 240"}.get(stage, "")
        add(f"demo/{stage}_s", [round(s[f"{stage}_s"], 1) for s in seeds], "s", "", goal)
    add("demo/round_trip_error_ms", [round(s["round_trip_error_ms"], 2) for s in seeds], "ms", "true latency", "+-3")
    for name in seeds[0]["group_errors"]:
        values = [round(100 * s["group_errors"][name], 2) for s in seeds]
        add(f"demo/{name}_error", values, "%", "true parameter", "+-5")
    ratio = [round(s["prediction_over_true_model"], 2) for s in seeds]
    add("demo/prediction_over_true_model", ratio, "1", "true model, same commands", "< 1.5")
    for key, label in (("deployments", "identified"), ("nominal_deployments", "nominal")):
        values = [round(d, 3) for s in seeds for d in s[key]]
        add(f"demo/upright/{label}", values, "share of the last 5 s", "", "> 0.9 in 9 of 10" if key[0] == "d" else "")
    return found


def _sim2real(*arguments: str) -> None:
    print("sim2real", *arguments, file=sys.stderr)
    subprocess.run([sys.executable, "-m", "sim2real.cli", *arguments], check=True, stdout=subprocess.DEVNULL)


def _deployments(run_dir: Path) -> list[float]:
    deploy = finished(run_dir, "deploy")
    if deploy is None:
        raise SystemExit(f"deploy did not finish in {run_dir}")
    return [e["real"]["success"] for e in json.loads(deploy.output("result").read_text())["episodes"]]


def _identification(run_dir: Path) -> dict[str, Any]:
    record, identify = finished(run_dir, "record"), finished(run_dir, "identify")
    if record is None or identify is None:
        raise SystemExit(f"record and identify did not finish in {run_dir}")
    document = json.loads(identify.output("parameters").read_text())
    by_name = {p["name"]: p for p in document["parameters"]}
    groups = {n: p["estimate"] / p["truth"] - 1 for n, p in by_name.items() if p["kind"] == "dynamics"}
    trip = by_name["round_trip_delay"]
    ratio, ours, theirs = prediction_ratio(record.output("log"), record.output("truth"), identify.output("predictions"))
    return {
        "group_errors": groups,
        "round_trip_ms": 1e3 * trip["estimate"],
        "round_trip_error_ms": 1e3 * (trip["estimate"] - trip["truth"]),
        "prediction_rmse_rad": ours,
        "true_model_rmse_rad": theirs,
        "prediction_over_true_model": ratio,
    }


def prediction_ratio(log: Path, truth: Path, predictions: Path) -> tuple[float, float, float]:
    """Compare one-second predictions on held-out data with those of the true plant.

    Both start from a state fitted to the same 0.3 s before; windows that start in the lower half-plane count.

    Returns:
        Ratio, RMSE of the identified model, RMSE of the true model [rad].
    """
    episode = read_log(log)
    true = true_values(truth, episode)
    samples = np.load(predictions)
    plant_class = load_pipeline("pendulum").load("plant").PendulumPlant
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
