"""The arm's whole run for several seeds, and beside it the same training on the nominal model without delays."""

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

from sim2real.stages.runs import StageFolder, finished

STAGES = ("record", "identify", "train", "deploy")
CLOSE_M = 0.02


def main(arguments: list[str]) -> dict[str, Any]:
    """Run the arm once a seed; return the rows and a record of every seed."""
    parser = argparse.ArgumentParser(prog="bench.py arm")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--keep", type=Path, help="keep the run folders here")
    parser.add_argument("--no-nominal", action="store_true", help="leave the training on the nominal model out")
    parser.add_argument("--train", type=Path, metavar="RUN", help="only train, on an accelerator, in this run folder")
    options, flags = parser.parse_known_args(arguments)
    if options.train:
        return {"rows": train_rows(options.train.resolve(), flags)}
    if flags:
        parser.error(f"unknown: {' '.join(flags)}")
    with tempfile.TemporaryDirectory() as scratch:
        root = (options.keep or Path(scratch)).resolve()
        seeds = [run_seed(seed, root, not options.no_nominal) for seed in options.seeds]
    return {"rows": rows(seeds), "seeds": seeds}


def run_seed(seed: int, root: Path, nominal: bool) -> dict[str, Any]:
    """Run the arm, and the baseline where that is asked for, and collect what the stages measured."""
    runs = root / f"seed{seed}"
    begin = time.monotonic()
    _sim2real("run", "arm", "--seed", str(seed), "--runs", str(runs))
    result: dict[str, Any] = {"seed": seed, "total_s": time.monotonic() - begin}
    run_dir = next((runs / "arm").iterdir())
    done = {stage: _done(run_dir, stage) for stage in STAGES}
    result |= {f"{stage}_s": folder.manifest["duration_s"] for stage, folder in done.items()}
    result |= _identification(done["identify"])
    result["distances_m"] = _distances(done["deploy"])
    if nominal:
        baseline = runs / "nominal"
        shutil.copytree(run_dir, baseline)
        for flags in (["train", "arm", "--model", "nominal"], ["deploy", "arm"]):
            _sim2real(*flags, "--seed", str(seed), "--run", str(baseline), "--runs", str(runs))
        result["nominal_distances_m"] = _distances(_done(baseline, "deploy"))
    return result


def train_rows(run_dir: Path, flags: list[str]) -> list[dict[str, Any]]:
    """Train in a run folder that holds a recording and an identification; return how long that took."""
    import jax

    begin = time.monotonic()
    _sim2real("train", "arm", "--run", str(run_dir), "--runs", str(run_dir.parent.parent), *flags)
    total_s = time.monotonic() - begin
    history = json.loads(_done(run_dir, "train").output("history").read_text())
    success = np.max(history["success"], axis=1)
    good = np.flatnonzero(success >= 0.95)
    first_s = history["seconds"][int(good[0])] if good.size else None
    found = [
        ("compile_s", history["compile_s"], "s", ""),
        ("train_s", history["train_s"], "s", ""),
        ("time_to_0.95_s", first_s, "s", "< 180"),
        ("total_s", total_s, "s", ""),
        ("success", float(success.max()), "1", ""),
        ("env_steps_per_s", history["env_steps_per_s"], "1/s", ""),
    ]
    device = jax.devices()[0].device_kind
    return [
        {"name": f"arm/train/{n}", "value": v, "unit": unit, "yardstick": f"{device} {' '.join(flags)}", "goal": goal}
        for n, v, unit, goal in found
    ]


def rows(seeds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return every figure, one value a seed."""
    found = []

    def add(name: str, values: list[float], unit: str, yardstick: str = "", goal: str = "") -> None:
        found.append({"name": f"arm/{name}", "value": values, "unit": unit, "yardstick": yardstick, "goal": goal})

    for stage in (*STAGES, "total"):
        add(f"{stage}_s", [round(s[f"{stage}_s"], 1) for s in seeds], "s", "", "< 900" if stage == "total" else "")
    add("round_trip_error_ms", [round(s["round_trip_error_ms"], 2) for s in seeds], "ms", "true latency", "+-3")
    add("held_out_mae_mrad", [round(s["mae_mrad"], 2) for s in seeds], "mrad", "1 s ahead, held out", "< 10")
    for name in seeds[0]["errors"]:
        add(f"{name}_error", [round(100 * s["errors"][name], 2) for s in seeds], "%", "true parameter")
    for key, label in (("distances_m", "identified"), ("nominal_distances_m", "nominal")):
        if key in seeds[0]:
            reached = [int(np.sum(np.array(s[key]) < CLOSE_M)) for s in seeds]
            goal = "9 of 10" if label == "identified" else ""
            add(f"reached/{label}", reached, f"of {len(seeds[0][key])}", "within 2 cm at the end", goal)
            add(f"distance/{label}", [round(1e3 * float(np.median(s[key])), 1) for s in seeds], "mm", "median")
    return found


def _identification(folder: StageFolder) -> dict[str, Any]:
    document = json.loads(folder.output("parameters").read_text())
    by_name = {p["name"]: p for p in document["parameters"]}
    trip = by_name["round_trip_delay"]
    samples = np.load(folder.output("predictions"))
    ahead = samples["held_out"] & (samples["into"] > 0.3)
    joints = [n.removesuffix("_measured") for n in samples.files if n.endswith("_measured") and "velocity" not in n]
    errors = [np.abs(samples[f"{j}_identified"] - samples[f"{j}_measured"])[ahead].mean() for j in joints]
    return {
        "errors": {n: p["estimate"] / p["truth"] - 1 for n, p in by_name.items() if p["kind"] == "dynamics"},
        "round_trip_ms": 1e3 * trip["estimate"],
        "round_trip_error_ms": 1e3 * (trip["estimate"] - trip["truth"]),
        "mae_mrad": 1e3 * float(np.mean(errors)),
    }


def _distances(folder: StageFolder) -> list[float]:
    """Return how far the tip was from the target in the last half second of each deployment [m]."""
    return [e["real"]["distance_m"] for e in json.loads(folder.output("result").read_text())["episodes"]]


def _done(run_dir: Path, stage: str) -> StageFolder:
    done = finished(run_dir, stage)
    if done is None:
        raise SystemExit(f"{stage} did not finish in {run_dir}")
    return done


def _sim2real(*arguments: str) -> None:
    print("sim2real", *arguments, file=sys.stderr)
    subprocess.run([sys.executable, "-m", "sim2real.cli", *arguments], check=True, stdout=subprocess.DEVNULL)
