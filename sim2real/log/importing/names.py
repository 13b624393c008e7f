"""Reads names in a recorder's file: command or measurement, quantity, unit and joint; and joins columns to signals."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.mapping import LENGTHS_AND_ANGLES, FieldMapping, in_si
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.log.importing.readers import Table

_SIDES = {
    "command": (
        "cmd cmds cmnd command commands commanded goal goals target targets tgt told des desired demand demanded "
        "wanted ref reference setpoint set sp soll action actions ctrl control controls u ff feedforward"
    ),
    "measured": (
        "meas measured measurement mes msr state states actual present obs observation fb fbk feedback reading "
        "readings sensor enc encoder estimate estimated est pv ist"
    ),
}
_QUANTITIES = {
    "stamp": "t time times zeit stamp stamps timestamp timestamps sec secs seconds date datetime elapsed clock uptime",
    "position": "q qs qj qpos pos jpos position positions ang angle angles th theta",
    "velocity": "dq qd qvel vel velocity velocities speed speeds omega thdot qdot",
    "torque": "tau torque torques effort efforts load loads current currents force forces",
    "duty": "pwm duty",
    "voltage": "volt volts voltage vin",
    "kp": "kp stiffness",
    "kd": "kd",
    "enabled": "enable enabled",
    "payload": "payload",
    "rate": "fps rate hz freq frequency",
    "period": "dt period",
    "error": "error errors err",
    "counter": "seq sequence layout",
}
_UNITS = {
    "rad": "rad rads radian radians",
    "deg": "deg degs degree degrees",
    "s": "s sec secs second seconds",
    "ms": "ms msec millis milliseconds",
    "us": "us usec micros microseconds",
    "ns": "ns nsec nanos nanoseconds nanosec",
    "counts": "raw count counts tick ticks",
    "rev": "rev revs revolution revolutions turn turns rotations",
    "mrad": "mrad milliradians",
    "mdeg": "mdeg millidegrees",
    "cdeg": "cdeg centidegrees",
    "mm": "mm millimeters millimetres",
    "m": "m meters metres",
    "percent": "percent pct normalized normalised hundredths",
}
_PHRASES = (
    (r"%(?!time)", " percent "),
    ("\N{DEGREE SIGN}", " deg "),
    (r"(?i)\binput_(?=pos|vel)", "command_"),  # ODrive
    (r"\b(d?q)_d_(?=[A-Za-z0-9])", r"\1_command_"),  # libfranka; q_d alone may be a joint d
)
"""Spellings of some manufacturers -> words of the tables."""
_WEAK_WORDS = {"state", "states"}
_SIDE, _QUANTITY, _UNIT = (
    {word: kind for kind, words in table.items() for word in words.split()} for table in (_SIDES, _QUANTITIES, _UNITS)
)
_MEANINGLESS = "data entries msg log values value points motor motors servo servos axis per joint joints header field"
_FILLERS = set(_MEANINGLESS.split())
"""Parts of names that have no meaning, such as names of messages."""
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class Meaning:
    """The meaning of a name; empty strings for missing parts."""

    side: str = ""  # command or measured
    quantity: str = ""  # a key of the table of quantities
    unit: str = ""  # a key of the table of units
    label: str = ""  # the remaining words, which are the joint's name


def meaning(name: str) -> Meaning:
    """Return the meaning of a name; ``cmd_deg/FL_hip`` is a command in degrees, of joint ``fl_hip``."""
    for spelling, words_of_it in _PHRASES:
        name = re.sub(spelling, words_of_it, name)
    quantity = unit = ""
    rest = []
    words = _words(name)[name.startswith("%time") :]
    for place, word in enumerate(words):
        # A letter is a unit only after another word, as in `t_s`; `s` alone is a name.
        known_unit = _UNIT.get(word, "") if place and (word != "m" or place == len(words) - 1) else ""
        if word in _SIDE:
            continue
        if word in _QUANTITY and not (quantity == "stamp" and known_unit):
            # The last quantity counts, unless it is an error: `torque_enable` is an enabling, `goal_time` a time.
            quantity = quantity if quantity == "error" else _QUANTITY[word]
        elif word == "reach" and quantity == "payload":  # alone, the word may belong to a task
            quantity = "reach"
        elif known_unit:
            unit = known_unit
        elif word not in _FILLERS:
            rest.append(word)
    if len(words) == 1 and len(words[0]) > 1 and _UNIT.get(words[0]) in ("s", "ms", "us", "ns"):  # such as `millis`
        quantity, unit, rest = "stamp", _UNIT[words[0]], []
    # `dq_rad_s`: an angle over a time is the unit of a velocity, whose angle counts.
    if quantity == "velocity" and unit == "s":
        unit = next((u for w in words if (u := _UNIT.get(w, "")) in LENGTHS_AND_ANGLES), "")
    side = _side(name)
    if "act" in rest and not side:  # the actual position, or an action
        side = "measured" if quantity else "command"
        rest.remove("act")
    return Meaning(side, quantity, unit, "_".join(rest))


def is_unit(cell: str) -> bool:
    """Return whether a cell of a table holds a unit, such as ``[rad]``, or nothing."""
    others = {"v", "a", "n", "nm"}  # units of quantities that are no angles
    return bool(re.fullmatch(r"\[.*\]|\(.*\)", cell.strip())) or all(w in _UNIT or w in others for w in _words(cell))


def _words(name: str) -> list[str]:
    return [word.lower() for word in _WORDS.findall(name)]


def _side(name: str) -> str:
    """Return whether a signal is a command or measured, by the innermost part of its path that says so.

    ``/controller_state.reference.positions`` is a command, although its topic is a state.
    """
    for part in re.split(r"[./]", name)[::-1]:
        words = [word for word in _words(part) if word in _SIDE]
        # `target_joint_state` and `state_desired` are commands, so "state" counts only without another word.
        strong = [word for word in words if word not in _WEAK_WORDS] or words
        if strong:
            return _SIDE[strong[0]]
    return ""


def about_torque(mapping: Mapping[str, Mapping[str, Json]]) -> list[str]:
    """Return a sentence if the name of a log's commanded torque does not say that it is a command.

    Args:
        mapping: Node -> its mapping, as in the metadata of an imported log.
    """
    listed = [node["fields"]["torque"]["source"] for node in mapping.values() if "torque" in node["fields"]]
    names = [name for source in listed for name in ([source] if isinstance(source, str) else source)]
    sources = [f"'{name}'" for name in names if meaning(name).side != "command"]
    if not sources:
        return []
    return [
        f"{', '.join(sources[:3]) + ' ...' * (len(sources) > 3)} is taken as the commanded torque, although its name "
        "does not mark a command: a measured joint torque is no command, as the robot's controller makes it from goals "
        "that the model then lacks; import the goals, or name a commanded torque cmd_torque"
    ]


# -- joints


def are_numbers(labels: Sequence[str]) -> bool:
    """Return whether labels are numbers of joints, not names: ``3``, or ``m_3`` with the same letter for all."""
    found = [re.fullmatch(r"([a-z]?)_?\d+", meaning(label).label) for label in labels]
    return None not in found and len({match[1] for match in found if match}) == 1


def numbers_of(names: Sequence[str]) -> list[int]:
    """Return the numbers in names that differ only in a number, such as ``A1`` and ``A2``; else nothing."""
    found = [re.fullmatch(r"(.*?)(\d+)", "_".join(w for w in _words(n) if w not in _FILLERS)) for n in names]
    numbers = [int(match[2]) for match in found if match]
    stems = {match[1] for match in found if match}
    return numbers if len({*numbers}) == len(names) and len(stems) == 1 else []


def same_joint(label: str, joint: str) -> bool:
    """Return whether a column's label means a joint of the model, as ``fl_hip`` means ``FL_hip_joint``."""
    return bool(_spellings(label) & _spellings(joint))


