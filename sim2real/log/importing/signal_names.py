"""The meaning of a signal's name in a file of another recorder: side, quantity, unit and joint."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from sim2real.types import Json

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
}
_UNITS = {
    "rad": "rad rads radian radians",
    "deg": "deg degs degree degrees",
    "s": "s sec secs second seconds",
    "ms": "ms msec millis milliseconds",
    "us": "us usec micros microseconds",
    "ns": "ns nsec nanos nanoseconds nanosec",
    "raw": "raw counts ticks",
    "rev": "rev revs revolution revolutions turns rotations",
    "mrad": "mrad milliradians",
    "mm": "mm millimeters millimetres",
    "percent": "percent pct normalized normalised",
}
OTHER_UNITS = ("rev", "mrad", "mm", "percent")
"""Units that need a mapping with a scale."""
_WEAK_WORDS = {"state", "states"}
_SIDE = {word: side for side, listed in _SIDES.items() for word in listed.split()}
_QUANTITY = {word: quantity for quantity, listed in _QUANTITIES.items() for word in listed.split()}
_UNIT = {word: unit for unit, listed in _UNITS.items() for word in listed.split()}
# Words without meaning: parts of messages, and names of lists of records.
_FILLERS = {
    "data",
    "entries",
    "msg",
    "log",
    "values",
    "value",
    "points",
    "motor",
    "motors",
    "per",
    "joint",
    "joints",
    "header",
}
_WORDS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class Meaning:
    """The meaning of a name; a part is empty if the name lacks it.

    Attributes:
        side: ``command`` or ``measured``.
        quantity: ``stamp``, ``position``, ``velocity``, ``torque``, ``duty``, ``voltage``, ``kp``, ``kd``,
            ``enabled``, ``rate``, ``period``, or ``error`` (a difference of two signals).
        unit: ``rad``, ``deg``, ``s``, ``ms``, ``us``, ``ns``, ``raw``, or one of
            ``OTHER_UNITS``.
        label: The remaining words, which name the joint.
    """

    side: str = ""
    quantity: str = ""
    unit: str = ""
    label: str = ""


def meaning(name: str) -> Meaning:
    """Return the meaning of a name; ``cmd_deg/FL_hip`` is a command in degrees, of joint ``fl_hip``."""
    quantity = unit = ""
    rest = []
    words = [word.lower() for word in _WORDS.findall(name)]
    for place, word in enumerate(words):
        # A letter is a unit only after another word, as in `t_s`; `s` alone is a name.
        known_unit = _UNIT.get(word, "") if place else ""
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
    sources = [name for field in fields if field for name in field["source"] if meaning(name).side != "command"]
    if not sources:
        return []
    listed = ", ".join(f"'{name}'" for name in sources[:3]) + (" ..." if len(sources) > 3 else "")
    return [
        f"{listed} is taken as the commanded torque, although its name does not mark a command: a measured joint "
        "torque is no command, as the robot's controller makes it from goals that the model then lacks; import the "
        "goals, or name a commanded torque cmd_torque"
    ]


def same_joint(label: str, joint: str) -> bool:
    """Return whether a column's label is the name of a model's joint, as ``fl_hip`` is of ``FL_hip_joint``."""
    words = [w.lower() for w in _WORDS.findall(joint)]
    return bool(label) and label in ("_".join(words), "_".join(w for w in words if w not in _FILLERS))
