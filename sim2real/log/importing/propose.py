"""Proposes the mapping of a file from its names; what they leave open becomes a question; data check it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing import checks, lerobot
from sim2real.log.importing.checks import Finding
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.mapping import STAMP_UNITS, FieldMapping, ImportMapping, NodeMapping, in_si, to_toml
from sim2real.log.importing.names import Meaning, about_torque, are_numbers, columns_of, meaning
from sim2real.log.importing.readers import Table

_FIELDS = {"position": "goal", "velocity": "goal_velocity", "torque": "torque", "duty": "duty", "voltage": "duty"}
_EXTRA = {
    "kp": ("kp", None, ""),
    "kd": ("kd", None, ""),
    "enabled": ("enabled", None, ""),
    "torque": ("torque", "command", "N m"),
    "payload": ("payload", None, "kg"),
    "payload_reach": ("reach", None, "m"),
}
"""Commands beside a goal: field -> quantity, side or None for any, and unit."""
_GAINS = ("kp", "kd", "enabled")
_RATES_HZ = (5.0, 12_000.0)
"""Usual sampling rates of recorders."""
_WALL_S = (1e9, 4e9)
"""Wall clocks read this many seconds since 1970 (2001 to 2096)."""
_DEG = 180 / np.pi
_NAMED = ("rad", "deg", "rev", "mrad", "m", "mm")
"""Units that a name can have, of positions."""

Key = tuple[str, str, str]
"""Node, field or empty, and key of a line of a mapping file."""


@dataclass(frozen=True)
class ImportHints:
    """The user's information on a file.

    Attributes:
        pipeline: Name of the log's pipeline.
        rate_hz: Rate of the samples if the file has no stamps [Hz].
        joints: Names of the robot's joints, in its order; empty if unknown.
        ranges: Shape ``(joints, 2)``: limits of the joints [rad]; None if unknown.
        as_told: Keep names, order, signs and units, even if they are ambiguous or contradict the data.
        slides: Names of the sliding joints, whose positions are lengths.
        unit: Unit of positions and goals in the file; empty: by their names.
        calibration: LeRobot's calibration of the arm.
    """

    pipeline: str
    rate_hz: float | None = None
    joints: tuple[str, ...] = ()
    ranges: np.ndarray | None = None
    as_told: bool = False
    slides: tuple[str, ...] = ()
    unit: str = ""
    calibration: Path | None = None


@dataclass(frozen=True)
class Signal:
    """Columns that belong together.

    Attributes:
        sources: Source of each column, as in a mapping.
        labels: Joint of each column; empty if its name has none.
        meaning: Meaning of the name.
        values: Shape ``(N, columns)``; ``(columns,)`` for constants.
        whole: Source of all columns together; None if they are separate signals of the file.
    """

    sources: tuple[str, ...]
    labels: tuple[str, ...]
    meaning: Meaning
    values: np.ndarray
    whole: str | None = None

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.whole or ", ".join(self.sources[:3]) + (" ..." if len(self.sources) > 3 else "")

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.sources)

    def taken(self, places: Sequence[int]) -> Signal:
        """Return some of the columns, in this order."""
        whole = self.whole if list(places) == list(range(self.width)) else None
        sources, labels = (tuple(part[i] for i in places) for part in (self.sources, self.labels))
        return Signal(sources, labels, self.meaning, self.values[..., list(places)], whole)

    def mapped(self, unit: str, **more: Any) -> FieldMapping:
        """Return the field that has these columns."""
        return FieldMapping(self.whole or self.sources, unit, shape=(-1,), **more)


@dataclass
class Proposal:
    """A mapping, with the evidence for each line, and what is open.

    Attributes:
        joints: Names of the columns of measured positions, in the order of the log; numbers without names.
        reasons: Evidence for a line of the mapping.
        questions: What names and data do not decide: the line with its candidates.
        evidence: Further sentences.
    """

    mapping: ImportMapping
    joints: tuple[str, ...] = ()
    reasons: dict[Key, str] = field(default_factory=dict)
    questions: dict[Key, str] = field(default_factory=dict)
    evidence: list[str] = field(default_factory=list)

    def toml(self, name: str) -> str:
        """Return the text of the mapping file of a file of this name."""
        head = [f"Proposed by `sim2real import {name}`.", *self.evidence, f"Joints: {', '.join(self.joints)}"]
        if self.questions:
            head.insert(
                1,
                "Put an answer in place of each line with a question mark, then give this file to --mapping.",
            )
        return to_toml(self.mapping, head, self.reasons, self.questions)

    def open_questions(self) -> list[str]:
        """Return the open questions, one sentence each."""
        return [
            f"nodes.{node}.{f'fields.{name}.' * bool(name)}{key} = {text}"
            for (node, name, key), text in self.questions.items()
        ]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # damaged files can hold numbers of any size
def propose(table: Table, hints: ImportHints) -> Proposal:
    """Return the mapping that names and units give, checked against the data.

    Raises:
        UsageError: When names do not match those of the robot, or the data contradict the names.
    """
    signals, notes = collect(table)
    draft = Proposal(ImportMapping(hints.pipeline, {}), evidence=[*table.notes, *notes])
    measured = _choose(signals, "measured", table, hints, draft)
    command = _choose([s for s in signals if s is not measured], "command", table, hints, draft, measured)
    # The order of the joints.
    places, joints = _joint_order(measured, hints, table, draft)
    measured = measured.taken(places)
    draft.joints = joints
    command, kind, by_name = _matched(command, measured, places, joints, table, draft)
    # Stamps, then units, on which turns and leaps depend.
    nodes: dict[str, dict[str, Any]] = {}
    clocks = {}
    for node, signal, side in (("actuator", command, "command"), ("sensor", measured, "measured")):
        nodes[node], clocks[node] = _stamped(signals, signal, side, node, table, hints, draft)
    _agreeing_clocks(table, nodes, clocks, draft)
    fields: dict[str, dict[str, FieldMapping]] = {"actuator": {}, "sensor": {}}
    unit, turn = _position_unit(measured, command, kind, clocks, signals, table, hints, draft)
    scale = _scales(measured, unit, hints)
    fields["sensor"]["position"] = measured.mapped(unit, turn=turn, **scale)
    if kind == "position":
        goal_unit = _goal_unit(command, measured, unit, clocks, hints, draft)
        goal_turn = _turn(command, goal_unit, ("actuator", "goal"), draft)
        fields["actuator"]["goal"] = command.mapped(goal_unit, turn=goal_turn, **_scales(command, goal_unit, hints))
    else:
        si = {"velocity": "rad/s", "torque": "N m", "voltage": "V"}.get(kind, "")
        fields["actuator"][_FIELDS[kind]] = command.mapped(si)
        draft.reasons["actuator", _FIELDS[kind], "source"] = f"commands {kind}, by its name"
    _extras(signals, command, measured, places, joints, fields, clocks, draft)
    for node, signal in (("actuator", command), ("sensor", measured)):
        _policies(node, nodes[node], fields[node], signal, clocks[node], draft)
    draft.mapping = _in_lengths(
        ImportMapping(hints.pipeline, {n: NodeMapping(fields[n], **nodes[n]) for n in nodes}), hints
    )
    draft.evidence += about_torque({n: msgspec.to_builtins(node) for n, node in draft.mapping.nodes.items()})
    draft.evidence += _unused(signals, draft)
    if not draft.questions:
        _check(table, draft, by_name, hints)
    return draft


def check_mapping(episode: Episode, joints: Sequence[str] = (), by_name: bool = True) -> list[Finding]:
    """Return findings on the goals and positions of an imported episode."""
    sensed, commands = episode.outputs.get("sensor", {}), episode.outputs.get("actuator", {})
    units = {**episode.units.get("actuator", {}), **episode.units.get("sensor", {})}
    enabled = [values for name, values in commands.items() if meaning(name).quantity == "enabled"]
    acting = np.asarray((enabled[0].reshape(len(enabled[0]), -1) > 0).all(axis=1)) if len(enabled) == 1 else None
    findings: list[Finding] = []
    for name, position in sensed.items():
        for goal, values in commands.items():
            pair = meaning(name).quantity == "position" and meaning(goal).side == "command"
            if not (pair and meaning(goal).quantity in ("", "position") and units.get(goal) == units.get(name)):
                continue
            flat = values.reshape(len(values), -1), position.reshape(len(position), -1)
            if flat[0].shape[1] == flat[1].shape[1]:
                names = joints if len(joints) == flat[1].shape[1] else [f"joint {i}" for i in range(flat[1].shape[1])]
                t_s = episode.steps["actuator"].begun_s, episode.steps["sensor"].begun_s
                findings += checks.check(t_s, *flat, names, by_name, acting)
    return findings


def collect(table: Table) -> tuple[list[Signal], list[str]]:
    """Return all signals of numbers with at most two dimensions, and notes on skipped ones.

    Columns whose names differ only by the joint are one signal.

    Raises:
        UsageError: When a signal with the name of a position or a command cannot be read.
    """
    single: dict[tuple[Meaning, int, str], list[Signal]] = {}
    signals: list[Signal] = []
    notes: list[str] = []
    lists = {key: words for key, words in table.words.items() if _names_joints(key, words)}
    for key, why in table.broken.items():
        named = meaning(key)
        # Without such a column, another one could be taken for the positions.
        if named.quantity == "position" or (named.side and not named.quantity):
            raise UsageError(f"{key!r} in {table.path} cannot be read: {why}", hint="correct it, or remove the column")
        notes.append(f"skipped: {key!r}: {why}")
    for key, raw in table.columns.items():
        named, values = meaning(key), raw.astype(np.float64)
        if values.size and values.ndim <= 2 and not np.isfinite(values).any():
            notes.append(f"skipped: {key!r} has no number in any sample")
        elif values.ndim <= 1:
            label = _label_of(key, named, table)
            row = Signal((key,), (label,), named, values[..., None])
            group = replace(named, label=""), values.size if values.ndim else 0, _group(key)
            single.setdefault(group, []).append(row)
        elif values.ndim == 2 and values.shape[1] <= 1000:
            n = values.shape[1]
            names = table.names.get(key) or next(iter(_lists_for(key, n, lists, table)), [""] * n)
            labels = tuple(meaning(x).label or x.lower() for x in names) if len(names) == n else ("",) * n
            signals.append(Signal(tuple(f"{key}[:,{i}]" for i in range(n)), labels, named, values, key))
        else:
            notes.append(f"skipped: {key!r} has samples of shape {values.shape[1:]}, as images have")
    for (named, _, _), rows in single.items():
        labels = [row.labels[0] for row in rows]
        together = len(rows) > 1 and len(set(labels)) == len(labels) and "" not in labels and named.quantity != "stamp"
        if together and (named.side or named.quantity):
            values = np.concatenate([row.values for row in rows], axis=-1)
            whole = Signal(tuple(row.sources[0] for row in rows), tuple(labels), named, values)
            # Numbers count the joints.
            if are_numbers(labels):
                whole = whole.taken(sorted(range(len(labels)), key=lambda i: int(re.findall(r"\d+", labels[i])[0])))
            signals.append(whole)
        else:
            signals += rows
    if words := [key for key in table.words if key not in lists and len(set(table.words[key])) > 1]:
        notes.append(f"skipped, as they hold no numbers: {', '.join(words[:20])}")
    return signals, notes


def _label_of(key: str, named: Meaning, table: Table) -> str:
    """Return a column's joint; ``position0`` is that of the name in ``name0``, as rostopic writes it."""
    if match := re.fullmatch(r"(.*?)[a-z]+(\d+)", key):
        words = table.words.get(f"{match[1]}name{match[2]}", [])
        if words and len(set(words)) == 1:
            return meaning(words[0]).label or words[0].lower()
    return named.label


