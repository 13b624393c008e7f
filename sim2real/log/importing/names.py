"""The meaning of names in a file of another recorder: side, quantity, unit and joint; which columns belong together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.mapping import FieldMapping
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.log.importing.readers import Table

_SIDES = {
    "command": (
        "cmd command commanded commands goal goals target targets told des desired ref reference setpoint sp action "
        "actions ctrl control controls u ff feedforward"
    ),
    "measured": "meas measured measurement state states actual present obs observation fb feedback sensor encoder",
}
_QUANTITIES = {
    "stamp": "t time times stamp stamps timestamp timestamps sec secs date datetime",
    "position": "q qs qpos pos position positions angle angles th theta",
    "velocity": "dq qd qvel vel velocity velocities speed speeds omega thdot qdot rate_of_angle",
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
    "counter": "seq sequence",
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
    "mm": "mm millimeters millimetres",
    "m": "m meters metres",
    "percent": "percent pct normalized normalised hundredths",
}
_WEAK_WORDS = {"state", "states"}
_SIDE = {word: side for side, listed in _SIDES.items() for word in listed.split()}
_QUANTITY = {word: quantity for quantity, listed in _QUANTITIES.items() for word in listed.split()}
_UNIT = {word: unit for unit, listed in _UNITS.items() for word in listed.split()}
_MEANINGLESS = "data entries msg log values value points motor motors per joint joints header field"
_FILLERS = set(_MEANINGLESS.split())
"""Parts of messages, and names of lists of records."""
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class Meaning:
    """The meaning of a name; a part is empty if the name lacks it."""

    side: str = ""  # command or measured
    quantity: str = ""  # a key of the table of quantities
    unit: str = ""  # a key of the table of units
    label: str = ""  # the remaining words, which name the joint


def meaning(name: str) -> Meaning:
    """Return the meaning of a name; ``cmd_deg/FL_hip`` is a command in degrees, of joint ``fl_hip``."""
    quantity = unit = ""
    rest = []
    words = [
        word.lower() for word in _WORDS.findall(name.replace("%", " percent ").replace("\N{DEGREE SIGN}", " deg "))
    ]
    if name.startswith("%time"):
        words = words[1:]
    for place, word in enumerate(words):
        # A letter is a unit only after another word, as in `t_s`; `s` alone is a name.
        known_unit = _UNIT.get(word, "") if place and (word != "m" or place == len(words) - 1) else ""
        if word in _SIDE:
            continue
        if word in _QUANTITY and not (quantity == "stamp" and known_unit):
            # The last quantity counts, unless it is an error: `torque_enable` enables, `goal_time` is a time.
            quantity = quantity if quantity == "error" else _QUANTITY[word]
        elif word == "reach" and quantity == "payload":  # alone it may be of a task
            quantity = "reach"
        elif known_unit:
            unit = known_unit
        elif word not in _FILLERS:
            rest.append(word)
    # `dq_rad_s`: an angle over a time is a velocity, in the angle's unit.
    if quantity == "velocity" and unit == "s":
        unit = next((u for w in words if (u := _UNIT.get(w, "")) in ("rad", "deg")), "")
    return Meaning(_side(name), quantity, unit, "_".join(rest))


def _side(name: str) -> str:
    """Return the side of a signal, from the innermost part of its path with a side.

    ``/controller_state.reference.positions`` is a command, although its topic is a state.
    """
    for part in re.split(r"[./]", name)[::-1]:
        words = [word for word in map(str.lower, _WORDS.findall(part)) if word in _SIDE]
        # `target_joint_state` and `state_desired` are commands, so "state" counts only without another word.
        strong = [word for word in words if word not in _WEAK_WORDS] or words
        if strong:
            return _SIDE[strong[0]]
    return ""


def about_torque(mapping: Mapping[str, Mapping[str, Json]]) -> list[str]:
    """Return a sentence if a log's commanded torque has a name that does not mark a command.

    Args:
        mapping: Node -> its mapping, as in the metadata of an imported log.
    """
    fields = [node["fields"].get("torque") for node in mapping.values()]
    listed = [[f["source"]] if isinstance(f["source"], str) else f["source"] for f in fields if f]
    sources = [f"'{name}'" for names in listed for name in names if meaning(name).side != "command"]
    if not sources:
        return []
    return [
        f"{', '.join(sources[:3]) + ' ...' * (len(sources) > 3)} is taken as the commanded torque, although its name "
        "does not mark a command: a measured joint torque is no command, as the robot's controller makes it from goals "
        "that the model then lacks; import the goals, or name a commanded torque cmd_torque"
    ]


def is_unit(text: str) -> bool:
    """Return whether a text is a unit, such as ``rad/s``, ``[deg]`` or ``N m``."""
    words = [w.lower() for w in re.findall(r"[A-Za-z%]+", text)]
    return bool(words) and all(w in _UNIT or w in ("n", "m", "nm", "a", "v", "%", "kg", "per", "mm") for w in words)


def are_numbers(labels: Sequence[str]) -> bool:
    """Return whether labels are the numbers of joints, not their names: ``3``, or ``m_3``, with one letter for all."""
    found = [re.fullmatch(r"([a-z]?)_?\d+", label) for label in labels]
    return None not in found and len({match[1] for match in found if match}) == 1


def same_joint(label: str, joint: str) -> bool:
    """Return whether a column's label is the name of a model's joint, as ``fl_hip`` is of ``FL_hip_joint``."""
    words = [w.lower() for w in _WORDS.findall(joint)]
    named = meaning(joint).label
    return bool(label) and label in ("_".join(words), "_".join(w for w in words if w not in _FILLERS), named)


def columns_of(joints: Sequence[str], labels: Sequence[str]) -> tuple[list[int], str] | None:
    """Return the column of each joint of a robot by the labels of columns, and how they match; None if they do not.

    Names match as they are, or by leg and part: a vendor's ``FR_0`` is the first joint of the front right leg,
    ``LF_HAA`` the hip of the front left one.
    """
    exact = [[i for i, label in enumerate(labels) if same_joint(label, joint)] for joint in joints]
    if all(len(found) == 1 for found in exact):
        return [found[0] for found in exact], "by name"
    legs = _by_leg(joints), _by_leg(labels)
    if legs[0] is None or legs[1] is None or len(set(legs[0])) < len(joints) or len(set(legs[1])) < len(labels):
        return None
    if not set(legs[0]) <= set(legs[1]):
        return None
    return [legs[1].index(at) for at in legs[0]], "by leg and part"


def _by_leg(names: Sequence[str]) -> list[tuple[str, int]] | None:
    """Return leg and number of the part, 0 for the hip, of each name; None if one has no leg or no part."""
    legs: list[str] = []
    parts: list[str] = []
    either = "|".join(_LEGS)
    for name in names:
        words = [w.lower() for w in _WORDS.findall(name)]
        text = "".join(_LEG_WORDS.get(w) or w for w in words if w not in _FILLERS and w != "leg")
        match = re.fullmatch(f"({either})(.+)|(.+)({either})", text)
        if match is None:
            return None
        legs.append(_LEGS[match[1] or match[4]])
        parts.append(match[2] or match[3])
    if not any(part.isdigit() for part in parts):
        return None if set(parts) - set(_PART) else [(leg, _PART[p]) for leg, p in zip(legs, parts, strict=True)]
    # Numbers count from 0 or from 1, in each leg alike.
    if not all(part.isdigit() for part in parts):
        return None
    numbers = [int(part) for part in parts]
    if min(numbers) > 1 or len(set(legs)) * len(set(numbers)) != len(names):
        return None
    return [(leg, n - min(numbers)) for leg, n in zip(legs, numbers, strict=True)]


_LEG_WORDS = {"front": "f", "fore": "f", "rear": "r", "hind": "r", "back": "r", "left": "l", "right": "r"}
_LEGS = {
    "fl": "fl", "fr": "fr", "rl": "rl", "rr": "rr", "lf": "fl", "rf": "fr", "lh": "rl", "rh": "rr",
    "hl": "rl", "hr": "rr",
    "lr": "rl", "lb": "rl", "rb": "rr", "bl": "rl", "br": "rr",
}  # fmt: skip
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
        labels: Joint of each column; empty if its name has none.
        values: Shape ``(N, columns)``; ``(columns,)`` for constants.
        whole: Source of all columns together; empty if they are separate signals of the file.
    """

    sources: tuple[str, ...]
    labels: tuple[str, ...]
    meaning: Meaning
    values: np.ndarray
    whole: str = ""

    @property
    def name(self) -> str:
        return self.whole or ", ".join(self.sources[:3]) + " ..." * (len(self.sources) > 3)

    @property
    def width(self) -> int:
        return len(self.sources)

    @property
    def stream(self) -> str:
        """The topic of a signal in a bag, or the file of one of several; empty for others."""
        key = self.sources[0]
        return key.partition(".")[0] if key.startswith("/") else key.partition("/")[0] if "/" in key else ""

    def taken(self, places: Sequence[int]) -> Signal:
        """Return some of the columns, in this order."""
        whole = self.whole if list(places) == list(range(self.width)) else ""
        sources, labels = (tuple(part[i] for i in places) for part in (self.sources, self.labels))
        return Signal(sources, labels, self.meaning, self.values[..., list(places)], whole)

    def mapped(self, unit: str) -> FieldMapping:
        """Return the field that has these columns."""
        return FieldMapping(self.whole or self.sources, unit)


