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
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benches.rows import Report, Row, row

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


def about_held_out(runs: Sequence[dict[str, Any]]) -> list[tuple[str, str]]:
    """Return the table's line on errors on held-out data beside the errors that were expected before."""
    lines = [line for run in runs for line in run["compared"]]
    below, worst = sum(line["ratio"] <= 1.0 for line in lines), max(line["ratio"] for line in lines)
    text = f"{below} of {len(lines)} below the expected error; the worst is {worst:.2f} times as large"
    return [("errors on held-out data", text)]


def times(runs: Sequence[dict[str, Any]]) -> str:
    """Return the median time of each stage [s] as text."""
    return ", ".join(f"{stage} {statistics.median(run[f'{stage}_s'] for run in runs):.0f}" for stage in STAGES)


def sentence(report: Report, subject: str) -> str:
    """Return the sentence on the time of a run: the median over its seeds, and that of each stage."""
    total, *each = (statistics.median(r[f"{name}_s"] for r in report["runs"]) for name in ("total", *STAGES))
    record, identify, train, deploy = (f"{stage:.0f} s" for stage in each)
    return (
        f"On two CPU cores {subject} takes {total:.0f} s: {record} to record, {identify} to\n"
        f"identify, {train} to train and {deploy} to deploy.\n"
    )
