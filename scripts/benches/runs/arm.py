"""Whole runs of an arm that reaches for targets, ``arm`` or ``so101``, for several seeds.

Beside each stands the same training on the nominal model without delays.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from benches.rows import Report, Row, row
from benches.runs import demo, stages

SETTLE_S = 0.3
"""Time of a prediction before it is compared [s]."""
QUICK = demo.QUICK


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    stages.add_flags(parser, seeds=[0])
    parser.add_argument("flags", nargs="*", help="behind --: flags of `sim2real run`")


def run(options: argparse.Namespace) -> Report:
    """Run the arm once a seed; return the rows and a record of every seed."""
    runs = stages.run_seeds(options, run_seed)
    return {"rows": rows(options.bench, runs), "runs": runs}


def run_seed(seed: int, runs: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Run the arm and, unless --no-nominal, the baseline; return the results of the stages."""
    run_dir, result = stages.whole_run(options.bench, seed, runs, options.flags)
    result["mae_mrad"] = held_out_mae_mrad(stages.done(run_dir, "identify").output("predictions"))
    # Distance of the tip from the target in the last half second of each deployment.
    result["distances_m"] = stages.deployed(run_dir, "distance_m")
    if not options.no_nominal:
        baseline = stages.nominal_run(options.bench, seed, runs, run_dir)
        result["nominal_distances_m"] = stages.deployed(baseline, "distance_m")
    return result


def held_out_mae_mrad(predictions: Path) -> float:
    """Return the mean absolute error of predicted joint positions on held-out data [mrad]."""
    samples = np.load(predictions)
    ahead = samples["held_out"] & (samples["into"] > SETTLE_S)
    joints = [n.removesuffix("_measured") for n in samples.files if n.endswith("_measured") and "velocity" not in n]
    errors = [np.abs(samples[f"{j}_identified"] - samples[f"{j}_measured"])[ahead].mean() for j in joints]
    return 1e3 * float(np.mean(errors))


def rows(arm: str, seeds: list[Row]) -> list[Row]:
    """Return every figure of an arm, one value a seed."""
    lines = stages.rows(arm, seeds, {"total_s": "< 900"})
    mae = [round(s["mae_mrad"], 2) for s in seeds]
    lines.append(row(f"{arm}/held_out_mae_mrad", mae, "mrad", "1 s ahead, held out", "< 10"))
    for key, label in (("distances_m", "identified"), ("nominal_distances_m", "nominal")):
        if key in seeds[0]:
            reached = [int(np.sum(np.array(s[key]) < stages.CLOSE_M)) for s in seeds]
            goal = ">= 9" if label == "identified" else ""
            lines.append(
                row(f"{arm}/reached/{label}", reached, f"of {len(seeds[0][key])}", "within 2 cm at the end", goal)
            )
            middle = [round(1e3 * float(np.median(s[key])), 1) for s in seeds]
            lines.append(row(f"{arm}/distance/{label}", middle, "mm", "median"))
    return lines