def _names_joints(key: str, words: Sequence[str]) -> bool:
    parts = set(re.findall("[a-z]+", key.lower()))
    wanted = parts & {"names", "joints", "name"} and not parts & {"body", "bodies", "link", "links", "foot", "feet"}
    return bool(wanted) and len(set(words)) == len(words)


def _lists_for(key: str, width: int, lists: Mapping[str, list[str]], table: Table) -> list[list[str]]:
    """Return the lists of names in the file that fit a signal, those that share most words with its name."""
    words = set(re.findall("[a-z]+", key.lower()))
    fitting = {k: names for k, names in lists.items() if len(names) == width}
    shared = {k: len(set(re.findall("[a-z]+", k.lower())) & words) for k in fitting}
    best = [names for k, names in fitting.items() if shared[k] == max(shared.values())]
    if len({tuple(names) for names in best}) > 1 and meaning(key).quantity in ("", "position"):
        raise UsageError(
            f"{', '.join(fitting)} in {table.path} name the columns of {key!r} in different orders",
            hint="remove the list that does not belong to it, or write a mapping with the columns",
        )
    return best


def _choose(
    signals: Sequence[Signal], side: str, table: Table, hints: ImportHints, draft: Proposal, other: Signal | None = None
) -> Signal:
    """Return the measured positions, or the commands, by their names; ask if names do not decide."""
    ranked: dict[int, list[Signal]] = {}
    for s in signals:
        if s.values.ndim == 2 and len(s.values) > 2 and (rank := _rank(s.meaning, side)) is not None:
            ranked.setdefault(rank, []).append(s)
    best = ranked[min(ranked)] if ranked else []
    # Of several, take those of the robot's joints, or as wide as the other side; equal ones are the same.
    if len(best) > 1 and hints.joints:
        best = [s for s in best if columns_of(hints.joints, s.labels)] or best
    if len(best) > 1 and other is not None:
        best = (
            [s for s in best if set(other.labels) == set(s.labels) != {""}]
            or [s for s in best if s.width == other.width]
            or best
        )
    best = [
        s
        for i, s in enumerate(best)
        if not any(
            s.values.shape == b.values.shape and np.array_equal(s.values, b.values, equal_nan=True) for b in best[:i]
        )
    ]
    node, name = ("sensor", "position") if side == "measured" else ("actuator", "goal")
    if len(best) == 1:
        return best[0]
    choices = best or [
        s for s in signals if s.values.ndim == 2 and len(s.values) > 2 and s.meaning.quantity in ("", "position")
    ]
    if not choices:
        raise UsageError(
            f"{table.path} has no {'measured positions' if side == 'measured' else 'commands'}. "
            f"Columns: {', '.join(table.keys[:40]) or 'none'}" + "".join(f"; {note}" for note in draft.evidence[:5]),
            hint="name them by quantity and joint, such as q_hip_rad and goal_hip_rad, or write a mapping",
        )
    listed = " or ".join(_toml_source(s) for s in choices[:12])
    what = "which are the measured positions" if side == "measured" else "which commands drove the joints"
    draft.questions[node, name, "source"] = f"{listed}?  # {what}: names do not say"
    return choices[0]


