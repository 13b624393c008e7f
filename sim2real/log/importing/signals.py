"""The signals of a table, grouped by the meaning of their names, with their clocks; and the draft of a mapping."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.mapping import STAMP_UNITS, FieldMapping, ImportMapping, to_toml
from sim2real.log.importing.names import Meaning, are_numbers, meaning
from sim2real.log.importing.readers import Table

_RATES_HZ = (5.0, 12_000.0)
"""Usual sampling rates of recorders."""
_WALL_S = (1e9, 4e9)
"""Wall clocks read this many seconds since 1970 (2001 to 2096)."""
_APART_S = 0.02
"""Two clocks of one topic that disagree by more are a question."""

Key = tuple[str, str, str]
"""Node, field or empty, and key of a line of a mapping file."""


@dataclass(frozen=True)
class ImportHints:
    """The user's information on a file.

    Attributes:
        pipeline: Name of the log's pipeline.
        rate_hz: Rate of the samples if the file has no stamps [Hz].
        joints: Names of the robot's joints, in its order; empty if unknown.
        as_told: Keep names, order, signs and units, even if they are ambiguous or contradict the data.
        slides: Names of the sliding joints, whose positions are lengths.
        unit: Unit of positions and goals in the file; empty: by their names.
        calibration: LeRobot's calibration of the arm.
    """

    pipeline: str
    rate_hz: float | None = None
    joints: tuple[str, ...] = ()
    as_told: bool = False
    slides: tuple[str, ...] = ()
    unit: str = ""
    calibration: Path | None = None


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
                1, "Put an answer in place of each line with a question mark, then give this file to --mapping."
            )
        return to_toml(self.mapping, head, self.reasons, self.questions)

    def open_questions(self) -> list[str]:
        """Return the open questions, one sentence each."""
        return [
            f"nodes.{node}.{f'fields.{name}.' * bool(name)}{key} = {text}"
            for (node, name, key), text in self.questions.items()
        ]


@dataclass(frozen=True)
class Signal:
    """Columns that belong together.

    Attributes:
        sources: Source of each column, as in a mapping.
        labels: Joint of each column; empty if its name has none.
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
        return self.whole or ", ".join(self.sources[:3]) + (" ..." if len(self.sources) > 3 else "")

    @property
    def width(self) -> int:
        return len(self.sources)

    def taken(self, places: Sequence[int]) -> Signal:
        """Return some of the columns, in this order."""
        whole = self.whole if list(places) == list(range(self.width)) else None
        sources, labels = (tuple(part[i] for i in places) for part in (self.sources, self.labels))
        return Signal(sources, labels, self.meaning, self.values[..., list(places)], whole)

    def mapped(self, unit: str, **more: Any) -> FieldMapping:
        """Return the field that has these columns."""
        return FieldMapping(self.whole or self.sources, unit, shape=(-1,), **more)


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
        named = _meaning(key, table)
        # Without such a column, another one could be taken for the positions.
        if named.quantity == "position" or (named.side and not named.quantity):
            raise UsageError(f"{key!r} in {table.path} cannot be read: {why}", hint="correct it, or remove the column")
        notes.append(f"skipped: {key!r}: {why}")
    for key, raw in table.columns.items():
        named, values = _meaning(key, table), raw.astype(np.float64)
        if values.size and values.ndim <= 2 and not np.isfinite(values).any():
            notes.append(f"skipped: {key!r} has no number in any sample")
        elif values.ndim <= 1:
            row = Signal((key,), (_label_of(key, named, table),), named, values[..., None])
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
        if not together or not (named.side or named.quantity or are_numbers(labels)):
            signals += rows
            continue
        values = np.concatenate([row.values for row in rows], axis=-1)
        signal = Signal(tuple(row.sources[0] for row in rows), tuple(labels), named, values)
        numbered = (
            sorted(range(len(labels)), key=lambda i: int(re.findall(r"\d+", labels[i])[0]))
            if are_numbers(labels)
            else None
        )
        signals.append(signal.taken(numbered) if numbered else signal)
    if words := [key for key in table.words if key not in lists and len(set(table.words[key])) > 1]:
        notes.append(f"skipped, as they hold no numbers: {', '.join(words[:20])}")
    return signals, notes


def _meaning(key: str, table: Table) -> Meaning:
    """Return the meaning of a signal's name; of a file's name only the side counts."""
    stem = next((stem for stem in table.stems if key.startswith(stem)), "")
    named = meaning(key[len(stem) :])
    return named if named.side or not stem else replace(named, side=meaning(stem).side)


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


def _group(key: str) -> str:
    """Return the topic of a signal in a bag, or the file of one of several; empty for others."""
    return key.partition(".")[0] if key.startswith("/") else key.partition("/")[0] if "/" in key else ""


# -- clocks


