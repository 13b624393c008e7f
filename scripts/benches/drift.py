"""Does a deployment's log tell that the robot has changed, and what? Hidden pendulums, changed behind a policy's back.

Each is recorded, identified, and deployed: as it was, with twice the friction, with 30 % more mass, 15 ms later. The
policy is written by hand for the robot as it was: it pumps energy, then holds the pendulum upright.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benches import hidden_robots as hidden
from benches.figures import row

CHANGES = {"none": "", "friction": "friction", "payload": "payload", "delay": "round_trip_delay"}
"""What is done to the robot -> what is to be named."""
FRICTION, PAYLOAD, DELAY_S = 2.0, 1.3, 0.015
MASS_SHARE = 0.548
"""Of the pendulum's inertia, by its data sheet."""
LIMIT_V = 2.0
QUICK = {"runs": 1, "generations": 5, "record_s": 12.0, "seconds": 5.0, "folds": 0}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robot", choices=["pendulum"], default="pendulum", help="which kind of robot")
    parser.add_argument("--runs", type=int, default=40, help="hidden robots; each is deployed as it was, and changed")
    parser.add_argument("--first", type=int, default=0, help="number of the first of them")
    parser.add_argument("--changes", nargs="*", default=list(CHANGES), choices=list(CHANGES), help="what is changed")
    parser.add_argument("--record-s", type=float, default=40.0, help="length of the recording [s]")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of an episode [s]")
    parser.add_argument("--episodes", type=int, default=2, help="episodes of a deployment")
    parser.add_argument("--generations", type=int, default=80, help="generations of the search")
    parser.add_argument("--folds", type=int, default=5, help="parts that identification leaves out")
    parser.add_argument("--jobs", type=int, default=1, help="robots at the same time, one process each")


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Record, identify, change, deploy and test each robot."""
    numbers = list(range(options.first, options.first + options.runs))
    if options.jobs == 1:
        found = [one_robot(n, options) for n in numbers]
    else:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(options.jobs, mp_context=context) as pool:
            found = list(pool.map(one_robot, numbers, [options] * len(numbers)))
    return {"rows": rows(found, options), "robots": found}


def rows(found: list[dict[str, Any]], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the shares of alarms and of right names, with exact 95 % intervals."""
    lines = []
    for change in options.changes:
        tested = [r["changes"][change] for r in found if "alarms" in r["changes"][change]]
        alarms = sum(bool(t["alarms"]) for t in tested)
        base = f"drift/{options.robot}/{change}"
        wanted = "<= 0.05" if change == "none" else ">= 0.95"
        lines += _share(f"{base}/{'false_alarms' if change == 'none' else 'detected'}", alarms, len(tested), wanted)
        if change == "none":
            fine = sum(t["verdict"] != "re-identify" for t in tested)
            lines += _share(f"{base}/not_re_identified", fine, len(tested), "")
        else:
            right = sum(t["named"] == CHANGES[change] for t in tested)
            lines += _share(f"{base}/named", right, len(tested), ">= 0.9")
        lines.append(row(f"{base}/not_tested", len(found) - len(tested), f"of {len(found)}"))
    return lines


def _share(name: str, count: int, of: int, goal: str) -> list[dict[str, Any]]:
    if not of:
        return [row(name, float("nan"), "of 0", "", goal)]
    ends = binomtest(count, of).proportion_ci(method="exact")
    return [row(name, count / of, f"of {of}", "", goal), row(f"{name}/low95", ends.low, ""),
            row(f"{name}/high95", ends.high, "")]  # fmt: skip


def one_robot(number: int, options: argparse.Namespace) -> dict[str, Any]:
    """Return what the test said about one robot, as it was and changed.

    Args:
        number: Its number.
        options: Flags of the bench.
    """
    import sim2real
    from sim2real.artifacts.recording import Recording
    from sim2real.errors import Sim2RealError
    from sim2real.stages.judging import verdict_of
    from sim2real.stages.pipeline import load_pipeline
    from sim2real.stages.replaying import tested

    robot, pipeline = hidden.Hidden.draw(number), load_pipeline("pendulum")
    session = hidden.play(robot, hidden.excited(options.record_s, number), options.record_s, 0)
    said: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        hidden.write(Path(folder) / "session.mcap", session)
        config = replace(pipeline.identify, folds=options.folds, generations=options.generations, seed=number)
        identified = sim2real.identify(Recording.load(Path(folder) / "session.mcap"), pipeline, config)
        for place, change in enumerate(options.changes):
            logs, upright = [], []
            for e in range(options.episodes):
                played = hidden.play(
                    changed(robot, change), swing_up(robot), options.seconds, 1 + place * options.episodes + e
                )
                path = Path(folder) / f"{change}_{e}.mcap"
                hidden.write(path, played)
                logs.append(Recording.load(path).episode)
                upright.append(float((np.cos(played.angle) > 0.95)[len(played.t) // 2 :].mean()))
            try:
                replay, drifted = tested(pipeline, identified, logs)
            except Sim2RealError as error:
                said[change] = {"upright": upright, "refused": str(error)}
                continue
            told = verdict_of(replay, drifted)
            said[change] = {
                "upright": upright,
                "alarms": list(drifted.alarms),
                "named": drifted.named.name if drifted.named else "",
                "verdict": "" if told is None else told.status,
                "off": {r.name: [r.rmse, r.promised] for r in replay},
                "changes": [vars(c) for c in drifted.changes],
            }
            print(f"robot {number}, {change}: {drifted.changes[0].name}, alarms {drifted.alarms}", flush=True)
    about = {"number": number, "verdict": identified.verdict.status, "widening": identified.widening}
    return {**about, "truth": vars(robot), "changes": said}


def changed(robot: hidden.Hidden, change: str) -> hidden.Hidden:
    """Return the robot after something has changed.

    Args:
        robot: The robot.
        change: One of ``CHANGES``.
    """
    if change == "friction":
        return replace(robot, friction=FRICTION * robot.friction)
    if change == "delay":
        return replace(robot, acting=robot.acting + DELAY_S)
    if change == "payload":  # where the mass is: the inertia grows, too
        inertia = 1.0 + (PAYLOAD - 1.0) * MASS_SHARE
        others = {n: getattr(robot, n) / inertia for n in ("gain", "damping", "friction")}
        return replace(robot, gravity=PAYLOAD * robot.gravity / inertia, **others)
    return robot


def swing_up(robot: hidden.Hidden) -> hidden.Controller:
    """Return a policy that pumps energy until the pendulum comes up, and holds it there; it predicts over the delay.

    Args:
        robot: What it is made for.
    """
    gravity, late, parts = robot.gravity, robot.sensing + robot.acting, 8
    last = 0.0

    def act(angle: float, speed: float) -> float:
        nonlocal last
        for _ in range(parts):
            pushed = robot.gain * last + gravity * math.sin(angle) - robot.damping * speed
            speed += late / parts * pushed
            angle += late / parts * speed
        off = math.atan2(math.sin(angle), math.cos(angle))
        energy = 0.5 * speed**2 + gravity * (math.cos(off) - 1.0)
        if abs(off) < 0.5 and abs(speed) < 6.0:
            wanted = -(1.5 * gravity * off + 1.2 * math.sqrt(gravity) * speed) / robot.gain
        elif math.cos(off) < -0.9 and abs(speed) < 0.3:  # it hangs: anything moves it
            wanted = LIMIT_V
        else:
            wanted = -math.copysign(LIMIT_V, energy * speed) if abs(energy) > 0.05 * gravity else 0.0
        last = min(max(wanted, -LIMIT_V), LIMIT_V)
        return last

    return act
