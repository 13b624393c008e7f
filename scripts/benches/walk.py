"""A walking policy on hidden twins in C MuJoCo: falls, and errors of the velocity; with pushes, and on rough ground."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benches.rows import Report, Row, four_digits, markdown, missed, row

EVERY_S = 2.5
"""How long a command lasts [s]."""
QUICK = {"twins": 1, "seconds": 0.2, "push": 0.1, "rough_m": 0.01}
ERRORS = (("error_m_s", "m/s", "<= 0.08"), ("error_rad_s", "rad/s", "<= 0.1"))


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--pipeline", default="go2", help="pipeline of the robot")
    parser.add_argument("--bundle", type=Path, help="folder of the policy; default: the one that the pipeline ships")
    parser.add_argument("--twins", type=int, default=50, help="hidden twins")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of an episode [s]")
    parser.add_argument("--push", type=float, default=0.5, help="size of a push every 5 s [m/s]")
    parser.add_argument("--rough-m", type=float, default=0.04, help="height of the bumps of rough ground [m]")
    parser.add_argument(
        "--delays-ms", type=float, nargs="*", default=[], help="delays from motion to new targets, of all twins [ms]"
    )


def run(options: argparse.Namespace) -> Report:
    """Let the policy walk on all twins, without and with pushes."""
    calm = Trial(options.pipeline, options.bundle, options.seconds)
    pushed = replace(calm, push_m_s=options.push)
    trials = {"calm": calm, "pushed": pushed, "rough": replace(calm, rough_m=options.rough_m)}
    trials |= {f"pushed_{ms:g}_ms": replace(pushed, delay_s=ms / 1e3) for ms in options.delays_ms}
    return {"rows": judged(trials, options.twins, "walk")}


def judged(trials: Mapping[str, Trial], twins: int, prefix: str, goals: bool = True) -> list[Row]:
    """Return falls, errors and the judge's time for each trial, by its name behind the prefix."""
    workers = min(os.cpu_count() or 1, twins)
    rows: list[Row] = []
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for name, trial in trials.items():
            begin = time.perf_counter()
            played = pool.map(partial(one, trial), range(twins))
            fell, *errors = (np.array(column) for column in zip(*played, strict=True))
            about = f"{twins} twins, {trial.seconds:g} s{trial.about}"
            goal = ("<= 2" if trial.rough_m else "<= 0") * goals
            rows.append(row(f"{prefix}/{name}/falls", int(fell.sum()), f"of {twins}", about, goal))
            for (figure, unit, goal), values in zip(ERRORS, errors, strict=True):
                worst = f"worst twin {values.max():.3f}"
                rows.append(row(f"{prefix}/{name}/{figure}", four_digits(values.mean()), unit, worst, goal * goals))
            took_s = round(time.perf_counter() - begin, 1)
            rows.append(row(f"{prefix}/{name}/judge_s", took_s, "s", f"{workers} processes"))
    return rows


@dataclass(frozen=True)
class Trial:
    """A walk on a hidden twin.

    Attributes:
        bundle: Folder of the policy; None: the pipeline's.
        push_m_s: Size of a push every 5 s [m/s].
        rough_m: Height of the bumps of the ground; 0: it is flat [m].
        delay_s: Delay of the twin, about a third of it on the sensors' side [s]; None: the twin's own.
    """

    pipeline: str
    bundle: Path | None
    seconds: float
    push_m_s: float = 0.0
    rough_m: float = 0.0
    delay_s: float | None = None

    @property
    def about(self) -> str:
        """The disturbance as a phrase."""
        pushed = f", {self.push_m_s:g} m/s every 5 s" if self.push_m_s else ""
        return pushed + (f", bumps of {100 * self.rough_m:g} cm" if self.rough_m else "")


def one(trial: Trial, seed: int) -> tuple[bool, float, float]:
    """Walk on a hidden twin; return whether it fell, and the errors [m/s], [rad/s]."""
    from sim2real.emulation.body import HiddenTwin
    from sim2real.policy.bundle import load_bundle
    from sim2real.robots.walking.twin import STEP_S, Twin, walk
    from sim2real.stages.load import load_robot

    robot: Any = load_robot(trial.pipeline)
    rng = np.random.default_rng(seed)
    hidden = HiddenTwin.draw(np.random.default_rng(1000 + seed), len(robot.joints))
    if trial.delay_s is not None:
        sensing_s = round(trial.delay_s / 3 / STEP_S) * STEP_S  # whole steps of the twin: the sum stays exact
        hidden = replace(hidden, sensing_s=sensing_s, acting_s=trial.delay_s - sensing_s)
    twin = Twin(robot, hidden, seed, trial.rough_m)
    count = int(trial.seconds / EVERY_S) + 1
    commands = (
        rng.uniform(-1.0, 1.0, (count, 3)) * robot.commands.most * (rng.random((count, 1)) > robot.commands.stand)
    )
    runner = load_bundle(trial.bundle or robot.folder / "walk")
    walked = walk(twin, runner, lambda t_s: commands[int(t_s / EVERY_S + 1e-6)], trial.seconds, trial.push_m_s)
    return walked.fell_s is not None, walked.error_m_s, walked.error_rad_s


def table(report: Report) -> str:
    """Return the falls and errors of a walking policy, a line for each set of twins."""
    of = {r["name"].removeprefix("walk/"): r for r in report["rows"]}
    lines = []
    for case in [name.partition("/")[0] for name in of if name.endswith("/falls")]:
        falls, *errors = (of[f"{case}/{what}"] for what in ("falls", *(name for name, *_ in ERRORS)))
        delay = f", delay {case.split('_')[1]} ms" if case.endswith("_ms") else ""
        cells = [f"{r['value']:.3f} {r['unit']}" + f" (goal {r['goal']}, missed)" * missed(r) for r in errors]
        count = f"{falls['value']} {falls['unit']}" + f" (goal {falls['goal']}, missed)" * missed(falls)
        lines.append((falls["yardstick"] + delay, count, *cells))
    return markdown(("twins", "falls", "velocity error", "yaw rate error"), lines)