def stamped(
    signals: Sequence[Signal], of: Signal, node: str, table: Table, hints: ImportHints, draft: Proposal
) -> tuple[dict[str, Any], np.ndarray]:
    """Return the keys of a node's clock, and its stamps [s]."""
    count = len(of.values)
    if hints.rate_hz is not None:
        draft.reasons[node, "", "rate_hz"] = "--rate-hz"
        return {"rate_hz": hints.rate_hz}, np.arange(count) / hints.rate_hz
    named = [s for s in signals if s.meaning.quantity == "stamp" and s.width == 1 and s.values.shape == (count, 1)]
    fitting = [s for s in named if _increases(s.values[:, 0])]
    # Prefer the stamps of the signal's own topic or file, then those of its side; in a topic, the header's.
    group, side = _group(of.sources[0]), of.meaning.side or ("command" if node == "actuator" else "measured")
    chosen = [s for s in fitting if group and _group(s.sources[0]) == group]
    chosen = chosen or [s for s in fitting if s.meaning.side == side] or [s for s in fitting if not s.meaning.side]
    chosen = chosen or fitting
    header = [s for s in chosen if s.name.endswith("header.stamp")] or [s for s in chosen if s.name.endswith("stamp")]
    log = [s for s in chosen if s.name.endswith(".log_time")]
    apart_s = _apart_s(header[0].values[:, 0], log[0].values[:, 0]) if header and log else 0.0
    if apart_s > _APART_S:
        draft.questions[node, "", "stamps"] = (
            f'"{header[0].name}" or "{log[0].name}"?  # the sender\'s clock and the recorder\'s drift apart by '
            f"{apart_s:.2g} s: one of them steps, or runs at another rate"
        )
    chosen = header or chosen
    if not chosen:
        return _generated(signals, named, count, node, draft)
    if len(chosen) > 1:
        listed = " or ".join(f'"{s.name}"' for s in chosen)
        draft.questions[node, "", "stamps"] = (
            f"{listed}?  # which clock has stamped the {'commands' if side == 'command' else 'positions'}"
        )
    stamps = chosen[0]
    unit, reason = _stamp_unit(stamps)
    if unit is None:
        apart = f"the stamps are {_period(stamps.values[:, 0]):.6g} apart"
        draft.questions[node, "", "stamp_unit"] = f"{reason}?  # {apart}"
    draft.reasons[node, "", "stamps"] = f"by its name; {reason}"
    keys: dict[str, Any] = {"stamps": stamps.sources[0], "stamp_unit": unit or "s"}
    return keys, stamps.values[:, 0] * STAMP_UNITS[unit or "s"] * 1e-9


def _generated(
    signals: Sequence[Signal], named: Sequence[Signal], count: int, node: str, draft: Proposal
) -> tuple[dict[str, Any], np.ndarray]:
    """Return the keys and stamps of a node without a clock: by a rate in the file, or a question."""
    for s in signals:
        if s.values.shape == (1,) and s.values[0] > 0 and s.meaning.quantity in ("rate", "period"):
            value = float(s.values[0])
            rate_hz = value if s.meaning.quantity == "rate" else 1.0 / (value * (1.0 if value < 1.0 else 1e-3))
            draft.reasons[node, "", "rate_hz"] = f"{s.name!r} in the file"
            return {"rate_hz": rate_hz}, np.arange(count) / rate_hz
    why = f"the stamps {named[0].name!r} repeat or step back" if named else "the file has no time stamps"
    draft.questions[node, "", "rate_hz"] = f"?  # samples per second: {why}; --rate-hz answers, too"
    return {"rate_hz": 1.0}, np.arange(float(count))


def _stamp_unit(stamps: Signal) -> tuple[str | None, str]:
    """Return the unit of stamps and the reason; None and the candidates."""
    if stamps.meaning.unit in STAMP_UNITS:
        return stamps.meaning.unit, "unit by its name"
    values = stamps.values[np.isfinite(stamps.values[:, 0]), 0]
    seconds = {unit: nanoseconds * 1e-9 for unit, nanoseconds in STAMP_UNITS.items()}
    period = _period(values)
    wall = [u for u, s in seconds.items() if _WALL_S[0] < values[0] * s < _WALL_S[1]]
    likely = [u for u, s in seconds.items() if _RATES_HZ[0] <= 1 / (period * s) <= _RATES_HZ[1]]
    for listed, why in (([u for u in wall if u in likely], "dates since 1970"), (likely, "")):
        if len(listed) == 1:
            return listed[0], why or f"{1 / (period * seconds[listed[0]]):.4g} samples a second"
    return None, " or ".join(f'"{u}"' for u in likely or seconds)


def _apart_s(header: np.ndarray, log: np.ndarray) -> float:
    """Return by how much two clocks [ns] drift apart, without the few messages that came late."""
    apart = 1e-9 * (header - log)
    return max(float(np.ptp(np.quantile(apart, (0.05, 0.95)))), abs(float(apart[-1] - apart[0])))


def require_overlap(clocks: Mapping[str, np.ndarray], draft: Proposal) -> None:
    """Ask for the offset of two clocks if the streams hardly overlap."""
    t, c = (np.asarray(clocks[n])[np.isfinite(clocks[n])] for n in ("sensor", "actuator"))
    if len(t) and len(c) and min(t[-1], c[-1]) - max(t[0], c[0]) < 0.5 * min(np.ptp(t), np.ptp(c)):
        draft.questions["actuator", "", "stamp_offset"] = (
            f"{t[0] - c[0]:.6g}?  # stamps of commands and positions hardly overlap: seconds to add to commands"
        )


def _period(values: np.ndarray) -> float:
    steps = np.diff(values[np.isfinite(values)])
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0


def _increases(values: np.ndarray) -> bool:
    steps = np.diff(values[np.isfinite(values)])
    return steps.size > 1 and float((steps > 0).mean()) > 0.9 and not (steps < 0).any()
