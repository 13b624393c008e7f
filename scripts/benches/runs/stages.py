"""Whole runs of a robot through the command line: shared code of the benches of the demo and of the arm."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benches.figures import Row, row

from sim2real.artifacts.estimation.promise import promises_table
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run.manifest import plain
from sim2real.artifacts.run.run_folder import STAGES, StageFolder, finished


def add_flags(parser: argparse.ArgumentParser, seeds: list[int]) -> None:
    """Add the flags of a bench of whole runs, with its default seeds."""
    parser.add_argument("--seeds", type=int, nargs="+", default=seeds)
    parser.add_argument("--keep", type=Path, help="keep the run folders here")
    parser.add_argument("--no-nominal", action="store_true", help="without the training on the nominal model")


def run_seeds(
    options: argparse.Namespace, run_seed: Callable[[int, Path, argparse.Namespace], dict[str, Any]]
) -> list[Row]:
    """Return the results of ``run_seed(seed, folder, options)`` for each seed, each in its own folder."""
    with tempfile.TemporaryDirectory() as scratch:
        root = (options.keep or Path(scratch)).resolve()
        return [run_seed(seed, root / f"seed{seed}", options) for seed in options.seeds]


def sim2real(*arguments: str) -> None:
    """Run a command in a separate process, as a user does."""
    print("sim2real", *arguments, file=sys.stderr)
    subprocess.run([sys.executable, "-m", "sim2real.cli", *arguments], check=True, stdout=subprocess.DEVNULL)


def done(run_dir: Path, stage: str) -> StageFolder:
    """Return the finished stage of a run folder."""
    folder = finished(run_dir, stage)
    if folder is None:
        raise SystemExit(f"{stage} did not finish in {run_dir}")
    return folder


def whole_run(pipeline: str, seed: int, runs: Path, flags: list[str]) -> tuple[Path, dict[str, Any]]:
    """Run all stages; return the run folder, and their times and estimates."""
    begin = time.monotonic()
    sim2real("run", pipeline, "--seed", str(seed), "--runs", str(runs), *flags)
    result: dict[str, Any] = {"seed": seed, "total_s": time.monotonic() - begin}
    run_dir = next((runs / pipeline).iterdir())
    result |= {f"{stage}_s": done(run_dir, stage).manifest["duration_s"] for stage in STAGES}
    return run_dir, result | estimates(done(run_dir, "identify"))


def nominal_run(pipeline: str, seed: int, runs: Path, run_dir: Path) -> Path:
    """Train on the nominal model without delays, and deploy, in a copy of a run folder; return the copy."""
    copy = runs / "nominal"
    shutil.copytree(run_dir, copy)
    for flags in (["train", pipeline, "--model", "nominal"], ["deploy", pipeline]):
        sim2real(*flags, "--seed", str(seed), "--run", str(copy), "--runs", str(runs))
    return copy


def estimates(identify: StageFolder) -> dict[str, Any]:
    """Return the errors of the dynamics and of the round trip with a true value, those on held-out data with bounds."""
    fresh = [promise for promise in Identification.load(identify.folder).promises if promise.fresh]
    document = json.loads(identify.output("parameters").read_text())
    by_name = {p["name"]: p for p in document["parameters"]}
    trip = by_name["round_trip_delay"]
    dynamics = {n: p for n, p in by_name.items() if p["kind"] == "dynamics" and p["truth"]}
    return {
        "errors": {n: p["estimate"] / p["truth"] - 1 for n, p in dynamics.items()},
        "round_trip_ms": 1e3 * trip["estimate"],
        "round_trip_error_ms": 1e3 * (trip["estimate"] - trip["truth"]),
        "promises": plain(promises_table(fresh).records()),
    }


def deployed(run_dir: Path, quantity: str) -> list[float]:
    """Return a quantity of the score of every deployment on the robot."""
    result = json.loads(done(run_dir, "deploy").output("result").read_text())
    return [episode["real"][quantity] for episode in result["episodes"]]


def rows(name: str, seeds: list[Row], goals: dict[str, str]) -> list[Row]:
    """Return seconds and errors of whole runs, one value a seed; goals by the end of a row's name."""
    lines = []
    for stage in (*STAGES, "total"):
        values = [round(s[f"{stage}_s"], 1) for s in seeds]
        lines.append(row(f"{name}/{stage}_s", values, "s", "", goals.get(f"{stage}_s", "")))
    off = [round(s["round_trip_error_ms"], 2) for s in seeds]
    lines.append(row(f"{name}/round_trip_error_ms", off, "ms", "true latency", "+-3"))
    for parameter in seeds[0]["errors"]:
        values = [round(100 * s["errors"][parameter], 2) for s in seeds]
        lines.append(row(f"{name}/{parameter}_error", values, "%", "true parameter", goals.get("error", "")))
    return lines
