"""How much more a designed excitation tells than the usual one of the same length: intervals that are identified.

Each robot is recorded on the simulated clock by its own plant, latencies and gate: shortly with the usual excitation,
and identified. From that an excitation is designed. Then it is recorded twice more, with the usual excitation and with
the designed one, and identified from each of them alone.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benches import simulated_recordings as simulated
from benches.figures import row
from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.stages.config import RecordConfig
from sim2real.stages.excitation import excitation
from sim2real.stages.pipeline import Pipeline, load_pipeline

ROBOTS = ("pendulum", "arm", "so101")
QUICK = {"robots": ["pendulum"], "seconds": 12.0, "motions": 12, "first_s": 12.0, "seeds": [0]}
GOAL = 0.5


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--robots", nargs="*", default=list(ROBOTS), choices=ROBOTS, help="which robots")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="of signals, latencies and motions")
    parser.add_argument("--first-s", type=float, default=20.0, help="length of the first recording [s]")
    parser.add_argument("--seconds", type=float, default=40.0, help="length of those that are compared [s]")
    parser.add_argument("--motions", type=int, default=0, help="motions to choose from; 0: the stage's default")
    parser.add_argument("--motion-s", type=float, default=0.0, help="length of a motion [s]; 0: the stage's default")
    parser.add_argument("--generations", type=int, default=0, help="generations of each identification's search")


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Compare on each robot, with each seed."""
    found = []
    for name in options.robots:
        for seed in options.seeds:
            with tempfile.TemporaryDirectory() as folder:
                found.append({"robot": name, "seed": seed, **compared(name, seed, Path(folder), options)})
    return {"rows": [line for one in found for line in rows(one)], "robots": found}


def compared(name: str, seed: int, folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Return intervals, errors and limits of both excitations.

    Args:
        name: The robot.
        seed: Of signals, latencies and motions.
        folder: For the logs.
        options: Flags of the bench.
    """
    from sim2real.stages.design import design

    pipeline = load_pipeline(name)
    robot = pipeline.load()
    fitting = replace(pipeline.identify, folds=0, free_run_s=0.0, generations=options.generations, refine=1)
    asked = replace(pipeline.design, duration_s=options.seconds, seed=seed)
    made: dict[str, Any] = {}
    sessions, identified = {}, {}

    def recorded(key: str, signal: np.ndarray, number: int) -> None:
        import sim2real

        log = folder / f"{key}.mcap"
        session = simulated.record(pipeline, pipeline.record.gate, signal, number, log)
        sessions[key] = session
        identified[key] = sim2real.identify(pipeline, Recording.load(log), fitting)

    recorded("first", usual(pipeline, replace(pipeline.record, duration_s=options.first_s, seed=3 * seed)), 3 * seed)
    asked = replace(asked, motions=options.motions or asked.motions, motion_s=options.motion_s or asked.motion_s)
    planned = design(pipeline, identified["first"], asked)
    other = replace(pipeline.record, duration_s=options.seconds, seed=3 * seed + 1)
    recorded("usual", usual(pipeline, other), 3 * seed + 1)
    recorded("designed", planned.commands, 3 * seed + 2)
    gate = robot.gate(pipeline.record.gate)  # pyright: ignore[reportAttributeAccessIssue]
    for key in ("usual", "designed"):
        session = sessions[key]
        made[key] = {
            "intervals": intervals(identified[key]),
            "off": off(identified[key], session.truth),
            "misfit": identified[key].misfit,
            "verdict": identified[key].verdict.status,
            "cut_by_gate": session.clamped,
            "speed_share": float(np.max(session.speed_rad_s / gate.max_speed_rad_s)),
        }
    made["expected"] = {e.name: e.after / e.after_other for e in planned.expected}
    widths = {k: v / made["usual"]["intervals"][k] for k, v in made["designed"]["intervals"].items()}
    print(f"{name} {seed}: {np.median(list(widths.values())):.2f} of the interval", flush=True)
    return {**made, "ratios": widths, "seconds": len(planned.commands) / planned.rate_hz}


def usual(pipeline: Pipeline, config: RecordConfig) -> np.ndarray:
    """Return the commands of a robot's usual excitation ``(N, actions)``."""
    robot: Any = pipeline.load()
    return robot.around(excitation(config, robot.rate_hz, len(robot.action)).reshape(-1, len(robot.action)))


def intervals(found: Identification) -> dict[str, float]:
    """Return the widths of the 95 % intervals of what a log can tell: of delays their sum."""
    return {p.name: p.high95 - p.low95 for p in found.parameters
            if p.kind != "delay" and p.low95 is not None and p.high95 is not None}  # fmt: skip


def off(found: Identification, truth: dict[str, float]) -> dict[str, float]:
    """Return how far estimates are off the truth, in half-widths of their intervals: up to 1 the interval holds it."""
    known = {p.name: p for p in found.parameters if p.name in truth and p.low95 is not None and p.high95 is not None}
    return {n: abs(p.estimate - truth[n]) / (0.5 * (p.high95 - p.low95)) for n, p in known.items()}


def rows(one: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of one robot and seed."""
    base, ratios = f"excitation/{one['robot']}/seed{one['seed']}", list(one["ratios"].values())
    usually, designed = one["usual"], one["designed"]
    errors = float(np.median([v / max(usually["off"][n], 1e-9) * one["ratios"][n] for n, v in designed["off"].items()]))
    return [
        row(f"{base}/median_interval", float(np.median(ratios)), "of the usual excitation's", "", f"<= {GOAL}"),
        row(f"{base}/worst_interval", float(np.max(ratios)), "of the usual excitation's"),
        row(f"{base}/median_error", errors, "of the usual excitation's"),
        row(f"{base}/expected_median", float(np.median(list(one["expected"].values()))), "of the usual excitation's"),
        row(f"{base}/median_off", float(np.median(list(designed["off"].values()))), "half-widths",
            f"{np.median(list(usually['off'].values())):.2f} of the usual excitation"),
        row(f"{base}/cut_by_gate", designed["cut_by_gate"], "commands", "", "0"),
        row(f"{base}/highest_speed", designed["speed_share"], "of the gate's limit", "", "<= 1"),
    ]  # fmt: skip
