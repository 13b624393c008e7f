"""Shared code about identifications: the robot, segments of logs, logs given twice, and the next command.

Imports no JAX: the robot's computer checks recordings, too.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.run import sha256
from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.identification.model import IdentifiableModel, position_of
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.segments import GRID_S, Span, on_grid
from sim2real.robots.identified import LoggedRobot
from sim2real.robots.robot import RecordedRobot, in_world
from sim2real.stages.identify.config import IdentifyConfig
from sim2real.stages.load import defaults_of

_ANY_DELAY_S = 0.1
"""Any longest delay [s]: the names of a model's parameters do not depend on it."""
_WINDOW_SPACING_S = 0.5
"""Distance between the starts of held-out segments [s]."""
_LONG_S = 5.0
"""Length of the segments of the last refinement, for a robot without goals [s]."""
_EDGES_S = (0.3, 0.2)
"""Unused time at the beginning and at the end of a log [s]."""
_PIECE = 50
"""Number of samples in a piece of motion; two logs with the same piece have the same recording."""
_SAME = 1e-5
"""Largest difference by rounding, as a share of the range of a piece."""


# The robot of an identification, and its optional terms.


def with_wanted_terms(table: ParameterTable, wanted: str) -> ParameterTable:
    """Return the table with the optional terms of a flag; with ``auto``, all of them.

    Args:
        wanted: ``own``, ``auto``, ``all``, ``none``, or names separated by commas.
    """
    if wanted == "own":
        return table
    known = tuple(dict.fromkeys(p.term for p in table if p.term))
    if wanted == "auto" and not known:
        raise UsageError(
            "this robot's model has no optional terms to choose from",
            hint="give parameters a term in the pipeline: Parameter(..., term='cogging', off=0.0)",
        )
    names = {"auto": known, "all": known, "none": ()}.get(wanted, tuple(n.strip() for n in wanted.split(",")))
    return table.with_terms(names)


def offering(robot: RecordedRobot, wanted: str) -> RecordedRobot:
    """Return the robot with all optional terms that its class offers, if a flag selects among them.

    Args:
        wanted: As in ``with_wanted_terms``.
    """
    if not isinstance(robot, LoggedRobot) or wanted in ("own", "none"):
        return robot
    return robot.with_optional_terms(wanted)


def identified_robot(identification: Identification, robot: RecordedRobot) -> tuple[RecordedRobot, IdentifyConfig]:
    """Return the robot in the world of an identification, with its terms, and settings with its longest delay.

    Raises:
        UsageError: Its world is not installed.
    """
    robot = in_world(robot, identification.internal.world)
    present, offered = (
        {p.name: p.term for p in r.identifiable(_ANY_DELAY_S).parameters} for r in (robot, offering(robot, "all"))
    )
    names = [p.name for p in identification.parameters]
    if lacking := sorted({offered[name] for name in names if name in offered and name not in present}):
        robot = offering(robot, ",".join(lacking))
    # The model needs room for the identified delays, which may be longer than the pipeline's longest one.
    highs = {p.name: p.high for p in robot.identifiable(1.0).parameters if p.kind == "delay"}
    uppers = {p.name: p.upper for p in identification.parameters if p.kind == "delay" and p.state != "fixed"}
    needed_s = [u / highs[n] for n, u in uppers.items() if u is not None and n in highs]
    longest_s = max([defaults_of(robot).identify.max_delay_s, *needed_s])
    return robot, replace(defaults_of(robot).identify, settle_s=identification.internal.settle_s, max_delay_s=longest_s)


# The segments of logs.


def spans(episodes: Sequence[Episode], fitted: int, config: IdentifyConfig, length_s: float) -> list[Span]:
    """Return segments of one length, fitted and held out.

    Args:
        episodes: The logs; logs that are held out as a whole come last.
        length_s: Length of a segment [s].

    Raises:
        UsageError: The logs are too short.
    """
    segments: list[Span] = []
    for r, episode in enumerate(episodes):
        begin, end = usable(episode, config)
        split = split_of(episode, r < fitted, config)
        last = end - length_s + 1e-6
        step_s = config.spacing_s or length_s
        segments += [Span(r, float(b)) for b in np.arange(begin, min(split - length_s, last) + 1e-6, step_s)]
        segments += [Span(r, float(b), False) for b in np.arange(split, last, _WINDOW_SPACING_S)]
    fit_count = sum(s.fitted for s in segments)
    if not fit_count or fit_count == len(segments) or (config.initial_state == "free" and fit_count < 3):
        lengths = ", ".join(f"{e.duration_s:.1f} s" for e in episodes)
        raise UsageError(
            f"the logs last {lengths}: that makes {fit_count} segments of {length_s:g} s to fit and "
            f"{len(segments) - fit_count} to hold out",
            hint="record for at least 12 s, or shorten --settle-s and --horizon-s",
        )
    return segments


