"""Recordings of real motors, and the sets of the league: their parts that are held out in turn.

A folder with a ``league.toml`` is a set without code. Its files are read as by ``new``:

    mjcf = "robot.xml"
    fit = ["a.csv", "b.npz[0:0.6]"]     # the fitted files; [a:b]: a part, in shares of the file's samples
    test = ["b.npz[0.6:1]"]             # the judged ones
    terms = "auto"                      # optional: as --terms; default "own"
    flags = {joints = ["pan", "tilt"]}  # optional: of identify, as in robot_flags.py
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from fnmatch import fnmatch
from functools import partial
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing.importer import import_file
from sim2real.log.importing.mapping import load_mapping
from sim2real.stages.load import folder_of
from sim2real.stages.shared import from_model
from sim2real.stages.shared.arguments import open_recording
from sim2real.stages.shared.robot_flags import RobotFlags

DISK_BLOCK, DISK_BLOCKS, PAST = 5000, 5, 12
GO2_BLOCKS = 3
SO101_FOLDS, SO101_FITTED = 9, 4
STS_KP, STS_DUTY_PER_KP = 32, 0.166
"""Firmware gain of the STS3250's recordings, and the duty per radian of error that one unit of it makes: BAM's source,
bam/feetech/actuator.py."""
FORCES = ("torque", "duty")
"""Commands of described robots that are no positions."""
EMPS = {"mjcf": "emps.xml", "fit": ["fit.npz[0:0.6]"], "test": ["fit.npz[0.6:1]"], "terms": "auto"}
"""The axis's validation file is not read: the end of the estimation file is held out."""
DESCRIPTION = "league.toml"
FOLDERS = {"disk": "unbalanced_disk", "xl330": "bam_xl330", "so101_log": "so101"}
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


def load(case: str, data: Path, spec: str, past: int = 0) -> dict[str, Episode]:
    """Return the recordings of a case that a text selects, by name.

    Args:
        case: ``disk``, ``xl330`` or ``so101_log``.
        data: Folder with the case's files, or with its folder, or one of the files.
        spec: disk: ``[FILE@]A:B``, samples. xl330: ``kp=100,800 motion=sin_sin,up_and_down``, or ``all``. so101_log:
            names of motions, with ``*``, and with ``[a:b]`` for a part, in shares of its length.
        past: Further samples of the disk before ``A``.

    Raises:
        UsageError: When there are no files, or the text selects none of them.
    """
    folder = data / FOLDERS[case] if (data / FOLDERS[case]).is_dir() else data
    pattern = "*.json" if case == "xl330" else "*.npz"
    files = [folder] if folder.is_file() and folder.match(pattern) else sorted(folder.glob(pattern))
    if not files:
        raise UsageError(
            f"{data} is no file {pattern} and no folder with such files", hint=f"--data: {case}'s recordings"
        )
    episodes = {"disk": _load_disk, "xl330": _load_xl330, "so101_log": _load_so101}[case](files, spec, past)
    if not episodes:
        names = ", ".join(f.name for f in files)
        raise UsageError(f"{spec!r} selects no part of {names}", hint="select parts with --fit and --test")
    return episodes


def _mapping(case: str) -> Path:
    return folder_of(case) / "import.toml"


def _load_disk(files: list[Path], spec: str, past: int) -> dict[str, Episode]:
    name, _, part = spec.rpartition("@")
    first, last = (int(x) if x else None for x in part.split(":"))
    begin = max(0, (first or 0) - past)
    chosen = [f for f in files if f.name == name] if name else files[:1]
    if not chosen:
        return {}
    return {spec: import_file(chosen[0], load_mapping(_mapping("disk")), slice(begin, last))}


def _load_xl330(files: list[Path], spec: str, past: int) -> dict[str, Episode]:
    del past
    wanted = dict(part.split("=") for part in spec.split() if part != "all")
    episodes = {}
    for file in files:
        about = json.loads(file.read_text())
        labels = {"kp": str(about["kp"]), "motion": about["trajectory"], "file": file.stem}
        if all(labels[key] in values.split(",") for key, values in wanted.items()):
            episodes[f"kp {labels['kp']} {labels['motion']} {file.stem}"] = import_file(
                file, load_mapping(_mapping("xl330"))
            )
    return episodes


def _load_so101(files: list[Path], spec: str, past: int) -> dict[str, Episode]:
    del past
    episodes = {}
    for part in spec.split():
        pattern, _, share = part.partition("[")
        a, b = (float(x) for x in share.rstrip("]").split(":")) if share else (0.0, 1.0)
        for file in files:
            if fnmatch(file.stem, pattern):
                with np.load(file) as content:
                    count = len(content["t_meas_s"])
                samples = slice(round(a * count), round(b * count))
                episodes[f"{file.stem}[{a:g}:{b:g}]" if share else file.stem] = import_file(
                    file, load_mapping(_mapping("so101_log")), samples
                )
    return episodes