def _rank(named: Meaning, side: str) -> int | None:
    position = named.quantity == "position"
    if side == "measured":
        return (
            {("measured", True): 0, ("", True): 1, ("measured", False): 2}.get((named.side, position))
            if (position or not named.quantity)
            else None
        )
    if named.side == "command" and named.quantity in ("position", ""):
        return 0 if position else 1
    if named.side == "command" and named.quantity in _FIELDS:
        return 2
    return {"duty": 3, "voltage": 3, "torque": 4}.get(named.quantity) if not named.side else None


def _toml_source(signal: Signal) -> str:
    return (
        f'"{signal.whole or signal.sources[0]}"'
        if signal.whole or signal.width == 1
        else f'["{signal.sources[0]}", ...]'
    )


def _joint_order(
    measured: Signal, hints: ImportHints, table: Table, draft: Proposal
) -> tuple[list[int], tuple[str, ...]]:
    """Return the column of each joint of the robot, and the joints' names."""
    labels, in_order = measured.labels, list(range(measured.width))
    own = tuple(label or str(i) for i, label in enumerate(labels))
    finite = [bool(np.isfinite(column).any()) for column in measured.values.T]
    at = "sensor", "position", "source"
    if not hints.joints:
        if empty := [measured.sources[i] for i in in_order if not finite[i]]:
            draft.evidence.append(f"skipped: {', '.join(empty)} has no number in any sample")
        kept = [i for i in in_order if finite[i]]
        return kept, tuple(own[i] for i in kept)
    found = columns_of(hints.joints, labels) if any(labels) else None
    if found is not None:
        places, how = found
        pairs = ", ".join(f"{labels[i]} is {joint}" for joint, i in zip(hints.joints, places, strict=True))
        draft.reasons[at] = how
        if how != "by name":
            draft.evidence.append(f"joints {how}: {pairs}")
        return places, hints.joints
    named = any(labels) and not are_numbers(labels)
    if (named and not hints.as_told) or len(hints.joints) != measured.width:
        raise UsageError(
            f"the {measured.width} columns of {measured.name!r} in {table.path} "
            f"({', '.join(label or 'no name' for label in labels)}) are not the robot's {len(hints.joints)} joints: "
            f"{', '.join(hints.joints)}",
            hint="name the recorded joints as the file does, or list the sources in a mapping in the robot's order"
            + ("; --as-told takes the file's order for the robot's" if len(hints.joints) == measured.width else ""),
        )
    draft.reasons[at] = "no names of joints: the robot's order is assumed"
    draft.evidence.append(
        f"columns have no names of joints, so the robot's order is assumed: {', '.join(hints.joints)}; --joints sets "
        "another"
    )
    return in_order, hints.joints


def _matched(
    command: Signal, measured: Signal, places: Sequence[int], joints: Sequence[str], table: Table, draft: Proposal
) -> tuple[Signal, str, bool]:
    """Return the commands in the order of the joints, what they command, and whether names match them."""
    kind = command.meaning.quantity or "position"
    has_names = all(measured.labels) and all(command.labels)
    if has_names and set(measured.labels) <= set(command.labels):
        return command.taken([command.labels.index(label) for label in measured.labels]), kind, True
    if has_names and (found := columns_of(measured.labels, command.labels)) is not None:
        draft.evidence.append(f"commands belong to positions {found[1]}")
        return command.taken(found[0]), kind, True
    found = columns_of(joints, command.labels) if any(command.labels) else None
    if found is not None:
        return command.taken(found[0]), kind, True
    numbers = are_numbers(measured.labels) and are_numbers(command.labels)
    if has_names and not numbers:
        raise UsageError(
            f"the commands {command.name!r} in {table.path} are of {', '.join(command.labels)}, the positions "
            f"{measured.name!r} of {', '.join(measured.labels)}",
            hint="give the joints the same names on both sides, or write a mapping with the sources in one order",
        )
    if command.width == measured.width:
        ordered = command
    elif command.width > max(places, default=0) and not any(command.labels):
        ordered = command.taken(places)
    else:
        raise UsageError(
            f"{command.name!r} in {table.path} has {command.width} columns, {measured.name!r} {measured.width}",
            hint="write a mapping with the columns that belong together",
        )
    if measured.width > 1:
        draft.evidence.append(f"{command.name!r} and {measured.name!r} belong together by their order")
    return ordered, kind, measured.width == 1


