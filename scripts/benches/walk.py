"""A walking policy on hidden twins in C MuJoCo: falls, and errors of the velocity, without and with pushes."""

from __future__ import annotations

import argparse
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benches.figures import Report, Row, four_digits, row

EVERY_S = 2.5
"""How long a command lasts [s]."""
QUICK = {"twins": 1, "seconds": 0.2, "push": 0.1}
ERRORS = (("error_m_s", "m/s", "0.08"), ("error_rad_s", "rad/s", "0.1"))


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--pipeline", default="go2", help="pipeline of the robot")
    parser.add_argument("--bundle", type=Path, help="folder of the policy; default: the one that the pipeline ships")
    parser.add_argument("--twins", type=int, default=50, help="hidden twins")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of an episode [s]")
    parser.add_argument("--push", type=float, default=0.5, help="size of a push every 5 s [m/s]")
    parser.add_argument(
        "--delays-ms", type=float, nargs="*", default=[], help="delays from motion to new targets, of all twins [ms]"
    )


def run(options: argparse.Namespace) -> Report:
    """Let the policy walk on all twins, without and with pushes."""
    workers = min(os.cpu_count() or 1, options.twins)
    trials = [("calm", 0.0, None), ("pushed", options.push, None)]
    trials += [(f"pushed_{ms:g}_ms", options.push, ms / 1e3) for ms in options.delays_ms]
    rows: list[Row] = []
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for name, push, delay_s in trials:
            begin = time.perf_counter()
            play = partial(one, options.pipeline, options.bundle, options.seconds, push, delay_s)
            fell, *errors = (np.array(column) for column in zip(*pool.map(play, range(options.twins)), strict=True))
            about = f"{options.twins} twins, {options.seconds:g} s" + (f", {push:g} m/s every 5 s" if push else "")
            rows.append(row(f"walk/{name}/falls", int(fell.sum()), f"of {options.twins}", about, "0"))
            for (figure, unit, goal), values in zip(ERRORS, errors, strict=True):
                worst = f"worst twin {values.max():.3f}"
                rows.append(row(f"walk/{name}/{figure}", four_digits(values.mean()), unit, worst, goal))
            took_s = round(time.perf_counter() - begin, 1)
            rows.append(row(f"walk/{name}/judge_s", took_s, "s", f"{workers} processes"))
    return {"rows": rows}


def one(
    pipeline: str, bundle: Path | None, seconds: float, push: float, delay_s: float | None, seed: int
) -> tuple[bool, float, float]:
    """Walk on a hidden twin; return whether it fell, and the errors [m/s], [rad/s].

    Args:
        delay_s: Delay of the twin, a third of it on the sensors' side [s]; None: the twin's own.
    """
    from sim2real.policy.bundle import load_bundle
    from sim2real.robots.walking.twin import HiddenTwin, Twin, walk
    from sim2real.stages.pipeline.pipeline import load_pipeline

    found = load_pipeline(pipeline)
    robot: Any = found.load()
    rng = np.random.default_rng(seed)
    hidden = HiddenTwin.draw(np.random.default_rng(1000 + seed), len(robot.joints))
    if delay_s is not None:
        hidden = replace(hidden, sensing_s=delay_s / 3, acting_s=delay_s * 2 / 3)
    twin = Twin(robot, hidden, seed)
    count = int(seconds / EVERY_S) + 1
    commands = (
        rng.uniform(-1.0, 1.0, (count, 3)) * robot.commands.most * (rng.random((count, 1)) > robot.commands.stand)
    )
    runner = load_bundle(bundle or found.folder / "walk")
    walked = walk(twin, runner, lambda t_s: commands[int(t_s / EVERY_S + 1e-6)], seconds, push)
    return walked.fell_s is not None, walked.error_m_s, walked.error_rad_s
