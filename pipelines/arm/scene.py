"""The arm in 3-D: it hangs from a gantry over a table; all joints are at 0 while it hangs straight, as in the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

_PAN_AT_M, _SHOULDER_AT_M, _LINK_M = (0.0, 0.0, 0.40), (0.04, 0.0, -0.03), 0.12
_UP, _FORWARD = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)
_JOINTS = (
    ("pan", _PAN_AT_M, _UP),
    ("pan/upper", _SHOULDER_AT_M, _FORWARD),
    ("pan/upper/fore", (0.0, 0.0, -_LINK_M), _FORWARD),
)
"""Each body below the one before it: entity, where its joint is in that one [m], and the joint's axis."""

_Box = tuple[tuple[float, float, float], tuple[float, float, float], str]
_BOXES: Mapping[str, list[_Box]] = {
    "pan": [
        ((0.0, 0.0, -0.006), (0.022, 0.022, 0.006), "bracket"),
        ((0.026, 0.0, -0.015), (0.026, 0.015, 0.003), "bracket"),
        ((0.04, 0.0, -0.035), (0.0125, 0.017, 0.017), "servo"),
    ],
    "pan/upper": [
        ((0.0, 0.0225, -0.048), (0.009, 0.002, 0.060), "link"),
        ((0.0, -0.0225, -0.048), (0.009, 0.002, 0.060), "link"),
        ((0.0, 0.0, -0.105), (0.0125, 0.017, 0.023), "servo"),
    ],
    "pan/upper/fore": [
        ((0.0, 0.0270, -0.030), (0.008, 0.002, 0.040), "link"),
        ((0.0, -0.0270, -0.030), (0.008, 0.002, 0.040), "link"),
        ((0.0, 0.0, -0.066), (0.008, 0.0290, 0.004), "link"),
        ((0.0, 0.0, -0.090), (0.005, 0.005, 0.022), "link"),
    ],
}
"""What each body is made of: centre [m], half size [m], kind."""

_GANTRY: list[_Box] = [
    ((0.0, 0.142, 0.4405), (0.022, 0.170, 0.006), "stand"),
    ((0.0, 0.300, 0.217), (0.014, 0.012, 0.2175), "stand"),
    ((0.0, 0.300, 0.004), (0.060, 0.045, 0.004), "stand"),
    ((0.10, 0.19, -0.004), (0.23, 0.22, 0.004), "table"),
    ((0.0, 0.0, 0.4175), (0.0125, 0.023, 0.017), "servo"),
]
"""Its mast is beyond the arm's reach, on the far side of the viewer's first view."""

_SOLID = {
    "servo": (84, 94, 108), "bracket": (150, 162, 176), "link": (214, 220, 228), "stand": (120, 132, 146),
    "table": (92, 100, 110),
}  # fmt: skip
_GHOST, _TIP, _TARGET = (66, 150, 230), (214, 84, 48), (36, 176, 118)
_TIP_RADIUS_M, _TARGET_RADIUS_M, _AXLE_RADIUS_M = 0.008, 0.012, 0.0095
_AXLES_M = {"pan/upper": 0.052, "pan/upper/fore": 0.062}


def log_scene(rec: Any, t_s: np.ndarray, columns: Mapping[str, np.ndarray], entity: str, ghost: bool = False) -> None:
    """Draw the arm over time.

    Args:
        rec: The ``rerun.RecordingStream``.
        t_s: Times ``(N,)`` [s].
        columns: Fields ``(N,)``; ``position[0]`` to ``position[2]`` [rad] are needed. Where there are ``aim[0]`` to
            ``aim[2]`` ``(M,)`` [m], a sphere marks the last one.
        ghost: Whether this is a model's motion: a wire frame around the robot, to compare both.
    """
    import rerun as rr  # the viewer is an extra

    rec.log(entity, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if not ghost:
        rec.log(f"{entity}/gantry", _boxes(_GANTRY, ghost), static=True)
        for body, length_m in _AXLES_M.items():
            axle = rr.Cylinders3D(
                radii=[_AXLE_RADIUS_M],
                lengths=[length_m],
                rotation_axis_angles=[rr.RotationAxisAngle((1.0, 0.0, 0.0), degrees=90.0)],
                colors=[_SOLID["bracket"]],
                fill_mode="solid",
            )
            rec.log(f"{entity}/{body}/axle", axle, static=True)
    for body, boxes in _BOXES.items():
        rec.log(f"{entity}/{body}/body", _boxes(boxes, ghost), static=True)
    fill = "majorwireframe" if ghost else "solid"
    tip = rr.Ellipsoids3D(
        radii=[_TIP_RADIUS_M], centers=[(0.0, 0.0, -_LINK_M)], colors=[_GHOST if ghost else _TIP], fill_mode=fill
    )
    rec.log(f"{entity}/pan/upper/fore/tip", tip, static=True)
    if all(f"aim[{i}]" in columns for i in range(3)) and len(columns["aim[0]"]):
        centre = [float(columns[f"aim[{i}]"][-1]) for i in range(3)]
        target = rr.Ellipsoids3D(radii=[_TARGET_RADIUS_M], centers=[centre], colors=[_TARGET], fill_mode=fill)
        rec.log(f"{entity}/target", target, static=True)
    time = rr.TimeColumn("time", duration=t_s)
    for joint, (body, origin, axis) in enumerate(_JOINTS):
        half = np.asarray(columns[f"position[{joint}]"], np.float64)[:, None] / 2
        turned = np.concatenate([np.sin(half) * np.asarray(axis), np.cos(half)], axis=1)
        moved = rr.Transform3D.columns(translation=np.tile(origin, (len(half), 1)), quaternion=turned)
        rec.send_columns(f"{entity}/{body}", [time], moved)


def _boxes(boxes: list[_Box], ghost: bool) -> Any:
    """Return the boxes to log; a ghost's are a little larger, so that both show where they agree."""
    import rerun as rr

    centres, sizes, kinds = zip(*boxes, strict=True)
    return rr.Boxes3D(
        centers=centres,
        half_sizes=np.asarray(sizes) + (0.001 if ghost else 0.0),
        colors=[_GHOST if ghost else _SOLID[kind] for kind in kinds],
        fill_mode="majorwireframe" if ghost else "solid",
    )