def _stamped(
    signals: Sequence[Signal], of: Signal, side: str, node: str, table: Table, hints: ImportHints, draft: Proposal
) -> tuple[dict[str, Any], np.ndarray]:
    """Return the keys of a node's clock, and its stamps [s]."""
    count = len(of.values)
    generated = {"rate_hz": hints.rate_hz or 1.0}, np.arange(count) / (hints.rate_hz or 1.0)
    if hints.rate_hz is not None:
        draft.reasons[node, "", "rate_hz"] = "--rate-hz"
        return generated
    named = [s for s in signals if s.meaning.quantity == "stamp" and s.width == 1 and s.values.shape == (count, 1)]
    fitting = [s for s in named if _increases(s.values[:, 0])]
    chosen = [s for s in fitting if s.meaning.side == side] or [s for s in fitting if not s.meaning.side] or fitting
    # In a bag, or of several files, use the stamps of the signal's own topic; prefer the header's stamp.
    if group := _group(of.sources[0]):
        chosen = [s for s in fitting if _group(s.sources[0]) == group] or chosen
    chosen = (
        [s for s in chosen if s.name.endswith("header.stamp")]
        or [s for s in chosen if s.name.endswith("stamp")]
        or chosen
    )
    if not chosen:
        for key, unit in (("rate", 1.0), ("period", None)):
            for s in signals:
                if s.values.shape == (1,) and s.values[0] > 0 and s.meaning.quantity == key:
                    rate_hz = (
                        float(s.values[0]) if unit else 1.0 / float(s.values[0] * (1.0 if s.values[0] < 1.0 else 1e-3))
                    )
                    draft.reasons[node, "", "rate_hz"] = f"{s.name!r} in the file"
                    return {"rate_hz": rate_hz}, np.arange(count) / rate_hz
        why = f"the stamps {named[0].name!r} repeat or step back" if named else "the file has no time stamps"
        draft.questions[node, "", "rate_hz"] = f"?  # samples per second: {why}; --rate-hz answers, too"
        return generated
    stamps = chosen[0]
    if len(chosen) > 1:
        listed = " or ".join(f'"{s.name}"' for s in chosen)
        draft.questions[node, "", "stamps"] = (
            f"{listed}?  # which clock has stamped the {'commands' if side == 'command' else 'positions'}"
        )
    unit, reason = _stamp_unit(stamps)
    if unit is None:
        draft.questions[node, "", "stamp_unit"] = (
            f"{reason}?  # the stamps are {_period(stamps.values[:, 0]):.6g} apart"
        )
        unit = "s"
    draft.reasons[node, "", "stamps"] = (
        f"by its name; {reason}" if unit != "s" or stamps.meaning.unit else "by its name, in s"
    )
    keys: dict[str, Any] = {"stamps": stamps.sources[0], "stamp_unit": unit}
    return keys, stamps.values[:, 0] * STAMP_UNITS[unit] * 1e-9


def _stamp_unit(stamps: Signal) -> tuple[str | None, str]:
    """Return the unit of stamps and the reason; None and the candidates."""
    values = stamps.values[np.isfinite(stamps.values[:, 0]), 0]
    if stamps.meaning.unit in STAMP_UNITS:
        return stamps.meaning.unit, "unit by its name"
    seconds = {unit: nanoseconds * 1e-9 for unit, nanoseconds in STAMP_UNITS.items()}
    period = _period(values)
    wall = [u for u, s in seconds.items() if _WALL_S[0] < values[0] * s < _WALL_S[1]]
    likely = [u for u, s in seconds.items() if _RATES_HZ[0] <= 1 / (period * s) <= _RATES_HZ[1]]
    for listed, why in (([u for u in wall if u in likely], "dates since 1970"), (likely, "")):
        if len(listed) == 1:
            return listed[0], why or f"{1 / (period * seconds[listed[0]]):.4g} samples a second"
    return None, " or ".join(f'"{u}"' for u in likely or seconds)


def _period(values: np.ndarray) -> float:
    steps = np.diff(values[np.isfinite(values)])
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0


def _increases(values: np.ndarray) -> bool:
    steps = np.diff(values[np.isfinite(values)])
    return steps.size > 1 and float((steps > 0).mean()) > 0.9 and not (steps < 0).any()


def _group(key: str) -> str:
    """Return the topic of a signal in a bag, or the file of one of several; empty for others."""
    return key.partition(".")[0] if key.startswith("/") else key.partition("/")[0] if "/" in key else ""


def _agreeing_clocks(
    table: Table, nodes: Mapping[str, dict[str, Any]], clocks: dict[str, np.ndarray], draft: Proposal
) -> None:
    """Take a bag's own clock where the headers of a sender disagree with it, and ask if streams do not overlap."""
    for node, keys in nodes.items():
        source = str(keys.get("stamps", ""))
        other = f"{_group(source)}.log_time"
        if not source.startswith("/") or source == other or other not in table.columns:
            continue
        own, log = clocks[node], table.columns[other] * 1e-9
        if len(own) < 10 or (np.diff(log) < 0).any():
            continue
        # A clock that drifts is slow throughout; one that was set has the one odd step.
        apart = own - log - (own[0] - log[0])
        rate = float(np.polyfit(log - log[0], apart, 1)[0])
        drift, odd = abs(rate) * np.ptp(log), [float(np.abs(np.diff(x) - _period(x)).max()) for x in (own, log)]
        steady = np.abs(apart - np.polyval(np.polyfit(log - log[0], apart, 1), log - log[0])).max() < 0.2 * drift
        limit = max(0.01, 2 * _period(log))
        if drift > limit and steady:
            what = f"runs {100 * abs(rate):.3g} % {'slow' if rate < 0 else 'fast'}, {drift:.2g} s in all"
        elif np.ptp(apart) > 10 * limit and odd[0] > 2 * odd[1]:
            what = f"steps by {odd[0]:.3g} s"
        else:
            continue
        for name in nodes:
            replaced = f"{_group(str(nodes[name].get('stamps', '')))}.log_time"
            if replaced in table.columns:
                nodes[name].update(stamps=replaced, stamp_unit="ns")
                clocks[name] = table.columns[replaced] * 1e-9
                draft.reasons[name, "", "stamps"] = "the recorder's clock"
        draft.evidence.append(f"{source} {what} against the recorder's clock, which replaces the stamps of all streams")
        break
    t, c = (np.asarray(clocks[n])[np.isfinite(clocks[n])] for n in ("sensor", "actuator"))
    if len(t) and len(c) and min(t[-1], c[-1]) - max(t[0], c[0]) < 0.5 * min(np.ptp(t), np.ptp(c)):
        draft.questions["actuator", "", "stamp_offset"] = (
            f"{t[0] - c[0]:.6g}?  # stamps of commands and positions hardly overlap: seconds to add to commands"
        )


