"""Whole runs of a robot through the command line: shared code of the benches of the demo and of the arm."""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benches.rows import Report, Row, markdown, row

from sim2real.artifacts.files import plain
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.run import STAGES, StageFolder, finished


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
    result |= {f"{stage}_s": done(run_dir, stage).manifest.duration_s for stage in STAGES}
    return run_dir, result | estimates(done(run_dir, "identify"))


def nominal_run(pipeline: str, seed: int, runs: Path, run_dir: Path) -> Path:
    """Train on the nominal model without delays, and deploy, in a copy of a run folder; return the copy."""
    copy = runs / "nominal"
    shutil.copytree(run_dir, copy)
    for flags in (["train", pipeline, "--model", "nominal"], ["deploy", pipeline]):
        sim2real(*flags, "--seed", str(seed), "--run", str(copy), "--runs", str(runs))
    return copy


def estimates(identify: StageFolder) -> dict[str, Any]:
    """Return the errors of the dynamics and of the round trip with a true value, and on held-out data."""
    compared = [row for row in Identification.load(identify.folder).judged if row.ratio is not None]
    document = json.loads(identify.output("parameters").read_text())
    by_name = {p["name"]: p for p in document["parameters"]}
    trip = by_name["round_trip_delay"]
    dynamics = {n: p for n, p in by_name.items() if p["kind"] == "dynamics" and p["truth"]}
    return {
        "errors": {n: p["estimate"] / p["truth"] - 1 for n, p in dynamics.items()},
        "round_trip_ms": 1e3 * trip["estimate"],
        "round_trip_error_ms": 1e3 * (trip["estimate"] - trip["truth"]),
        "compared": [{**plain(row), "ratio": row.ratio} for row in compared],
    }


def deployed(run_dir: Path, quantity: str) -> list[float]:
    """Return a quantity of the score of every deployment on the robot."""
    result = json.loads(done(run_dir, "deploy").output("result").read_text())
    return [episode["real"][quantity] for episode in result["episodes"]]


def verdict(run_dir: Path) -> str:
    """Return the verdict of deploy, such as ``fine``."""
    return json.loads(done(run_dir, "deploy").output("result").read_text())["verdict"]["status"]


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


CLOSE_M, LEAST_UPRIGHT = 0.02, 0.9
"""Success of a deployment: distance of an arm from its target [m]; share of the last 5 s in which a pendulum is up."""


def table(*reports: Report) -> str:
    """Return the results of the pendulum, the arm and the SO-101: the worst of the errors, the sums of deployments."""
    rows = [
        "whole runs, each on a robot with noise of its own",
        "prediction of a held-out second",
        "round-trip delay, error",
        "held-out errors within the expected ones",
        "successful deployments",
        "the same training on nominal parameters without delays",
    ]
    columns = []
    for report in reports:
        runs = report["runs"]
        ratios = [line["ratio"] for run in runs for line in run["compared"]]
        if report["bench"] == "demo":
            name, unit = "pendulum: at least 90 % of the last 5 s upright", "share"
            error = f"{max(run['prediction_over_true_model'] for run in runs):.2f} times the true model's at most"
            kinds = ("deployments", "nominal_deployments")
        else:
            name = {"arm": "arm of three servos", "so101": "SO-101"}[report["bench"]] + ": within 2 cm of the target"
            error, unit = f"{max(run['mae_mrad'] for run in runs):.1f} mrad mean absolute error", "m"
            kinds = ("distances_m", "nominal_distances_m")
        counts = []
        for kind in kinds:
            scores = [score for run in runs for score in run[kind]]
            good = [score < CLOSE_M if unit == "m" else score >= LEAST_UPRIGHT for score in scores]
            middle = f", median {1e3 * statistics.median(scores):.1f} mm off" if unit == "m" else ""
            counts.append(f"{sum(good)} of {len(good)}{middle}")
        off = max(abs(run["round_trip_error_ms"]) for run in runs)
        truth = statistics.mean(run["round_trip_ms"] - run["round_trip_error_ms"] for run in runs)
        within = f"{sum(ratio <= 1.0 for ratio in ratios)} of {len(ratios)}, the worst {max(ratios):.2f} times as large"
        columns.append((name, str(len(runs)), error, f"{off:.1f} ms of {truth:.0f} ms", within, *counts))
    head, *lines = zip(("", *rows), *columns, strict=True)
    return markdown(head, lines, "l" * len(head))