def _spellings(joint: str) -> set[str]:
    words = _words(joint)
    return {"_".join(words), "_".join(w for w in words if w not in _FILLERS), meaning(joint).label} - {""}


def columns_of(joints: Sequence[str], labels: Sequence[str]) -> tuple[list[int], str] | None:
    """Return the column of each joint of a robot, by labels, and how they match; None if they do not match.

    Names match as they are, or without the prefix that all of one side have, by number, if only numbers tell them
    apart, or by leg and part: a vendor's ``FR_0`` is the first joint of the front right leg, ``LF_HAA`` the hip of the
    front left one.
    """
    sides = (joints, labels, ""), (joints, _short(labels), ", without a prefix"), (_short(joints), labels, "")
    for own_names, names, how in sides:
        exact = [[i for i, label in enumerate(names) if same_joint(label, joint)] for joint in own_names]
        if all(len(found) == 1 for found in exact):
            return [found[0] for found in exact], f"by name{how}"
    mine, given = numbers_of(joints), numbers_of(labels)
    if mine and given:  # file and robot may count from 0 or from 1
        shifts = {0, min(mine) - min(given)} if {min(mine), min(given)} == {0, 1} else {0}
        found = next((s for s in shifts if {k - s for k in mine} <= set(given)), None)
        return None if found is None else ([given.index(k - found) for k in mine], "by number")
    own, theirs = _legs(joints), _legs(labels)
    if not own or not theirs or len(set(own)) < len(joints) or len(set(theirs)) < len(labels):
        return None
    return ([theirs.index(at) for at in own], "by leg and part") if set(own) <= set(theirs) else None