def _position_unit(
    measured: Signal, command: Signal, kind: str, clocks: Mapping[str, np.ndarray], signals: Sequence[Signal],
    table: Table, hints: ImportHints, draft: Proposal,
) -> tuple[str, float]:  # fmt: skip
    """Return the unit of positions, and a turn if they jump at its end."""
    at = "sensor", "position", "unit"
    unit, reason = _unit(measured, table, hints)
    q = measured.values
    if unit is None and not reason:
        # A jump at the end of a turn, a velocity or goals in a known unit, or the joints' ranges.
        jumps = [u for u, turn in (("rad", 2 * np.pi), ("deg", 360.0)) if _jumps(q, turn)]
        if len(jumps) == 1:
            unit, reason = jumps[0], "jumps by a turn"
        elif (found := _unit_by_rate(measured, clocks["sensor"], signals)) or (
            kind == "position" and (found := _unit_by_goal(measured, command, clocks, table, hints))
        ):
            unit, reason = found
        elif _only_rad(q, hints):
            unit, reason = "rad", "by the joints' ranges: in degrees, one would be outside"
    if unit is None:
        spans = np.nanmax(q, axis=0) - np.nanmin(q, axis=0)
        asked, why = (
            reason or '"rad" or "deg"?',
            f"they span up to {spans.max():.4g}, and no name has a unit; --unit answers, too",
        )
        draft.questions[at] = f"{asked}  # {why}"
        return "", 0.0
    draft.reasons[at] = reason
    return unit, _turn(measured, unit, ("sensor", "position"), draft)


def _unit(signal: Signal, table: Table, hints: ImportHints) -> tuple[str | None, str]:
    """Return a signal's unit by flag, name or kind of file; None, and the candidates if rad and deg are none."""
    names = tuple(table.names.get(signal.whole or "", ()))
    of_columns = {meaning(name).unit for name in names}
    named = signal.meaning.unit or (of_columns.pop() if len(of_columns) == 1 else "")
    lerobots = lerobot.writes_hundredths(table.robot, names or signal.sources)
    if hints.unit:
        if hints.unit == "hundredths" and hints.calibration is None:
            raise UsageError("hundredths of a joint's range need LeRobot's calibration", hint="--calibration FILE.json")
        return hints.unit, "--unit"
    if named in _NAMED:
        return named, "by its name"
    if named == "counts":
        return None, '"counts:4096"?'
    if named == "percent":
        return None, '"counts:N" or "rad" with a scale, as percent of which angle?'
    if lerobots:
        return (
            (found, "whole counts by LeRobot's calibration")
            if (found := _lerobot_unit(signal, hints))
            else (None, '"deg" or "hundredths" (with --calibration)?')
        )
    key = (signal.whole or signal.sources[0]).lower()
    if table.format == "mcap" or re.search(r"joint_?states?|field\.(position|header)", key):
        return "rad", "messages of ROS are in radians"
    if re.search(r"qpos|dof_?pos", key):
        return "rad", "MuJoCo and Isaac are in radians"
    if hints.slides:
        return None, '"m" or "mm"?' if len(hints.slides) == len(hints.joints) else '"rad" (and m) or another?'
    return None, ""


def _lerobot_unit(signal: Signal, hints: ImportHints) -> str | None:
    """Return the unit in which positions are whole counts by LeRobot's calibration; None if unclear."""
    if hints.calibration is None:
        return None
    fits = []
    arm = [i for i, label in enumerate(signal.labels) if not lerobot.is_gripper(label)]
    for unit in lerobot.UNITS:
        scale, _ = lerobot.conversion(hints.calibration, [signal.labels[i] for i in arm], unit)
        counts = signal.values[:, arm] * np.array(scale) * 4096 / (2 * np.pi)
        off = np.abs(2 * counts - np.round(2 * counts))  # the middle of a range can be half a count
        fits.append(float(np.quantile(off, 0.95)) < 0.05)
    return lerobot.UNITS[fits.index(True)] if sum(fits) == 1 else None


def _jumps(q: np.ndarray, turn: float) -> bool:
    """Return whether columns jump by a turn, and lie within -half to half a turn, or within 0 to a turn."""
    rows = q[np.isfinite(q).all(axis=1)]
    over = checks.turns(rows, turn) if len(rows) > 2 else np.zeros(1, bool)
    if not over.any():
        return False
    low, high = rows[:, over].min(axis=0) / turn, rows[:, over].max(axis=0) / turn
    ends = ((-0.5, 0.5), (0.0, 1.0))
    return any(bool((np.abs(low - a) < 0.02).all() and (np.abs(high - b) < 0.02).all()) for a, b in ends)


def _unit_by_rate(measured: Signal, t_s: np.ndarray, signals: Sequence[Signal]) -> tuple[str, str] | None:
    """Return the unit of positions by a velocity whose name has a unit."""
    for v in signals:
        if v.meaning.quantity != "velocity" or v.meaning.side == "command" or v.meaning.unit not in ("rad", "deg"):
            continue
        if v.values.shape == measured.values.shape and (slope := _rate_slope(measured.values, v.values, t_s)):
            for unit, factor in (("rad", 1.0), ("deg", _DEG)):
                if 0.8 < slope / (factor / (1.0 if v.meaning.unit == "rad" else _DEG)) < 1.25:
                    return unit, f"its rate over {v.name!r} is {slope:.3g}"
    return None


