"""Friction and zeros of the embedded SO-101, from 40 s of a multisine, of a teleoperated and of a shown motion.

The yardstick is the multisine. The teleoperated motion is a file as LeRobot's recorder writes it: 30 rows a second, in
degrees. The shown motion is recorded by hand: torque is off, and an emulated hand moves the arm in the emulator's
process; then the log is played. Errors are those of the estimates to the emulator's values.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import sim2real
from benches.figures import Report, Row, rmse, row
from sim2real.robots.gate_limits import GateLimits
from sim2real.robots.servo.drive import ServoDrive
from sim2real.stages.pipeline.pipeline import Pipeline, load_pipeline

QUICK = {"seconds": 14.0, "generations": 1, "population": 4, "refine_steps": 1, "cases": ["teleoperated"]}
FILE_HZ = 30.0
_MOVES_S, _PAUSES_S, _MARGIN_RAD = (1.0, 2.2), (0.0, 0.4), 0.03
"""Durations of a person's moves and pauses, and distance from the ends of the goals' box."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    cases = ["multisine", "teleoperated", "by_hand"]
    parser.add_argument("--cases", nargs="+", default=cases, choices=cases, help="excitations")
    parser.add_argument("--seconds", type=float, default=40.0, help="length of a recording")
    parser.add_argument("--generations", type=int, default=12, help="generations of the search")
    parser.add_argument("--population", type=int, default=24, help="candidates of a generation")
    parser.add_argument("--refine-steps", type=int, default=10, help="steps of the refinement")


def run(options: argparse.Namespace) -> Report:
    """Record and identify each case."""
    pipeline, rows, joints = load_pipeline("so101"), [], {}
    truth = _plant(pipeline).SO101Plant().truth()
    settings = {
        **{name: getattr(options, name) for name in ("generations", "population", "refine_steps")},
        **{"folds": 0, "free_run_s": 0.0},
    }
    for case in options.cases:
        with tempfile.TemporaryDirectory() as folder:
            excitation = _excitation(case, pipeline, Path(folder), options.seconds)
            config = {"excitation": excitation, "duration_s": options.seconds, "gate": _patient(pipeline)}
            recording = sim2real.record(pipeline, Path(folder) / "record", config)
            estimate = sim2real.identify(pipeline, recording, settings)
        rows += _rows(case, estimate, truth)
        joints[case] = {
            p.name: [p.estimate, truth[p.name]] for p in estimate.parameters if p.name.startswith("friction_")
        }
    return {"rows": rows, "estimate_and_truth": joints}


def person(low: np.ndarray, high: np.ndarray, seconds: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times ``(N,)`` [s] and angles ``(N, joints)`` [rad] of a person's moves from one pose to the next.

    Each move has least jerk, and some joints stay where they are.
    """
    rng = np.random.default_rng(seed)
    t_s, pose = [0.0], 0.5 * (low + high)
    poses = [pose]
    while t_s[-1] < seconds:
        aim = np.where(rng.random(len(low)) < 0.7, rng.uniform(low, high), pose)
        share = np.linspace(0.0, 1.0, 20)[1:]
        length_s = rng.uniform(*_MOVES_S)
        poses += [pose + (aim - pose) * (10 * s**3 - 15 * s**4 + 6 * s**5) for s in share]
        t_s += list(t_s[-1] + length_s * share)
        t_s.append(t_s[-1] + 1e-3 + rng.uniform(*_PAUSES_S))
        poses.append(aim)
        pose = aim
    return np.array(t_s), np.array(poses)


def _excitation(case: str, pipeline: Pipeline, folder: Path, seconds: float) -> str:
    """Return the value of ``--excitation`` of a case, for which a file is made."""
    robot = pipeline.load()
    servos = robot.drive.servos
    low, high = (np.asarray(end) for end in (servos.low, servos.high))
    t_s, pose = person(low + _MARGIN_RAD, high - _MARGIN_RAD, seconds + 1.0, seed=3)
    if case == "multisine":
        return case
    if case == "teleoperated":
        grid = np.arange(0.0, seconds, 1.0 / FILE_HZ)
        columns = [grid, *(np.rad2deg(np.interp(grid, t_s, joint)) for joint in pose.T)]
        header = ",".join(["t_s", *(f"action_{name}_deg" for name in servos.names)])
        file = folder / "teleoperated.csv"
        np.savetxt(file, np.stack(columns, axis=1), delimiter=",", header=header, comments="")
        return str(file)
    # The hand takes the arm from where it lies to its first pose, and waits for the recording to begin.
    start = np.asarray(_plant(pipeline).SO101Plant().data.qpos)
    path = folder / "hand.npz"
    np.savez(path, t_s=np.concatenate([[0.0, 1.0], 3.0 + t_s]), position=np.vstack([start, start, pose]))
    drive = robot.drive
    embedded = replace(drive.embedded, plant_args={"hand": str(path)})
    shown = type(robot)()
    shown.drive = ServoDrive(servos, embedded=lambda: embedded, settings=drive._settings)
    config = {"excitation": "hand", "duration_s": seconds + 3.0, "gate": _patient(pipeline)}
    return str(sim2real.record(shown, folder / "by_hand", config).path)


def _patient(pipeline: Pipeline) -> GateLimits:
    """Return limits that bear a busy machine, whose emulator answers late."""
    return replace(pipeline.record.gate, servo_watchdog_s=1.0, max_sample_age_s=3.0)


def _plant(pipeline: Pipeline) -> object:
    return pipeline.load("plant")


def _rows(case: str, estimate: sim2real.Identification, truth: dict[str, float]) -> list[Row]:
    """Return the errors of friction and zeros over the joints, and their mean half intervals."""
    rows = []
    for what, prefix, unit, scale in (("friction", "friction_", "%", 100.0), ("zero", "goal_offset_", "mrad", 1e3)):
        names = [p.name for p in estimate.parameters if p.name.startswith(prefix)]
        estimates = {p.name: p for p in estimate.parameters}
        size = np.array([abs(truth[n]) if what == "friction" else 1.0 for n in names])
        errors = np.array([estimates[n].estimate - truth[n] for n in names]) / size
        ends = [(estimates[n].low95, estimates[n].high95) for n in names]
        # A parameter that the data does not determine has no interval.
        widths = [(high - low) / 2 / s for (low, high), s in zip(ends, size, strict=True) if None not in (low, high)]
        width = round(scale * float(np.mean(widths)), 2) if widths else None
        rows += [
            row(f"excitation/{case}/{what}_error", round(scale * rmse(errors), 2), unit, "rms over the joints"),
            row(f"excitation/{case}/{what}_interval", width, unit, "mean half 95 %"),
        ]
    return [*rows, row(f"excitation/{case}/verdict", estimate.verdict.status, "")]