def _short(names: Sequence[str]) -> list[str]:
    """Return names without the words that all of them begin with, such as ``ur5e`` of ``ur5e_elbow_joint``."""
    words = [_words(name) for name in names]
    shared = 0
    while len(words) > 1 and len({tuple(w[: shared + 1]) for w in words}) == 1 and shared < len(words[0]):
        shared += 1
    return ["_".join(w[shared:]) for w in words]


def _legs(names: Sequence[str]) -> list[tuple[str, int]]:
    """Return leg and number of the part (0: hip) of each name; nothing if a name has no leg or no part."""
    legs: list[str] = []
    parts: list[str] = []
    either = "|".join(_LEGS)
    for name in names:
        text = "".join(_LEG_WORDS.get(w) or w for w in _words(name) if w not in _FILLERS and w != "leg")
        match = re.fullmatch(f"({either})(.+)|(.+)({either})", text)
        if match is None:
            return []
        legs.append(_LEGS[match[1] or match[4]])
        parts.append(match[2] or match[3])
    if not any(part.isdigit() for part in parts):
        return [] if set(parts) - set(_PART) else [(leg, _PART[p]) for leg, p in zip(legs, parts, strict=True)]
    # Numbers count from 0 or from 1, equally in all legs.
    numbers = [int(part) if part.isdigit() else -1 for part in parts]
    if not 0 <= min(numbers) <= 1 or len(set(legs)) * len(set(numbers)) != len(names):
        return []
    return [(leg, n - min(numbers)) for leg, n in zip(legs, numbers, strict=True)]


_LEG_WORDS = {"front": "f", "fore": "f", "rear": "r", "hind": "r", "back": "r", "left": "l", "right": "r"}
_LEGS = {
    word: leg
    for leg, words in {"fl": "fl lf", "fr": "fr rf", "rl": "rl lh hl lr lb bl", "rr": "rr rh hr rb br"}.items()
    for word in words.split()
}
_PART = {
    word: number
    for number, words in enumerate(("hip haa abad abduction abduct hipx hx coxa", "thigh hfe upper hipy hy femur",
                                    "calf kfe knee lower shank kn tibia"))
    for word in words.split()
}  # fmt: skip


# -- columns that belong together


@dataclass(frozen=True)
class Signal:
    """Columns that belong together.

    Attributes:
        sources: Source of each column, as in a mapping.
        labels: Joint of each column; empty if the column's name has no joint.
        values: Shape ``(N, columns)``; ``(columns,)`` for constants.
        whole: Source of all columns together; empty if they are separate signals of the file.
        scale: Factor of each column to SI units, if their names have several units; else empty.
        stream: Topic of a bag, or one of several files; otherwise empty.
    """

    sources: tuple[str, ...]
    labels: tuple[str, ...]
    meaning: Meaning
    values: np.ndarray
    whole: str = ""
    stream: str = ""
    scale: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        return self.whole or ", ".join(self.sources[:3]) + " ..." * (len(self.sources) > 3)

    @property
    def width(self) -> int:
        return len(self.sources)

    def taken(self, places: Sequence[int]) -> Signal:
        """Return the columns at ``places``, in this order."""
        whole = self.whole if list(places) == list(range(self.width)) else ""
        sources, labels = (tuple(part[i] for i in places) for part in (self.sources, self.labels))
        scale = tuple(self.scale[i] for i in places) if self.scale else ()
        values = self.values[..., list(places)]
        return replace(self, sources=sources, labels=labels, values=values, whole=whole, scale=scale)

    def mapped(self, unit: str) -> FieldMapping:
        """Return the mapping's field with these columns."""
        return FieldMapping(self.whole or self.sources, unit, **({"scale": self.scale} if self.scale else {}))