def _rate_slope(q: np.ndarray, v: np.ndarray, t_s: np.ndarray) -> float | None:
    """Return the slope of the rate of positions over velocities; None if they differ."""
    rows = np.isfinite(q).all(axis=1) & np.isfinite(v).all(axis=1) & np.isfinite(t_s)
    if rows.sum() < 50 or (np.diff(t_s[rows]) <= 0).any():
        return None
    rate = np.gradient(q[rows], t_s[rows], axis=0)
    kernel = np.ones(5) / 5
    rate, v = (np.stack([np.convolve(c, kernel, "same") for c in x.T], axis=1)[3:-3] for x in (rate, v[rows]))
    moving = v.std(axis=0) > 1e-9
    if not moving.any():
        return None
    x, y = v[:, moving].ravel(), rate[:, moving].ravel()
    r = np.corrcoef(x, y)[0, 1]
    return float((x @ y) / (x @ x)) if r > 0.8 else None


def _unit_by_goal(
    measured: Signal, command: Signal, clocks: Mapping[str, np.ndarray], table: Table, hints: ImportHints
) -> tuple[str, str] | None:
    """Return the unit of positions by that of goals and the slope between them."""
    unit, _ = _unit(command, table, hints)
    if (
        unit is None
        and command.meaning.unit == ""
        and len(jumps := [u for u, turn in (("rad", 2 * np.pi), ("deg", 360.0)) if _jumps(command.values, turn)]) == 1
    ):
        unit = jumps[0]
    if unit not in ("rad", "deg") or (slope := _slope(measured, command, clocks)) is None:
        return None
    for candidate, factor in (("rad", 1.0), ("deg", _DEG)):
        ratio = slope * (1.0 if unit == "rad" else _DEG) / factor
        if (0.6 if candidate == unit else 0.85) < ratio < (1.5 if candidate == unit else 1.15):
            return candidate, f"its slope over {command.name!r} is {slope:.3g}"
    return None


def _slope(measured: Signal, command: Signal, clocks: Mapping[str, np.ndarray]) -> float | None:
    """Return the median slope of positions over their commands, in their own units; None if they do not follow.

    Raises:
        UsageError: When a joint follows with a slope far from that of the others.
    """
    pairs = []
    for signal, t_s in ((command, clocks["actuator"]), (measured, clocks["sensor"])):
        rows = np.isfinite(signal.values).all(axis=1) & np.isfinite(t_s)
        t, values = t_s[rows], signal.values[rows]
        later = np.concatenate([[True], np.diff(t) > 0]) if len(t) else np.zeros(0, bool)
        pairs.append((t[later], values[later]))
    (t_c, c), (t_q, q) = pairs
    if min(len(t_c), len(t_q)) < 50:
        return None
    c, q = (_counted_any(x) for x in (c, q))
    # Compare in units of each side's usual spread, as the units are open.
    spread = [max(float(np.median(x.std(axis=0))), 1e-9) for x in (c, q)]
    found = checks.respond((t_c, t_q), c / spread[0], q / spread[1])
    if found is None:
        return None
    slopes = {}
    for i in np.flatnonzero((c.std(axis=0) > 0) & (q.std(axis=0) > 0)).tolist():
        r, _, slope, _ = max((found.best(i, i, s) for s in (1.0, -1.0)), key=lambda b: abs(b[0]))
        if abs(r) > 0.8:
            slopes[i] = slope * spread[1] / spread[0]
    if not slopes:
        return None
    median = float(np.median(np.abs(list(slopes.values()))))
    if odd := [i for i, slope in slopes.items() if not 1 / 3 < abs(slope) / median < 3]:
        listed = ", ".join(f"{measured.labels[i] or measured.sources[i]} {slopes[i]:.2g}" for i in odd)
        raise UsageError(
            f"joints follow {command.name!r} with a slope of {median:.3g}, but {listed}: another unit or scale",
            hint="name the other joints with --joints, or give each column its scale in a mapping",
        )
    return median


def _counted_any(values: np.ndarray) -> np.ndarray:
    for turn in (2 * np.pi, 360.0):
        if _jumps(values, turn):
            return checks.counted(values, turn)
    return values


def _only_rad(q: np.ndarray, hints: ImportHints) -> bool:
    """Return whether positions are within the joints' ranges in radians alone."""
    if hints.ranges is None or len(hints.ranges) != q.shape[1] or hints.slides:
        return False
    limited = np.ptp(hints.ranges, axis=1) > 0
    low, high = hints.ranges.T
    inside = lambda x: ((np.nanmin(x, 0) > low - 0.2) & (np.nanmax(x, 0) < high + 0.2))[limited]  # noqa: E731
    return bool(limited.any() and inside(q).all() and not inside(q / _DEG).all())


def _goal_unit(
    command: Signal, measured: Signal, unit: str, clocks: Mapping[str, np.ndarray], hints: ImportHints, draft: Proposal
) -> str:
    """Return the unit of goals: by name, else that of the positions if the slope between them agrees."""
    at = "actuator", "goal", "unit"
    if hints.unit:
        draft.reasons[at] = "--unit"
        return hints.unit
    named = command.meaning.unit
    if named in _NAMED:
        draft.reasons[at] = "by its name"
        return named
    if named in ("counts", "percent"):
        asked = '"counts:4096"?' if named == "counts" else '"rad" with a scale, as percent of which angle?'
        draft.questions[at] = f"{asked}  # --unit answers, too"
        return ""
    if ("sensor", "position", "unit") in draft.questions:
        draft.questions[at] = (
            draft.questions["sensor", "position", "unit"].partition("  #")[0] + "  # as that of the positions?"
        )
        return ""
    slope = _slope(measured, command, clocks)
    factor, si = in_si(unit) if not unit.startswith("hundredths") else (1.0, "rad")
    if slope is None:
        if unit == "hundredths" or (command.whole and measured.whole and re.sub("action", "", command.whole) == ""):
            draft.reasons[at] = "as the positions"
            return unit
        draft.questions[at] = (
            f'"{unit}" or another?  # no position follows it, so its unit is open; --unit answers, too'
        )
        return ""
    for candidate in dict.fromkeys((unit, "rad", "deg")):
        other = 1.0 if candidate == "hundredths" else in_si(candidate)[0]
        ratio = slope * factor / other
        if (0.5 if candidate == unit else 0.85) < ratio < (1.6 if candidate == unit else 1.15):
            draft.reasons[at] = f"positions follow it with a slope of {slope:.3g}"
            return candidate
    draft.questions[at] = (
        f'"{si}" with a scale?  # positions follow it with a slope of {slope:.3g}: it is in another unit, or scaled'
    )
    return ""


