"""Recordings of real motors, and the sets of the league: their parts that are held out in turn."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing.importer import import_file
from sim2real.log.importing.mapping import load_mapping
from sim2real.stages.load import folder_of

DISK_BLOCK, DISK_BLOCKS, PAST = 5000, 5, 12
GO2_BLOCKS = 3
SO101_FOLDS, SO101_FITTED = 9, 4
STS_KP, STS_DUTY_PER_KP = 32, 0.166
"""Firmware gain of the STS3250's recordings, and the duty per radian of error that one unit of it makes: BAM's source,
bam/feetech/actuator.py."""
BEFORE = 20
"""Number of samples before a test part of the disk from which its initial state is estimated."""


@dataclass(frozen=True)
class Recording:
    """One recording of a rig.

    Attributes:
        t: stamps [s], shape (N,).
        command: command at each stamp, held until the next, shape (N, k).
        position: measured joint positions [rad], shape (N, joints).
        start: position and velocity at the first stamp, shape (joints, 2).
        constants: constants of this recording; of a servo with a load ``duty_per_rad`` of its position gain, ``mass``
            [kg] and ``length`` [m] of the load, and ``torque_enable``, shape (N,).
    """

    t: np.ndarray
    command: np.ndarray
    position: np.ndarray
    start: np.ndarray
    constants: dict[str, Any] = field(default_factory=dict)

    def part(self, begin: int, end: int, start: np.ndarray | None = None) -> Recording:
        """Return the samples from ``begin`` up to ``end``."""
        cut = slice(begin, end)
        start = self.start if start is None else start
        return Recording(self.t[cut], self.command[cut], self.position[cut], start, self.constants)

    def joint(self, index: int) -> Recording:
        """Return one joint and its command."""
        one = slice(index, index + 1)
        return Recording(self.t, self.command[:, one], self.position[:, one], self.start[one], self.constants)


def recording(episode: Episode, command: str, position_field: str, **constants: object) -> Recording:
    """Return an episode as a recording; it starts at the first measured position, at rest."""
    t = episode.steps["sensor"].begun_s
    commands, position = _column(episode, "actuator", command), _column(episode, "sensor", position_field)
    start = np.stack([position[0], np.zeros(position.shape[1])], axis=1)
    return Recording(t, commands, position, start, constants)


def _column(episode: Episode, node: str, field: str) -> np.ndarray:
    data = episode.outputs[node][field]
    return np.asarray(data, np.float64).reshape(len(data), -1)


Logs = tuple[tuple[Path, int | None, int | None], ...]
"""Files, and of each the first sample and the one behind the last."""


def load(pipeline: str, logs: Logs) -> dict[str, Episode]:
    """Return recordings as the pipeline's import reads them, by name."""
    mapping = load_mapping(folder_of(pipeline) / "import.toml")
    return {f"{f.stem} {a}:{b}": import_file(f, mapping, slice(a, b)) for f, a, b in logs}


@dataclass(frozen=True)
class Fold:
    """Recordings to fit, and held-out ones to predict.

    Attributes:
        logs: Those to fit, and those to predict, for ``load``; None for a set without a pipeline.
    """

    name: str
    fitted: tuple[Recording, ...]
    test: tuple[Recording, ...]
    logs: tuple[Logs, Logs] | None = None


@dataclass(frozen=True)
class LeagueSet:
    """Recordings of one rig.

    Attributes:
        folder: Its folder below ``--data``.
        score: Predicted positions ``(N, joints)`` and the recording -> an error for each joint that is moved.
        folds: Makes the folds from the folder of all data.
    """

    name: str
    folder: str
    score: Callable[[np.ndarray, Recording], np.ndarray]
    folds: Callable[[Path], list[Fold]]


def rmse(predicted: np.ndarray, recording: Recording) -> np.ndarray:
    """Return the root mean square error of each joint that is moved, in thousandths of the positions' unit."""
    each = 1e3 * np.sqrt(np.mean((predicted - recording.position) ** 2, axis=0))
    return each[_moved(recording)]


def mae(predicted: np.ndarray, recording: Recording) -> np.ndarray:
    """Return the mean absolute error of each joint that is moved, in thousandths of the positions' unit."""
    return 1e3 * np.mean(np.abs(predicted - recording.position), axis=0)[_moved(recording)]


def _moved(recording: Recording) -> np.ndarray:
    """Return which joints are moved, ``(joints,)``; the only joint of a rig is."""
    return (np.ptp(recording.command, axis=0) > 0.02) | (recording.position.shape[1] == 1)


def part(t: np.ndarray, command: np.ndarray, position: np.ndarray, begin: int, end: int, ahead: bool) -> Recording:
    """Return samples of a longer recording, with a state at their begin from a cubic through the samples around it.

    Args:
        t: Stamps ``(N,)`` [s].
        command: Shape ``(N, k)``.
        position: Shape ``(N, joints)`` [rad].
        ahead: Whether samples behind ``begin`` may be used: for predicted parts only those before it.
    """
    near = slice(max(begin - PAST, 0), begin + (PAST if ahead else 1))
    if near.stop - near.start < PAST:  # where ours begins: BEFORE samples in
        begin += BEFORE
        near = slice(begin - PAST, begin + (PAST if ahead else 1))
    fits = [np.polyfit(t[near] - t[begin], angles[near], 3) for angles in position.T]
    start = np.array([[f[3], f[2]] for f in fits])
    return Recording(t[begin:end] - t[begin], command[begin:end], position[begin:end], start)