def collect(table: Table) -> tuple[list[Signal], list[str]]:
    """Return all signals of numbers with at most two dimensions, and notes on skipped signals.

    Columns whose names differ only by the joint are one signal.

    Raises:
        UsageError: A signal with the name of a position or a command cannot be read.
    """
    notes: list[str] = []
    for key, why in table.broken.items():
        named = _meaning(key, table)
        # Do not skip the column: another one could be taken for the positions.
        if named.quantity == "position" or (named.side and not named.quantity):
            raise UsageError(f"{key!r} in {table.path} cannot be read: {why}", hint="correct it, or remove the column")
        notes.append(f"skipped: {key!r}: {why}")
    lists = {key: words for key, words in table.words.items() if _names_joints(key, words)}
    if words := [key for key in table.words if key not in lists and len(set(table.words[key])) > 1]:
        notes.append(f"skipped, as they hold no numbers: {', '.join(words[:20])}")
    alike: dict[tuple[Meaning, tuple[int, ...], str], list[Signal]] = {}
    signals: list[Signal] = []
    for key, raw in table.columns.items():
        named, values, stream = _meaning(key, table), raw.astype(np.float64), _stream(key, table)
        if values.ndim > 2 or (values.ndim == 2 and values.shape[1] > 1000):
            notes.append(f"skipped: {key!r} has samples of shape {values.shape[1:]}, as images have")
        elif values.size and not np.isfinite(values).any():
            notes.append(f"skipped: {key!r} has no number in any sample")
        elif values.ndim == 2:
            n = values.shape[1]
            names = table.names.get(key) or _names_of(key, n, lists, table)
            labels = tuple(map(_joint_of, names)) if len(names) == n else ("",) * n
            if named.label == "d" and named.quantity:  # q_d of libfranka
                named = replace(named, side="command")
            signals.append(Signal(tuple(f"{key}[:,{i}]" for i in range(n)), labels, named, values, key, stream))
        else:
            row = Signal((key,), (_label(key, named, table),), named, values[..., None], stream=stream)
            alike.setdefault((replace(named, label="", unit=""), values.shape, stream), []).append(row)
    for (named, stream), rows in [((m, s), r) for (m, _, s), all_rows in alike.items() for r in _by_unit(all_rows)]:
        several = len({row.meaning.unit for row in rows}) > 1
        named = replace(named, unit="rad" if several else rows[0].meaning.unit)
        labels = tuple(row.labels[0] for row in rows)
        numbered = are_numbers(labels)
        together = len(set(labels)) == len(labels) > 1 and "" not in labels and named.quantity != "stamp"
        if not together or not (named.side or named.quantity or numbered):
            signals += rows
            continue
        values = np.concatenate([row.values for row in rows], axis=-1)
        scale = tuple(in_si(row.meaning.unit)[0] for row in rows) if several else ()
        found = Signal(tuple(r.sources[0] for r in rows), labels, named, values, stream=stream, scale=scale)
        numbers = [int(re.findall(r"\d+", label)[0]) for label in labels] if numbered else []
        signals.append(found.taken(np.argsort(numbers, kind="stable").tolist()) if numbered else found)
    return signals, notes


def _by_unit(rows: list[Signal]) -> list[list[Signal]]:
    """Group signals by unit; signals of different joints with units of length or angle stay together."""
    groups: dict[str, list[Signal]] = {}
    for row in rows:
        groups.setdefault(row.meaning.unit, []).append(row)
    labels = [row.labels[0] for row in rows]
    together = set(groups) <= {*LENGTHS_AND_ANGLES} and len({*labels}) == len(labels) and "" not in labels
    return [rows] if together and rows[0].meaning.quantity in ("", "position") else list(groups.values())


def _meaning(key: str, table: Table) -> Meaning:
    """Return the meaning of a signal's name; in a file's name, only the word for command or measurement counts."""
    stem = next((stem for stem in table.stems if key.startswith(stem)), "")
    named = meaning(key[len(stem) :])
    return named if named.side or not stem else replace(named, side=meaning(stem).side)


def _stream(key: str, table: Table) -> str:
    if table.format == "mcap":
        return key.partition(".")[0]
    return next((stem for stem in table.stems if key.startswith(stem)), "")


def _label(key: str, named: Meaning, table: Table) -> str:
    """Return a column's joint; in rostopic's files, ``position0`` belongs to the joint named in ``name0``."""
    if match := re.fullmatch(r"(.*?)[a-z]+(\d+)", key):
        words = table.words.get(f"{match[1]}name{match[2]}", [])
        if words and len(set(words)) == 1:
            return _joint_of(words[0])
    return named.label


def _joint_of(name: str) -> str:
    """Return the joint in a name such as ``shoulder.pos``; other names stay as they are."""
    named = meaning(name)
    return named.label or name if named.side or named.quantity or named.unit else name


def _names_joints(key: str, words: Sequence[str]) -> bool:
    parts = set(re.findall("[a-z]+", key.lower()))
    wanted = parts & {"names", "joints", "name"} and not parts & {"body", "bodies", "link", "links", "foot", "feet"}
    return bool(wanted) and len(set(words)) == len(words)


def _names_of(key: str, width: int, lists: Mapping[str, list[str]], table: Table) -> list[str]:
    """Return the names of a signal's columns, from the list whose name shares most words with the signal's."""
    words = set(re.findall("[a-z]+", key.lower()))
    shared = {k: len(set(re.findall("[a-z]+", k.lower())) & words) for k, names in lists.items() if len(names) == width}
    best = [lists[k] for k, n in shared.items() if n == max(shared.values())]
    if len({tuple(names) for names in best}) > 1 and meaning(key).quantity in ("", "position"):
        raise UsageError(
            f"{', '.join(shared)} in {table.path} name the columns of {key!r} in different orders",
            hint="remove the list that does not belong to it, or write a mapping with the columns",
        )
    return best[0] if best else []