def _scales(signal: Signal, unit: str, hints: ImportHints) -> dict[str, Any]:
    """Return scale and offset of a signal of LeRobot by the calibration."""
    if hints.calibration is None or unit not in lerobot.UNITS:
        return {}
    scale, offset = lerobot.conversion(hints.calibration, signal.labels, unit)
    return {"scale": tuple(scale), "offset": tuple(offset)}


def _turn(signal: Signal, unit: str, at: tuple[str, str], draft: Proposal) -> float:
    """Return a turn in the signal's unit if it jumps at its end, else 0."""
    factor, si = in_si(unit)
    if si != "rad" or unit == "hundredths":
        return 0.0
    turn = 2 * np.pi / factor
    rows = signal.values[np.isfinite(signal.values).all(axis=1)]
    if len(rows) < 3 or not checks.turns(rows, turn).any():
        return 0.0
    draft.reasons[(*at, "turn")] = "it jumps at the end of a turn: turns are counted"
    return float(turn)


def _extras(
    signals: Sequence[Signal], command: Signal, measured: Signal, places: Sequence[int], joints: Sequence[str],
    fields: dict[str, dict[str, FieldMapping]], clocks: Mapping[str, np.ndarray], draft: Proposal,
) -> None:  # fmt: skip
    """Add gains, torque on or off, further commands, payload and a velocity, by their names."""

    def in_order(s: Signal) -> Signal | None:
        """Return the columns of the joints, or one for all; None if they do not fit."""
        if s.width == 1:
            return s
        if all(s.labels) and set(measured.labels) <= set(s.labels) and all(measured.labels):
            return s.taken([s.labels.index(label) for label in measured.labels])
        if s.width == len(joints):
            return s
        return s.taken(places) if s.width > max(places) and not any(s.labels) else None

    for name, (quantity, side, unit) in _EXTRA.items():
        listed = [s for s in signals if s.meaning.quantity == quantity and s is not command and s is not measured]
        listed = [s for s in listed if side is None or s.meaning.side == side]
        listed = [s for s in listed if s.values.ndim == 1 or len(s.values) == len(command.values)]
        if len(listed) != 1 or name in fields["actuator"] or (chosen := in_order(listed[0])) is None:
            continue
        finite = chosen.values[np.isfinite(chosen.values)]
        if not finite.any() and (name in _GAINS or name == "torque"):
            draft.evidence.append(f"{chosen.name!r} is 0 throughout: omitted")
            continue
        source = chosen.whole or (chosen.sources if chosen.width > 1 else chosen.sources[0])
        fields["actuator"][name] = FieldMapping(source, unit, shape=(-1,))
        draft.reasons["actuator", name, "source"] = "by its name"
    base = fields["sensor"]["position"]
    for s in signals:
        if s.meaning.quantity != "velocity" or s.values.ndim != 2 or s is command or (v := in_order(s)) is None:
            continue
        goal = s.meaning.side == "command"
        node, name, of = ("actuator", "goal_velocity", command) if goal else ("sensor", "velocity", measured)
        if name in fields[node] or v.values.shape != of.values.shape or (goal and "goal" not in fields["actuator"]):
            continue
        how = fields["actuator"]["goal"] if goal else base
        slope = _rate_slope(_counted_any(of.values), v.values, clocks[node])
        factor = in_si(how.unit)[0] if isinstance(how.scale, float) else None
        units = [
            u
            for u in ("rad/s", "deg/s", "rev/s", "mrad/s")
            if slope and factor and 0.8 < slope * factor / in_si(u)[0] < 1.25
        ]
        by_name = f"{s.meaning.unit}/s" if s.meaning.unit else ""
        if units and (not by_name or by_name in units):
            fields[node][name] = v.mapped(units[0])
            draft.reasons[node, name, "unit"] = f"it is the rate of {of.name!r}"
        else:
            draft.evidence.append(f"{s.name!r} is not the rate of {of.name!r}: omitted")


def _policies(
    node: str,
    keys: dict[str, Any],
    fields: Mapping[str, FieldMapping],
    signal: Signal,
    t_s: np.ndarray,
    draft: Proposal,
) -> None:
    """Drop samples that lack a number, repeat a stamp, or leap away and back; say how many."""
    lacking = int((~np.isfinite(signal.values).all(axis=1) | ~np.isfinite(t_s)).sum())
    if lacking:
        keys["missing"] = "drop"
        draft.reasons[node, "", "missing"] = f"{lacking} of {len(t_s)} samples lack a number"
    rows = np.flatnonzero(np.isfinite(signal.values).all(axis=1) & np.isfinite(t_s))
    if "stamps" in keys and (repeated := int((np.diff(t_s[rows]) == 0).sum())):
        keys["repeated"] = "first"
        draft.reasons[node, "", "repeated"] = f"{repeated} stamps repeat"
        rows = rows[np.concatenate([[True], np.diff(t_s[rows]) > 0])]
    how = fields.get("position")
    if node != "sensor" or how is None or how.log_unit != "rad" or len(rows) < 3 or (np.diff(t_s[rows]) <= 0).any():
        return
    values = checks.counted(signal.values[rows], how.turn) if how.turn else signal.values[rows]
    leapt = checks.glitches(t_s[rows], values * np.asarray(how.scale) * in_si(how.unit)[0])
    if leapt.any():
        k, i = (int(x[0]) for x in np.nonzero(leapt))
        keys["implausible"] = "drop"
        draft.reasons[node, "", "implausible"] = (
            f"{int(leapt.any(axis=1).sum())} samples leap away and back, as {signal.sources[i]} in sample {rows[k]}"
        )