@dataclass(frozen=True)
class Fold:
    """Recordings to fit, and held-out ones to predict.

    Attributes:
        spec: Both in the syntax of ``load``: (fit, test); None for a set without a pipeline.
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
                [servo_recording(e) for e in load("xl330", data, s).values()] for s in (rest, f"{key}={value}")
            )
            folds.append(Fold(f"{key} {value}", tuple(fit), tuple(test), (rest, f"{key}={value}")))
    return folds


def so101(data: Path) -> list[Fold]:
    """Return nine folds; of 27 motions, three are held out, and the twelve of the next four folds are fitted.

    With all 24 others, one of our fits would take longer than ten minutes.
    """
    every = load("so101_log", data, "*")
    by_motion = {name: recording(e, "goal", "position") for name, e in every.items()}
    count, folds = min(SO101_FOLDS, len(by_motion)), []
    groups = [list(by_motion)[k::count] for k in range(count)]
    for k, test in enumerate(groups):
        rest = [m for i in range(1, SO101_FITTED + 1) for m in groups[(k + i) % count] if m not in test]
        fitted, judged = (tuple(by_motion[m] for m in dict.fromkeys(names)) for names in (rest, test))
        folds.append(Fold(", ".join(test), fitted, judged, (" ".join(dict.fromkeys(rest)), " ".join(test))))
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


def described(about: dict[str, Any], folder: str, data: Path) -> list[Fold]:
    """Return the fold of a description, as in a ``league.toml``."""
    where = data / folder
    types = {"mjcf": str, "fit": list, "test": list, "terms": str, "flags": dict}
    wrong = [n for n, v in about.items() if not isinstance(v, types.get(n, ()))]
    if wrong or not (about.get("mjcf") and about.get("fit") and about.get("test")):
        raise UsageError(
            f"{where / DESCRIPTION}: {', '.join(wrong) or 'mjcf, fit or test'} is missing, unknown or of a wrong type",
            hint='mjcf = "robot.xml", fit = ["a.csv[0:0.6]"], test = ["b.csv"]; optional: terms, flags',
        )
    words = about.get("flags", {})
    if unknown := sorted(set(words) - {f.name for f in fields(RobotFlags)} | set(words) & {"mjcf"}):
        raise UsageError(f"{where / DESCRIPTION}: unknown flags {', '.join(unknown)}", hint="names of robot_flags.py")
    parts = {key: [_share(item, where) for item in about[key]] for key in ("fit", "test")}
    for (name, low, high), (other, begin, end) in product(parts["fit"], parts["test"]):
        if name == other and low < end and begin < high:
            raise UsageError(f"{where / DESCRIPTION}: parts of {name} are fitted and judged", hint="judge others")
    chosen: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in words.items() if n != "mapping"}
    mapping = where / words["mapping"] if "mapping" in words else None
    flags = RobotFlags(mjcf=where / about["mjcf"], mapping=mapping, **chosen)
    pipeline = from_model.describe_robot(flags, [str(where / parts["fit"][0][0])]).made()
    constants = {"mjcf": str(flags.mjcf), "flags": chosen, "terms": about.get("terms", "own")}

    def read(name: str, low: float, high: float, ahead: bool) -> Recording:
        episode = open_recording(where / name, pipeline).episode
        sent = [c for c in ("goal", *FORCES) if c in episode.outputs["actuator"]]
        if not sent:
            raise UsageError(f"{where / name} has no goal, torque or duty", hint="name its columns, or give a mapping")
        whole = recording(episode, sent[0], "position")
        begin, end = (round(x * len(whole.t)) for x in (low, high))
        about_it = {**constants, "command": sent[0], "sliding": bool(pipeline.units.get("position") == "m")}
        return replace(part(whole.t, whole.command, whole.position, begin, end, ahead), constants=about_it)

    fitted, test = (tuple(read(*p, n == "fit") for p in parts[n]) for n in ("fit", "test"))
    return [Fold(", ".join(about["test"]), fitted, test)]


def _share(item: str, where: Path) -> tuple[str, float, float]:
    """Return file, begin and end of ``FILE`` or ``FILE[a:b]``."""
    name, _, share = str(item).partition("[")
    try:
        low, high = (float(x) for x in share.removesuffix("]").split(":")) if share else (0.0, 1.0)
    except ValueError:
        low, high = 1.0, 0.0
    if not 0.0 <= low < high <= 1.0:
        raise UsageError(f"{where / DESCRIPTION}: {item!r} is no part of a file", hint='as in "a.npz[0:0.6]"')
    return name, low, high


def available(data: Path) -> dict[str, LeagueSet]:
    """Return the sets whose folders are there: ours, and those with a ``league.toml``."""
    files = {path.parent.name: path for path in sorted(data.glob(f"*/{DESCRIPTION}"))}
    if taken := sorted(set(files) & set(SETS)):
        raise UsageError(f"{', '.join(taken)} is the name of a set with code", hint="rename the folder")
    more = {
        n: LeagueSet(n, n, rmse, partial(described, tomllib.loads(path.read_text()), n)) for n, path in files.items()
    }
    return {n: s for n, s in {**SETS, **more}.items() if (data / s.folder).is_dir()}


SETS = {
    s.name: s
    for s in (
        LeagueSet("disk", "unbalanced_disk", rmse, disk),
        LeagueSet("xl330", "bam_xl330", mae, xl330),
        LeagueSet("so101", "so101", rmse, so101),
        LeagueSet("go2", "go2", rmse, go2),
        LeagueSet("sts3250", "bam_sts3250", mae, sts3250),
        LeagueSet("emps", "emps", rmse, partial(described, EMPS, "emps")),
    )
}
"""Disk, axis: free run over a part, RMSE. Servos: whole episodes from rest, MAE. Robots: RMSE, mean over joints."""
