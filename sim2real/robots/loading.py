"""Checks of robots when they are loaded: an incomplete robot is refused, and the message lists all of its gaps."""

import inspect
from collections.abc import Iterator, Mapping
from typing import Any

from sim2real.errors import UsageError
from sim2real.identify.model import Channel
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.completeness import HINT, Datum, has_texts, is_joints, is_positive, is_roles, tuple_of
from sim2real.robots.contract import RecordedRobot, Robot
from sim2real.robots.robot_parts import RobotAgent, RobotDrive, RobotModel, RobotSensor, RobotTask

RECORDED_DATA: Mapping[str, Datum] = {
    "units": ("field -> unit, e.g. {'th': 'rad'}", has_texts),
    "roles": ("sim2real.robots.roles.Roles with four different names", is_roles),
}
"""Data of a ``RecordedRobot``: name -> description and test."""
PARTS: Mapping[str, tuple[type, Mapping[str, Datum]]] = {
    "sensor": (
        RobotSensor,
        {
            "channels": ("a tuple of sim2real.identify.model.Channel", tuple_of(Channel)),
            "joints": ("joint -> quantity -> field, e.g. {'hinge': {'position': 'th'}}", is_joints),
            "units": RECORDED_DATA["units"],
            "at_rest": ("a message", lambda value: value is not None),
        },
    ),
    "drive": (
        RobotDrive,
        {
            "rate_hz": ("a number above 0 [Hz]", is_positive),
            "command": ("the name of a field", lambda value: isinstance(value, str) and bool(value)),
            "units": RECORDED_DATA["units"],
            "message": ("the type of the actuator's message", callable),
        },
    ),
    "agent": (
        RobotAgent,
        {
            "observation": ("a tuple of sim2real.policy.ObservationTerm", tuple_of(ObservationTerm)),
            "action": ("a tuple of sim2real.policy.ActionTerm", tuple_of(ActionTerm)),
            "units": RECORDED_DATA["units"],
        },
    ),
    "task": (RobotTask, {}),
    "model": (RobotModel, {"tick_s": ("a number above 0 [s]", is_positive)}),
}
"""The parts of a ``Robot``: name -> its class, and the data that it must have."""


def checked(robot: Any, where: str) -> RecordedRobot:
    """Return the robot of a module.

    Args:
        robot: The module's ``ROBOT``; None if it has none.
    """
    # List the gaps of a robot and of its parts.
    if isinstance(robot, Robot):
        gaps = [gap for name, part in PARTS.items() for gap in _gaps_of_part(robot, name, *part)]
        gaps += [] if gaps else _gaps(robot, Robot, RECORDED_DATA)
    elif isinstance(robot, RecordedRobot) and not isinstance(robot, type):
        gaps = _gaps(robot, RecordedRobot, {**RECORDED_DATA, **getattr(robot, "_DATA", {})})
    else:
        value = f"is {robot!r}" if robot is not None else "is missing"
        raise UsageError(
            f"ROBOT of {where} {value}: a robot is an object of a class that inherits from "
            "sim2real.robots.contract.Robot, or from RecordedRobot where there are recordings only",
            hint="write a class with the five parts of a Robot, and end with `ROBOT = MyRobot()`",
        )
    if gaps:
        raise UsageError(
            f"robot {type(robot).__module__}.{type(robot).__qualname__} is not complete: it " + "; it ".join(gaps),
            hint=HINT.format("sim2real.robots.contract", "Robot" if isinstance(robot, Robot) else "RecordedRobot"),
        )
    return robot


def _gaps_of_part(robot: Any, name: str, kind: type, data: Mapping[str, Datum]) -> Iterator[str]:
    """Yield the gaps of one part of a robot."""
    part = getattr(robot, name, None)
    if part is None:
        yield f"has no {name}: a sim2real.robots.contract.{kind.__name__}"
    elif kind not in type(part).__mro__:
        yield f"has {name} = {part!r}, which does not inherit from sim2real.robots.contract.{kind.__name__}"
    else:
        yield from (f"has a {name} that {gap}" for gap in _gaps(part, kind, data))


def _gaps(owner: Any, base: type, data: Mapping[str, Datum]) -> list[str]:
    """Return the attributes that are missing or of the wrong kind, and the methods with other arguments."""
    gaps, absent = [], object()
    for name, (description, holds) in data.items():
        if (value := getattr(owner, name, absent)) is absent:
            gaps.append(f"has no {name}: {description}")
        elif not holds(value):
            gaps.append(f"has {name} = {value!r}, which is not {description}")
    for name, method in vars(base).items():
        if name.startswith("_") or not inspect.isfunction(method):
            continue
        override, arguments = getattr(owner, name), list(inspect.signature(method).parameters)[1:]
        arguments = [a for a in arguments if a != "options"]
        try:
            inspect.signature(override).bind(*arguments)
        except TypeError:
            gaps.append(f"has {name} = {override!r}, which does not take ({', '.join(arguments)})")
    return gaps