def _in_lengths(mapping: ImportMapping, hints: ImportHints) -> ImportMapping:
    """Return a mapping with the units of slides: lengths, or none where a robot has hinges and slides."""
    nodes = {}
    for name, node in mapping.nodes.items():
        fields = {}
        for key, how in node.fields.items():
            unit = {"hundredths": "rad"}.get(how.unit, how.unit)
            if how.unit in lerobot.UNITS and isinstance(how.scale, tuple):
                unit = "rad"  # the scale converts
            if hints.slides and in_si(unit)[1] in ("rad", "rad/s", "N m"):
                if unit not in ("rad", "rad/s", "N m"):
                    raise UsageError(
                        f"{', '.join(how.sources)} is in {unit}, but {', '.join(hints.slides)} slides",
                        hint="write a mapping with the scales to m and to rad: 0.001 for mm, 0.0174533 for degrees",
                    )
                mixed = len(hints.slides) < len(hints.joints)
                unit = "" if mixed else {"rad": "m", "rad/s": "m/s", "N m": "N"}[unit]
            fields[key] = msgspec.structs.replace(how, unit=unit)
        nodes[name] = msgspec.structs.replace(node, fields=fields)
    return ImportMapping(mapping.pipeline, nodes)


def _unused(signals: Sequence[Signal], draft: Proposal) -> list[str]:
    """Return a note on signals of motion or commands that are not imported."""
    used = {source for node in draft.mapping.nodes.values() for how in node.fields.values() for source in how.sources}
    left = [
        s.name for s in signals
        if s.meaning.quantity in ("", "position", "velocity", "torque", "duty", "voltage")
        and (s.meaning.side or s.meaning.quantity)
        and not {s.whole, *s.sources} & used and not any(s.name in line for line in draft.evidence)
    ]  # fmt: skip
    return [f"not imported: {', '.join(left[:20])}" + " ..." * (len(left) > 20)] if left else []


def _check(table: Table, draft: Proposal, by_name: bool, hints: ImportHints) -> None:
    """Check the mapping on the data; what contradicts it is refused, what fits several mappings is asked."""
    episode = import_table(table, draft.mapping)
    findings = check_mapping(episode, draft.joints, by_name)
    draft.evidence += [f.text for f in findings if f.weight == "note"]
    draft.evidence += [f"warning: {f.text}" for f in findings if f.weight == "warn"]
    open_ones = [f for f in findings if f.weight in ("ask", "refuse")]
    if hints.as_told:
        draft.evidence += [f"warning: {f.text}" for f in open_ones]
        return
    goal = draft.mapping.nodes["actuator"].fields.get("goal")
    answerable = {"sign": "scale", "order": "source", "slope": "unit", "follows": "unit"}
    if wrong := [f for f in open_ones if f.kind not in answerable]:
        raise UsageError(f"{table.path}: {'; '.join(f.text for f in wrong)}", hint=hint_for(wrong))
    for f in open_ones if goal is not None else ():
        key = answerable[f.kind]
        others = [g for g in open_ones if answerable[g.kind] == key]
        if f.kind == "sign" and goal is not None:
            scale = np.broadcast_to(goal.scale, (len(draft.joints),))
            flipped = [-x if any(g.joint == i for g in others) else x for i, x in enumerate(scale.tolist())]
            candidates = f"{flipped} or {scale.tolist()}?"
        elif f.kind == "order":
            source = goal.sources if goal is not None else ()
            candidates = f"{json.dumps(source)} in another order?"
        else:
            candidates = f'"{goal.unit if goal is not None else ""}" or another?'
        why = "; ".join(g.text for g in others)
        draft.questions["actuator", "goal", key] = f"{candidates}  # {why}; --as-told keeps the file's"


def hint_for(findings: Sequence[Finding]) -> str:
    """Return what to do about findings that refuse an import."""
    hints = {
        "copy": "log the commands that were sent, not the measurements",
        "clock": "stamp both streams with one clock, such as a recorder's",
        "zero": "cut the file where the zero moves: --samples A:B",
        "scale": "name the other joints with --joints, or give the column its own scale in a mapping",
        "slope": "correct the unit, or name the other joints with --joints",
        "lag": "exchange the names, or correct stamp_offset",
    }
    return (
        "; ".join(dict.fromkeys(hints.get(f.kind, "correct the mapping") for f in findings))
        + "; --as-told imports it all the same"
    )


def joint_motion(table: Table, joints: Sequence[str], unit: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the motion of a robot's joints in a table: goals if it has them, otherwise positions.

    Args:
        joints: Names of the commands, by which columns are chosen.
        unit: Unit of the commands.

    Returns:
        Times ``(N,)`` [s], values ``(N, joints)`` [unit], and their source in words.

    Raises:
        UsageError: When no columns have these names, or their clock or unit is open.
    """
    signals, _ = collect(table)
    motions = []
    for s in signals:
        if s.values.ndim != 2 or s.meaning.quantity not in ("position", ""):
            continue
        found = columns_of(joints, s.labels) if any(s.labels) else None
        alone = len(joints) == 1 and s.width == 1 and s.meaning.side == "command"
        if found is not None or alone:
            order = (s.meaning.side != "command", s.meaning.quantity != "position", len(motions))
            motions.append((*order, s.taken(found[0] if found else [0])))
    if not motions:
        raise UsageError(
            f"{table.path} has no columns for {', '.join(joints)}. Columns: {', '.join(table.keys[:30]) or 'none'}",
            hint=f"name them by joint, quantity and unit, such as {joints[0]}_goal_rad, and the time t_s",
        )
    signal = min(motions)[3]
    draft, hints = Proposal(ImportMapping("", {})), ImportHints("", joints=tuple(joints))
    side = "command" if signal.meaning.side == "command" else "measured"
    _, t_s = _stamped(signals, signal, side, "motion", table, hints, draft)
    scale = 1.0
    if unit == "rad":
        own, _ = _unit(signal, table, hints)
        if own is None:
            draft.questions["motion", "", "unit"] = f"of {signal.name}: rad or deg? End the names with it"
        else:
            scale = in_si(own)[0]
    if draft.questions:
        raise UsageError(
            f"{table.path}: {'; '.join(draft.questions.values())}", hint="name columns t_s, JOINT_goal_rad"
        )
    rows = np.flatnonzero(np.isfinite(t_s) & np.isfinite(signal.values).all(axis=1))
    if len(rows) < 2:
        raise UsageError(f"{signal.name!r} in {table.path} has no rows that hold numbers for all joints")
    return t_s[rows], scale * signal.values[rows], f"{signal.name} of {table.path.name}"