def with_length(config: IdentifyConfig, model: IdentifiableModel) -> IdentifyConfig:
    """Return the configuration with the length of the segments of the last refinement."""
    follows_goals = any(channel.goal for channel in model.channels)
    return replace(config, long_s=0.0 if follows_goals else _LONG_S) if config.long_s is None else config


def long_spans(episodes: Sequence[Episode], fitted: int, config: IdentifyConfig) -> list[Span]:
    """Return the segments of the last refinement, which contain all fitted samples; none if no log has two.

    Args:
        fitted: Number of fitted logs; the later logs are held out as a whole.
    """
    ends = [(usable(e, config)[0], split_of(e, True, config)) for e in episodes[:fitted]]
    return covering(ends, config.long_s or 0.0)


def covering(ends: Sequence[tuple[float, float]], length_s: float) -> list[Span]:
    """Return segments of a length that contain all samples between begin and end [s] of each recording."""
    segments: list[Span] = []
    for r, (begin, end) in enumerate(ends if length_s else ()):
        # The last segment ends at the end; the others are spread evenly, and may overlap.
        if (count := math.ceil((end - begin) / length_s - 1e-6)) > 1:
            after = np.linspace(0.0, end - length_s - begin, count)
            after[:-1] = on_grid(after[:-1], np.ceil)
            segments += [Span(r, float(begin + a)) for a in after]
    return segments


def side_by_side(
    episodes: Sequence[Episode], config: IdentifyConfig, lengths_s: Sequence[float], fitted: bool = True
) -> list[Span]:
    """Return segments side by side in the usable parts of logs; each log has its own length of segments [s]."""
    segments: list[Span] = []
    for r, (episode, length_s) in enumerate(zip(episodes, lengths_s, strict=True)):
        begin, end = usable(episode, config)
        segments += [Span(r, float(b), fitted) for b in np.arange(begin, end - length_s + 1e-6, length_s)]
    return segments


def usable(episode: Episode, config: IdentifyConfig) -> tuple[float, float]:
    """Return the begin and the end of the part of a log that can be cut into segments [s].

    An estimate of an initial state needs samples before and after the start of the segment. The end is 0.05 to 0.15 s
    before the log's end, at a multiple of 0.1 s, so that logs of 19.96 s and 20.04 s have the same segments and share
    programs.
    """
    before, after = _EDGES_S if config.initial_state == "free" else (0.0, 0.0)
    begin = max(before, config.after_s)
    return begin, begin + float(on_grid(episode.duration_s - after - begin - GRID_S / 2, np.floor))


def split_of(episode: Episode, fitted: bool, config: IdentifyConfig) -> float:
    """Return the begin of the held-out part of a log [s].

    Args:
        fitted: Whether the log is fitted; otherwise it is held out as a whole.
    """
    begin, end = usable(episode, config)
    return begin + float(on_grid((1.0 - config.held_out) * (end - begin), np.floor)) if fitted else begin


# A log that was fitted is no test of the fit.


def was_fitted(identification: Identification, logs: Sequence[Recording], model: IdentifiableModel) -> list[str]:
    """Return for each log a sentence if the parameters were identified from it, else "".

    A copy, an import of the same file and a part of a fitted log have the same measurements.
    """
    # Collect the hashes and the measurements of the fitted logs.
    rows = identification.samples
    fitted = set(rows["recording"][~rows["held_out"]].tolist()) if rows else set(range(len(identification.logs)))
    paths = {s.sha256: s.path for i, s in enumerate(identification.logs) if i in fitted and s.sha256}
    names, pieces = [f"{position_of(c)}_measured" for c in model.channels], list[np.ndarray]()
    if rows and all(name in rows for name in names):
        read = np.stack([rows[name] for name in names], axis=1).astype(np.float64)
        segments = np.where(rows["held_out"].astype(bool), -1, rows["segment"])
        pieces = [piece for s in np.unique(segments[segments >= 0]) for piece in _pieces(read[segments == s])]
    # Compare each log with them.
    sentences = []
    for log in logs:
        if (path := paths.get(hash_of(log))) is not None:
            sentences.append(f"it is {path}, which these parameters were identified from")
        elif any(_contains(_measured(log, model), piece) for piece in pieces):
            sentences.append("it holds measurements that these parameters were identified from")
        else:
            sentences.append("")
    return sentences


