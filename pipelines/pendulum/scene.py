"""The pendulum in 3-D: a disk with its mass and a pointer, turned by ``th``; 0 is upright, as in the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

_RADIUS_M, _THICKNESS_M = 0.055, 0.012
_MASS_AT_M, _MASS_RADIUS_M = 0.0415, 0.009
_SOLID = {"disk": (150, 162, 176), "mass": (214, 84, 48), "pointer": (240, 244, 248), "stand": (92, 104, 117)}
_GHOST = (66, 150, 230)


def log_scene(rec: Any, t_s: np.ndarray, columns: Mapping[str, np.ndarray], entity: str, ghost: bool = False) -> None:
    """Draw the pendulum over time.

    Args:
        rec: The ``rerun.RecordingStream``.
        t_s: Times ``(N,)`` [s].
        columns: Fields ``(N,)``; ``th`` [rad] is needed.
        ghost: Whether this is a model's motion: a wire frame a little in front of the robot, to compare both.
    """
    import rerun as rr  # the viewer is an extra

    fill = "majorwireframe" if ghost else "solid"
    front = -_THICKNESS_M * (1.2 if ghost else 0.5)
    color = {name: _GHOST if ghost else shade for name, shade in _SOLID.items()}
    # The axis of rotation is y, towards the back; the camera is in front, gravity points down.
    flat = rr.RotationAxisAngle((1.0, 0.0, 0.0), degrees=90.0)
    rec.log(entity, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if not ghost:
        disk = rr.Cylinders3D(
            radii=[_RADIUS_M],
            lengths=[_THICKNESS_M],
            rotation_axis_angles=[flat],
            colors=[color["disk"]],
            fill_mode="solid",
        )
        rec.log(f"{entity}/turning/disk", disk, static=True)
        size = [(0.008, 0.02, 0.075), (0.06, 0.04, 0.004)]
        stand = rr.Boxes3D(
            half_sizes=size,
            centers=[(0.0, 0.035, -0.06), (0.0, 0.02, -0.135)],
            colors=[color["stand"]],
            fill_mode="solid",
        )
        rec.log(f"{entity}/stand", stand, static=True)
    mass = rr.Ellipsoids3D(
        radii=[_MASS_RADIUS_M], centers=[(0.0, front, _MASS_AT_M)], colors=[color["mass"]], fill_mode=fill
    )
    rec.log(f"{entity}/turning/mass", mass, static=True)
    pointer = rr.LineStrips3D(
        [[(0.0, front, 0.0), (0.0, front, _RADIUS_M * 1.25)]], radii=[0.0016], colors=[color["pointer"]]
    )
    rec.log(f"{entity}/turning/pointer", pointer, static=True)
    half = np.asarray(columns["th"], np.float64) / 2
    zero = np.zeros_like(half)
    turned = np.stack([zero, np.sin(half), zero, np.cos(half)], axis=1)
    time = rr.TimeColumn("time", duration=t_s)
    rec.send_columns(f"{entity}/turning", [time], rr.Transform3D.columns(quaternion=turned))