def blocks(
    t: np.ndarray, command: np.ndarray, position: np.ndarray, edges: Sequence[int], logs: Callable[[int], Any]
) -> list[Fold]:
    """Return a fold for each block of one recording.

    Args:
        t: Stamps ``(N,)`` [s].
        command: Shape ``(N, k)``.
        position: Shape ``(N, joints)`` [rad].
        logs: Number of a block -> ``Fold.logs``.
    """
    pairs = list(pairwise(edges))
    around = [part(t, command, position, a, b, True) for a, b in pairs]
    before = [part(t, command, position, a, b, False) for a, b in pairs]
    return [
        Fold(f"block {i}", tuple(r for j, r in enumerate(around) if j != i), (before[i],), logs(i))
        for i in range(len(pairs))
    ]


def disk(data: Path) -> list[Fold]:
    """Return five blocks of 125 s."""
    (file,) = _files(data, "unbalanced_disk", "*.npz")[:1]
    with np.load(file) as content:
        u, th = content["u"][:, None], content["th"][:, None]
    block = min(DISK_BLOCK, len(u) // DISK_BLOCKS)
    edges = [block * i for i in range(DISK_BLOCKS + 1)]

    def logs(left: int) -> tuple[Logs, Logs]:
        rest = tuple((file, edges[i], edges[i + 1]) for i in range(DISK_BLOCKS) if i != left)
        return rest, ((file, max(0, edges[left] - BEFORE), edges[left + 1]),)

    return blocks(0.025 * np.arange(len(u)), u, th, edges, logs)


def xl330(data: Path) -> list[Fold]:
    """Return one fold a gain, and one a motion."""
    kinds = {"kp": ("100", "200", "800"), "motion": ("sin_sin", "lift_and_drop", "up_and_down", "sin_time_square")}
    folds, files = [], _files(data, "bam_xl330", "*.json")
    about = [json.loads(file.read_text()) for file in files]
    labels = [{"kp": str(a["kp"]), "motion": a["trajectory"]} for a in about]
    recordings = [servo_recording(*load("xl330", ((file, None, None),)).values()) for file in files]
    for key, values in kinds.items():
        for value in values:
            fit = [i for i, of in enumerate(labels) if of[key] != value and of[key] in values]
            test = [i for i, of in enumerate(labels) if of[key] == value]
            parts = [tuple(recordings[i] for i in part) for part in (fit, test)]
            logs = [tuple((files[i], None, None) for i in part) for part in (fit, test)]
            folds.append(Fold(f"{key} {value}", parts[0], parts[1], (logs[0], logs[1])))
    return folds


def so101(data: Path) -> list[Fold]:
    """Return nine folds; of 27 motions, three are held out, and the twelve of the next four folds are fitted.

    With all 24 others, one of our fits would take longer than ten minutes.
    """
    files = {file.stem: ((file, None, None),) for file in _files(data, "so101", "*.npz")}
    by_motion = {n: recording(*load("so101_log", f).values(), "goal", "position") for n, f in files.items()}
    count, folds = min(SO101_FOLDS, len(by_motion)), []
    groups = [list(by_motion)[k::count] for k in range(count)]
    for k, test in enumerate(groups):
        rest = [m for i in range(1, SO101_FITTED + 1) for m in groups[(k + i) % count] if m not in test]
        fitted, judged = (tuple(by_motion[m] for m in dict.fromkeys(names)) for names in (rest, test))
        logs = [tuple(files[m][0] for m in dict.fromkeys(names)) for names in (rest, test)]
        folds.append(Fold(", ".join(test), fitted, judged, (logs[0], logs[1])))
    return folds


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


def servo_recording(episode: Episode) -> Recording:
    """Return a recording of the XL330 with its load."""
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


def emps(data: Path) -> list[Fold]:
    """Return the last 40 % of the estimation file, held out; the validation file is not read."""
    (file,) = _files(data, "emps", "fit.npz")
    with np.load(file) as content:
        t, force, position = np.round(content["t_s"], 6), content["force_n"][:, None], content["q_m"][:, None]
    constants = {"mjcf": str(file.with_name("emps.xml")), "sliding": True}
    split = round(0.6 * len(t))
    fitted, test = part(t, force, position, 0, split, True), part(t, force, position, split, len(t), False)
    return [Fold("fit.npz[0.6:1]", (replace(fitted, constants=constants),), (replace(test, constants=constants),))]


SETS = {
    s.name: s
    for s in (
        LeagueSet("disk", "unbalanced_disk", rmse, disk),
        LeagueSet("xl330", "bam_xl330", mae, xl330),
        LeagueSet("so101", "so101", rmse, so101),
        LeagueSet("go2", "go2", rmse, go2),
        LeagueSet("sts3250", "bam_sts3250", mae, sts3250),
        LeagueSet("emps", "emps", rmse, emps),
    )
}
"""Disk, axis: free run over a part, RMSE. Servos: whole episodes from rest, MAE. Robots: RMSE, mean over joints."""