def require_apart(fitted: Sequence[Recording], held_out: Sequence[Recording], model: IdentifiableModel) -> None:
    """Raise an error if a log is given twice: as fitted and held out, or twice as fitted.

    Raises:
        UsageError: A log is given twice.
    """
    hashes = [hash_of(log) for log in fitted]
    messages = [
        f"{a.path} and {b.path} are the same log: fitted twice, it would count twice"
        for (a, ha), (b, hb) in combinations(zip(fitted, hashes, strict=True), 2)
        if ha and ha == hb
    ]
    for log in held_out:
        digest, pieces = hash_of(log), list(_pieces(_measured(log, model)))
        for other, other_digest in zip(fitted, hashes, strict=True):
            whole = _measured(other, model)
            if (digest and digest == other_digest) or any(_contains(whole, p) for p in pieces):
                messages.append(f"{log.path} is to be held out, and {other.path}, with the same measurements, fitted")
    if messages:
        hint = "name each log once: held-out errors of a fitted log are no test of the fit"
        raise UsageError("; ".join(messages), hint=hint)


def hash_of(log: Recording) -> str:
    """Return the SHA-256 of a log's file; "" if there is no file."""
    return sha256(log.path) if log.path.is_file() else ""


def _measured(log: Recording, model: IdentifiableModel) -> np.ndarray:
    """Return all measured positions of a log, ``(N, C)``."""
    read = log.episode.outputs.get(model.sensor, {})
    columns = [np.asarray(c.of(read[c.position]), np.float64) for c in model.channels if c.position in read]
    return np.stack(columns, axis=1) if columns else np.zeros((0, 0))


def _pieces(read: np.ndarray) -> Iterator[np.ndarray]:
    """Yield pieces of measurements with motion; measurements shorter than a piece are one piece."""
    for first in range(0, max(len(read) - _PIECE, 0) + 1, _PIECE):
        piece = read[first : first + _PIECE]
        if len(piece) > 1 and max(len(np.unique(column)) for column in piece.T) > len(piece) // 4:
            yield piece


def _contains(read: np.ndarray, piece: np.ndarray) -> bool:
    """Return whether measurements ``(N, C)`` contain a piece ``(n, C)``."""
    size = len(piece)
    if len(read) < size or read.shape[1:] != piece.shape[1:]:
        return False
    slack = _SAME * np.ptp(piece, axis=0).max()
    # Compare the ends and the middle first, where few places match.
    ends = [
        np.abs(read[i : len(read) - size + 1 + i] - piece[i]).max(axis=1) <= slack for i in (0, size // 2, size - 1)
    ]
    return any(np.abs(read[i : i + size] - piece).max() <= slack for i in np.flatnonzero(np.all(ends, axis=0)))


# The command that identifies again.


def command(robot: RecordedRobot, config: IdentifyConfig, root: Path, flags: str = "") -> str:
    """Return the command of an identification.

    Args:
        robot: The robot; settings that equal its defaults need no flag.
        flags: Further flags, which replace flags of the settings; bounds and fixed values are replaced for each
            parameter.
    """
    further = shlex.split(flags)
    if robot.folder is None:
        call = "sim2real.identify(robot, recording, ...)"
        return f"{call} with the settings {flags}" if flags else call
    named = {name for flag, name in pairwise(further) if flag in ("--bounds", "--fix")}
    words = ["sim2real", "identify", robot.name]
    # Add a flag for each setting that differs from the pipeline's default.
    for f in fields(config):
        flag, value = "--" + f.name.replace("_", "-"), getattr(config, f.name)
        if isinstance(value, Mapping):
            for name, numbers in value.items():
                values = numbers if isinstance(numbers, tuple) else (numbers,)
                words += [] if name in named else [flag, name, *map(_exactly, values)]
        elif isinstance(value, tuple):
            words += [word for file in value for word in (flag, str(file))]
        elif value != getattr(defaults_of(robot).identify, f.name) and flag not in further:
            words += (
                [flag if value else flag.replace("--", "--no-", 1)] if isinstance(value, bool) else [flag, str(value)]
            )
    words += ["--runs", str(root)] if Path(root) != Path("runs") else []
    return shlex.join([*words, *further])


def _exactly(value: float) -> str:
    """Return a number as text, exactly."""
    return short if float(short := f"{value:g}") == value else repr(value)


def continuing(robot: RecordedRobot, config: IdentifyConfig, root: Path, file: Path) -> str:
    """Return the command that continues an identification that was interrupted or did not converge."""
    usual = defaults_of(robot).identify
    generations = max(config.generations, usual.generations)
    steps = max(2 * config.refine_steps, usual.refine_steps)
    flags = f"--begin {shlex.quote(str(file))} --generations {generations} --refine-steps {steps}"
    return command(robot, config, root, flags)
