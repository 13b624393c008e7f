"""The doctor on robots drawn at random, each deployed with one fault, with two, or with none."""

from __future__ import annotations

import argparse
import itertools
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benches.robots_that_fail import FAULTS, KINDS, deploy, draw, draw_faults, kinds_for, write_case
from benches.rows import Report, Row, markdown, missed, row

QUICK = {"robots": 1, "sound": 1, "pairs": 1, "seconds": 4.0, "kinds": ["pendulum"], "faults": ["scale"]}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robots", type=int, default=10, help="robots for each fault")
    parser.add_argument("--sound", type=int, default=40, help="robots without a fault")
    parser.add_argument("--pairs", type=int, default=20, help="robots with two faults")
    parser.add_argument("--seconds", type=float, default=15.0, help="length of a deployment [s]")
    parser.add_argument("--faults", nargs="*", default=list(FAULTS), help="faults that are drawn")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), help="kinds of robots that are drawn")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first robot")


def one(seconds: float, case: tuple[str, int, tuple[str, ...]]) -> tuple[list[str], float]:
    """Deploy a robot with faults; return what the doctor names, and its time [s]."""
    from sim2real.doctor.contract import read_policy
    from sim2real.doctor.diagnosis import diagnose
    from sim2real.doctor.log import read_deployment
    from sim2real.doctor.plant import Drives, driven_joints

    kind, seed, faults = case
    rng = np.random.default_rng([seed, 7])
    robot = draw(kind, seed)
    signals = deploy(robot, draw_faults(robot, faults, rng), seconds, rng)
    with tempfile.TemporaryDirectory() as folder:
        files = write_case(robot, signals, Path(folder), rng)
        begin = time.perf_counter()
        joints = tuple(driven_joints(files["mjcf"]))
        policy = read_policy(files["policy"], files["contract"], joints)
        log = read_deployment(files["log"], policy.contract.joints, joints)
        found = diagnose(policy, log, Drives(files["mjcf"], policy.contract), None, joints)
        return found.faults, time.perf_counter() - begin


def run(options: argparse.Namespace) -> Report:
    """Diagnose all robots."""
    cases: list[tuple[str, int, tuple[str, ...]]] = []
    seeds = range(options.first_seed, options.first_seed + 1000)
    chosen = lambda faults: [k for k in kinds_for(faults) if k in options.kinds]  # noqa: E731
    for fault in options.faults:
        kinds = chosen((fault,))
        cases += [(kinds[i % len(kinds)], seed, (fault,)) for i, seed in zip(range(options.robots), seeds) if kinds]  # noqa: B905
    cases += [(options.kinds[i % len(options.kinds)], seed, ()) for i, seed in zip(range(options.sound), seeds)]  # noqa: B905
    pairs = [p for p in itertools.combinations(options.faults, 2) if chosen(p) and not _one_thing(p)]
    drawn = np.random.default_rng(options.first_seed).permutation(len(pairs))[: options.pairs]
    cases += [(chosen(pairs[p])[i % len(chosen(pairs[p]))], seeds[i], pairs[p]) for i, p in enumerate(drawn)]

    workers = min(2, os.cpu_count() or 1)
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        results = list(pool.map(partial(one, options.seconds), cases))
    rows: list[Row] = []
    for fault in options.faults:
        own = [named for (_, _, faults), (named, _) in zip(cases, results, strict=True) if faults == (fault,)]
        hits, more = sum(fault in named for named in own), sum(len(set(named) - {fault}) > 0 for named in own)
        if own:
            goal = f">= {0.9 * len(own):g}"
            rows.append(row(f"doctor/{fault}", hits, f"of {len(own)}", f"{more} with another name too", goal))
    sound = [named for (_, _, faults), (named, _) in zip(cases, results, strict=True) if not faults]
    alarms = sum(bool(named) for named in sound)
    rows.append(row("doctor/false alarms", alarms, f"of {len(sound)}", "", "<= 2"))
    named_of = [(set(faults), set(named)) for (_, _, faults), (named, _) in zip(cases, results, strict=True)]
    both = [faults <= named for faults, named in named_of if len(faults) == 2]
    if both:
        rows.append(row("doctor/two faults", sum(both), f"of {len(both)}", "", f">= {0.6 * len(both):g}"))
    slowest = max(took_s for _, took_s in results)
    rows.append(
        row("doctor/longest", round(slowest, 1), "s", f"logs of {options.seconds:g} s, {workers} processes", "")
    )
    listed = [{"kind": k, "seed": s, "faults": list(f), "named": n, "took_s": round(t, 1)}
              for (k, s, f), (n, t) in zip(cases, results, strict=True)]  # fmt: skip
    return {"rows": rows, "cases": listed}


def _one_thing(pair: tuple[str, ...]) -> bool:
    """Return whether two faults are set in the same place, so that a deployment has only one of them."""
    same = [{"joint order", "left and right"}, {"gyro rotated twice", "world frame"}]
    same += [{"frozen imu", "gyro rotated twice"}, {"frozen imu", "world frame"}]
    return any(set(pair) <= places for places in same)


def table(report: Report) -> str:
    """Return a line for each fault."""
    lines = []
    for r in report["rows"]:
        named = f"{r['value']} {r['unit']}" + f" (goal {r['goal']}, missed)" * missed(r)
        lines.append((r["name"].removeprefix("doctor/"), named, r["yardstick"]))
    return markdown(("fault", "named", ""), lines, "lrl")
