"""A walking policy on one GPU: the graph over bare steps, learnt steps a second, and the time to a policy.

Warp's kernels are built beforehand, with a row of their own; the compilation cache of a training is empty.
"""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benches.rows import Report, Row, markdown, missed, row
from benches.walk import Trial, judged
from benches.walking.over_bare import first_step, over_bare
from benches.walking.training import PIPELINE, add_training_flags, require_gpu, train
from sim2real.runtime.compilation_cache import OFF, VARIABLE

QUICK = {"copies": 64, "steps": [4000], "rollout": 2, "repeats": 1, "twins": 1, "seconds": 0.2}
KERNELS = "WARP_CACHE_PATH"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    add_training_flags(parser)
    parser.add_argument("--copies", type=int, default=8192, help="copies of the robot in the graph")
    parser.add_argument("--rollout", type=int, default=50, help="policy steps of a rollout")
    parser.add_argument("--repeats", type=int, default=7, help="rollouts whose median is reported")
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[60_000_000], help="steps of each training, from few to many"
    )
    parser.add_argument("--kernels", type=Path, help="folder of Warp's kernels; default: a new one")


def run(options: argparse.Namespace) -> Report:
    """Build kernels, compare with bare steps, then train until a policy follows its commands without a fall."""
    require_gpu("walk-train")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        os.environ[KERNELS] = str(options.kernels or Path(scratch) / "kernels")
        os.environ[VARIABLE] = OFF
        cold_s, warm_s = alone(first_step), alone(first_step)
        about = f"a first step of the graph takes {cold_s:.1f} s with them, {warm_s:.1f} s without"
        rows += shown([row("walk_train/kernels_s", round(cold_s - warm_s, 1), "s", about)])
        rows += shown(alone(over_bare, options.copies, options.repeats, options.rollout))
        for steps in options.steps:
            of_policy, walks = trained(options, steps, Path(scratch))
            rows += shown(of_policy)
            if walks:
                break
    return {"rows": rows}


def shown(rows: list[Row]) -> list[Row]:
    """Print rows at once, because a bench of minutes on a lent GPU may be cut short; return them."""
    for line in rows:
        print(*(line[key] for key in ("name", "value", "unit", "yardstick")), file=sys.stderr, flush=True)
    return rows


def alone(work: Callable[..., Any], *arguments: object) -> Any:
    """Return the result of a call in a new process, which leaves the GPU's memory with its end."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def trained(options: argparse.Namespace, steps: int, scratch: Path) -> tuple[list[Row], bool]:
    """Train with an empty compilation cache and judge the policy; return the rows, and whether it reaches the goals."""
    new = {VARIABLE: str(scratch / f"programs_{steps}")}
    done = train(steps, shlex.split(options.flags), scratch / f"runs_{steps}", new)
    name, calm = f"walk_train/{steps / 1e6:g}_M", Trial(PIPELINE, done.folder / "bundle", options.seconds)
    rows = [
        row(f"{name}/command_s", round(done.command_s, 1), "s", "from the command to the policy's bundle", "<= 120"),
        row(f"{name}/compile_s", round(done.compile_s, 1), "s", "of it: trace and compile, the cache empty"),
        row(f"{name}/train_s", round(done.train_s, 1), "s", "of it: training and evaluations"),
        row(f"{name}/steps", done.steps, "1", options.flags),
        row(f"{name}/learnt_steps_per_s", round(done.learnt_steps_per_s), "1/s", "one seed", ">= 1e6"),
    ]
    judge = judged({"calm": calm, "pushed": replace(calm, push_m_s=options.push)}, options.twins, name)
    return rows + judge, not any(missed(r) for r in judge if r["name"].startswith(f"{name}/calm/"))


LABELS = {
    "graph_over_bare": "the graph over as many bare `mjx.step`",
    "learnt_steps_per_s": "learnt steps a second",
    "command_s": "from the command to the policy's bundle",
    "compile_s": "of it: trace and compile",
    "calm/falls": "falls of its twins",
    "calm/error_m_s": "error of the velocity",
    "calm/error_rad_s": "error of the yaw rate",
    "pushed/falls": "falls with pushes",
    "kernels_s": "once on a machine: Warp's kernels",
}


def table(report: Report) -> str:
    """Return the figures of a walking policy's training on one GPU beside their goals."""
    of = {r["name"].removeprefix("walk_train/").split("/", 1)[-1]: r for r in report["rows"]}
    lines = []
    for name, label in LABELS.items():
        unit = f" {of[name]['unit']}".removesuffix(" 1")
        lines.append((label, f"{of[name]['value']:,}{unit}", of[name]["goal"] + ", missed" * missed(of[name])))
    return markdown(("", "measured", "goal"), lines)