def collect(table: Table) -> tuple[list[Signal], list[str]]:
    """Return all signals of numbers with at most two dimensions, and notes on skipped ones.

    Columns whose names differ only by the joint are one signal.

    Raises:
        UsageError: When a signal with the name of a position or a command cannot be read.
    """
    notes: list[str] = []
    for key, why in table.broken.items():
        named = _meaning(key, table)
        # Without such a column, another one could be taken for the positions.
        if named.quantity == "position" or (named.side and not named.quantity):
            raise UsageError(f"{key!r} in {table.path} cannot be read: {why}", hint="correct it, or remove the column")
        notes.append(f"skipped: {key!r}: {why}")
    lists = {key: words for key, words in table.words.items() if _names_joints(key, words)}
    if words := [key for key in table.words if key not in lists and len(set(table.words[key])) > 1]:
        notes.append(f"skipped, as they hold no numbers: {', '.join(words[:20])}")
    alike: dict[tuple[Meaning, tuple[int, ...], str], list[Signal]] = {}
    signals: list[Signal] = []
    for key, raw in table.columns.items():
        named, values = _meaning(key, table), raw.astype(np.float64)
        if values.ndim > 2 or (values.ndim == 2 and values.shape[1] > 1000):
            notes.append(f"skipped: {key!r} has samples of shape {values.shape[1:]}, as images have")
        elif values.size and not np.isfinite(values).any():
            notes.append(f"skipped: {key!r} has no number in any sample")
        elif values.ndim == 2:
            n = values.shape[1]
            names = table.names.get(key) or _names_of(key, n, lists, table)
            labels = tuple(meaning(x).label or x.lower() for x in names) if len(names) == n else ("",) * n
            signals.append(Signal(tuple(f"{key}[:,{i}]" for i in range(n)), labels, named, values, key))
        else:
            row = Signal((key,), (_label(key, named, table),), named, values[..., None])
            alike.setdefault((replace(named, label=""), values.shape, row.stream), []).append(row)
    for (named, _, _), rows in alike.items():
        labels = [row.labels[0] for row in rows]
        numbered = are_numbers(labels)
        together = len(set(labels)) == len(labels) > 1 and "" not in labels and named.quantity != "stamp"
        if not together or not (named.side or named.quantity or numbered):
            signals += rows
            continue
        if numbered:
            rows.sort(key=lambda row: int(re.findall(r"\d+", row.labels[0])[0]))
        values = np.concatenate([row.values for row in rows], axis=-1)
        signals.append(Signal(tuple(r.sources[0] for r in rows), tuple(r.labels[0] for r in rows), named, values))
    return signals, notes


def _meaning(key: str, table: Table) -> Meaning:
    """Return the meaning of a signal's name; of a file's name only the side counts."""
    stem = next((stem for stem in table.stems if key.startswith(stem)), "")
    named = meaning(key[len(stem) :])
    return named if named.side or not stem else replace(named, side=meaning(stem).side)


def _label(key: str, named: Meaning, table: Table) -> str:
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


def _names_of(key: str, width: int, lists: Mapping[str, list[str]], table: Table) -> list[str]:
    """Return the names of a signal's columns by the list in the file that shares most words with its name."""
    words = set(re.findall("[a-z]+", key.lower()))
    shared = {k: len(set(re.findall("[a-z]+", k.lower())) & words) for k, names in lists.items() if len(names) == width}
    best = [lists[k] for k, n in shared.items() if n == max(shared.values())]
    if len({tuple(names) for names in best}) > 1 and meaning(key).quantity in ("", "position"):
        raise UsageError(
            f"{', '.join(shared)} in {table.path} name the columns of {key!r} in different orders",
            hint="remove the list that does not belong to it, or write a mapping with the columns",
        )
    return best[0] if best else []
