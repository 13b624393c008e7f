"""The parameters that are identified in a robot's model if the user names none."""

from __future__ import annotations

import re
from collections.abc import Sequence

from sim2real.robots.from_model.joints.quantities import ON_DOF, ParameterPattern, What
from sim2real.robots.from_model.mjcf import gains_of, limit_of
from sim2real.types import MjModel, PyTree

_MOST_NAMES = 3
"""Largest number of joints that the name of a group lists."""


def named_terms(parameters: Sequence[str]) -> tuple[ParameterPattern, ...]:
    """Return the parameters that the user names."""
    return tuple(ParameterPattern.parse(parameter) for parameter in parameters)


def usual_terms(
    commands: Sequence[str], physical: bool = False, model: MjModel = None, joints: Sequence[str] = ()
) -> tuple[ParameterPattern, ...]:
    """Return the default parameters to identify.

    Stiffness or gain, damping and inertia are one value for each group of like joints, dry friction is each joint's
    own. The drive's damping and the joint's can be separated only where torque is switched off or the log has gains of
    its own: else there is one.

    Args:
        commands: Fields of the log that drive.
        physical: Whether the log's own gains are in N m/rad and N m s/rad: then factors of them are identified, one
            for all joints.
        model: The file's model, whose figures make the groups; default: all joints are one group.
        joints: The recorded joints.
    """
    alike = alike_joints(model, joints) if model is not None else []
    factors: list[ParameterPattern] = []
    grouped: list[What] = []
    if "goal" in commands and physical:
        factor: dict[str, PyTree] = {"nominal": 1.0, "low": 0.3, "high": 3.0}
        factors = [ParameterPattern("kp", **factor), ParameterPattern("kd", **factor)]
    elif "goal" in commands:
        grouped = ["kp", *(["kd"] if "enabled" in commands else [])]
    else:
        grouped = ["kd" if "goal_velocity" in commands else "gain"]
    if "goal_velocity" not in commands or "goal" in commands:
        grouped.append("damping")
    grouped.append("armature")
    return (
        *factors,
        *(pattern for what in grouped for pattern in _by_group(what, alike)),
        ParameterPattern("frictionloss", each=True),
    )


def alike_joints(model: MjModel, joints: Sequence[str]) -> list[list[str]]:
    """Return the joints in groups whose drives the file describes with the same figures.

    The figures are gains, torque limit, damping, inertia and friction.
    """
    groups: dict[object, list[str]] = {}
    for joint in joints:
        dof = model.joint(joint).dofadr[0]
        own = tuple(round(float(getattr(model, field)[dof]), 9) for field in ON_DOF.values())
        groups.setdefault((gains_of(model, joint), limit_of(model, joint), own), []).append(joint)
    return list(groups.values())


def _by_group(what: What, alike: Sequence[Sequence[str]]) -> list[ParameterPattern]:
    """Return one pattern for all joints, or one for each group."""
    if len(alike) < 2:
        return [ParameterPattern(what)]
    names = _group_names(alike)
    return [
        ParameterPattern(what, "|".join(map(re.escape, joints)), name=f"{what}_{name}")
        for joints, name in zip(alike, names, strict=True)
    ]


def _group_names(alike: Sequence[Sequence[str]]) -> list[str]:
    """Return the words that only a group's joints share, such as ``calf``; else the names of its first joints."""
    words = [[re.findall(r"[A-Za-z0-9]+", joint) for joint in joints] for joints in alike]
    names = []
    for i, joints in enumerate(alike):
        elsewhere = {word for k, group in enumerate(words) if k != i for joint in group for word in joint}
        own = [word for word in words[i][0] if word not in elsewhere and all(word in joint for joint in words[i])]
        first = "_".join("_".join(joint) for joint in words[i][:_MOST_NAMES])
        more = f"_and_{len(joints) - _MOST_NAMES}" if len(joints) > _MOST_NAMES else ""
        names.append("_".join(own) if own and len(joints) > 1 else first + more)
    # Names without Latin letters, or that differ in signs alone, are numbered.
    return names if len({*names, ""}) > len(names) else [f"group{i + 1}" for i in range(len(names))]
