"""The sets of the league: all recordings, and their parts that are held out in turn."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from benches.identify import recordings
from benches.identify.sysid import Recording
from benches.identify.sysid_rows import recording
from sim2real.errors import UsageError

DISK_BLOCK, DISK_BLOCKS, PAST = 5000, 5, 12
GO2_BLOCKS = 3
STS_KP, STS_DUTY_PER_KP = 32, 0.166
"""Firmware gain of the STS3250's recordings, and the duty per radian of error that one unit of it makes: BAM's source,
bam/feetech/actuator.py."""


@dataclass(frozen=True)
class Fold:
    """Recordings to fit, and held-out ones to predict.

    Attributes:
        spec: Both in the syntax of ``benches/identify/recordings.py``: (fit, test); None for a set without a pipeline.
    """

    name: str
    fitted: tuple[Recording, ...]
    test: tuple[Recording, ...]
    spec: tuple[str, str] | None = None


@dataclass(frozen=True)
class LeagueSet:
    """Recordings of one rig.

    Attributes:
        folder: Its folder below ``--data``.
        unit: Unit of its figure.
        score: Predicted positions ``(N, joints)`` and the recording -> the figure.
        folds: Makes the folds from the folder of all data.
    """

    name: str
    folder: str
    unit: str
    score: Callable[[np.ndarray, Recording], float]
    folds: Callable[[Path], list[Fold]]


def rmse_rad(predicted: np.ndarray, recording: Recording) -> float:
    """Return the root mean square error over time and joints [rad]."""
    return float(np.sqrt(np.mean((predicted - recording.position) ** 2)))


def rmse_mrad(predicted: np.ndarray, recording: Recording) -> float:
    """Return the median over the joints that are moved of the root mean square error [mrad]."""
    each = 1e3 * np.sqrt(np.mean((predicted - recording.position) ** 2, axis=0))
    return float(np.median(each[np.ptp(recording.command, axis=0) > 0.02]))


def mae_mrad(predicted: np.ndarray, recording: Recording) -> float:
    """Return the mean absolute error [mrad]."""
    return float(1e3 * np.mean(np.abs(predicted - recording.position)))


def part(t: np.ndarray, command: np.ndarray, position: np.ndarray, begin: int, end: int, ahead: bool) -> Recording:
    """Return samples of a longer recording, with a state at their begin from a cubic through the samples around it.

    Args:
        t: Stamps ``(N,)`` [s].
        command: Shape ``(N, k)``.
        position: Shape ``(N, joints)`` [rad].
        ahead: Whether samples behind ``begin`` may be used: for predicted parts only those before it.
    """
    near = slice(max(begin - PAST, 0), begin + (PAST if ahead else 1))
    if near.stop - near.start < PAST:  # where ours begins: recordings.PAST samples in
        begin += recordings.PAST
        near = slice(begin - PAST, begin + (PAST if ahead else 1))
    fits = [np.polyfit(t[near] - t[begin], angles[near], 3) for angles in position.T]
    start = np.array([[f[3], f[2]] for f in fits])
    return Recording(t[begin:end] - t[begin], command[begin:end], position[begin:end], start)


def blocks(
    t: np.ndarray, command: np.ndarray, position: np.ndarray, edges: Sequence[int], named: Callable[[int], Any]
) -> list[Fold]:
    """Return a fold for each block of one recording.

    Args:
        t: Stamps ``(N,)`` [s].
        command: Shape ``(N, k)``.
        position: Shape ``(N, joints)`` [rad].
        named: Number of a block -> the fold in the words of our stage.
    """
    pairs = list(pairwise(edges))
    around = [part(t, command, position, a, b, True) for a, b in pairs]
    before = [part(t, command, position, a, b, False) for a, b in pairs]
    return [
        Fold(f"block {i}", tuple(r for j, r in enumerate(around) if j != i), (before[i],), named(i))
        for i in range(len(pairs))
    ]


def disk(data: Path) -> list[Fold]:
    """Return five blocks of 125 s."""
    (file,) = _files(data, "unbalanced_disk", "*.npz")[:1]
    with np.load(file) as content:
        u, th = content["u"][:, None], content["th"][:, None]
    block = min(DISK_BLOCK, len(u) // DISK_BLOCKS)
    edges = [block * i for i in range(DISK_BLOCKS + 1)]
    return blocks(0.025 * np.arange(len(u)), u, th, edges, lambda i: (f"but {i}", f"{edges[i]}:{edges[i + 1]}"))


def xl330(data: Path) -> list[Fold]:
    """Return one fold a gain, and one a motion."""
    kinds = {"kp": ("100", "200", "800"), "motion": ("sin_sin", "lift_and_drop", "up_and_down", "sin_time_square")}
    folds = []
    for key, values in kinds.items():
        for value in values:
            rest = f"{key}=" + ",".join(v for v in values if v != value)
            fit, test = (
                [_xl330(e) for e in recordings.load("xl330", data, s).values()] for s in (rest, f"{key}={value}")
            )
            folds.append(Fold(f"{key} {value}", tuple(fit), tuple(test), (rest, f"{key}={value}")))
    return folds


def so101(data: Path) -> list[Fold]:
    """Return one fold a motion."""
    every = recordings.load("so101_log", data, "*")
    by_motion = {name: recording(e, "goal", "position") for name, e in every.items()}
    return [
        Fold(
            n,
            tuple(r for m, r in by_motion.items() if m != n),
            (by_motion[n],),
            (" ".join(m for m in by_motion if m != n), n),
        )
        for n in by_motion
    ]


def go2(data: Path) -> list[Fold]:
    """Return three blocks of 5 s."""
    (file,) = _files(data, "go2", "*.npz")
    with np.load(file) as content:
        t, goal, q = content["t_s"], content["q_told_rad"], content["q_rad"]
    edges = np.linspace(0, len(t), GO2_BLOCKS + 1).astype(int).tolist()
    model = {"mjcf": str(file.with_name("go2.xml"))}
    folds = blocks(t, goal, q, edges, lambda i: None)
    with_model = lambda rs: tuple(Recording(r.t, r.command, r.position, r.start, model) for r in rs)  # noqa: E731
    return [Fold(f.name, with_model(f.fitted), with_model(f.test)) for f in folds]


def sts3250(data: Path) -> list[Fold]:
    """Return one fold a motion."""
    by_motion = {}
    for file in _files(data, "bam_sts3250", "*.json"):
        about = json.loads(file.read_text())
        column = lambda key, rows=about["entries"]: np.array([e[key] for e in rows], np.float64)  # noqa: E731
        q, goal, t = column("position")[:, None], column("goal_position")[:, None], column("timestamp")
        constants = {"duty_per_rad": about["kp"] * STS_DUTY_PER_KP, "vin": about["vin"], "profiled": True}
        load = {"mass": about["mass"], "length": about["length"], "torque_enable": column("torque_enable") > 0.5}
        by_motion[about["trajectory"]] = Recording(t - t[0], goal, q, np.array([[q[0, 0], 0.0]]), {**constants, **load})
    return [Fold(n, tuple(r for m, r in by_motion.items() if m != n), (by_motion[n],)) for n in by_motion]


def _xl330(episode: Any) -> Recording:
    on = np.asarray(episode.outputs["actuator"]["enabled"]).reshape(-1) > 0.5
    kp = float(np.asarray(episode.outputs["actuator"]["kp"]).reshape(-1)[0])
    duty_per_rad = kp / 256 * 4096 / (2 * np.pi) / 885
    load = {"mass": 0.49, "length": 0.1, "torque_enable": on}
    return recording(episode, "goal", "position", duty_per_rad=duty_per_rad, vin=7.4, profiled=False, **load)


def _files(data: Path, folder: str, pattern: str) -> list[Path]:
    files = sorted((data / folder).glob(pattern))
    if not files:
        raise UsageError(f"{data / folder} has no {pattern}", hint="--data: the folder of all sets")
    return files


SETS = {
    s.name: s
    for s in (
        LeagueSet("disk", "unbalanced_disk", "rad", rmse_rad, disk),
        LeagueSet("xl330", "bam_xl330", "mrad", mae_mrad, xl330),
        LeagueSet("so101", "so101", "mrad", rmse_mrad, so101),
        LeagueSet("go2", "go2", "mrad", rmse_mrad, go2),
        LeagueSet("sts3250", "bam_sts3250", "mrad", mae_mrad, sts3250),
    )
}
"""Disk: free run over a block, RMSE. Servos: whole episodes from rest, MAE. Arm: median over joints that move."""
