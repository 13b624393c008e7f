"""The motion of a person who follows the instructions of `sim2real new --like so101`, for the embedded arm's hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sim2real.stages.load import load_module

NUDGES, JOINTS = load_module("so101", "guide").NUDGES, load_module("so101", "robot").JOINTS
STOPS_RAD = (1.92, 1.745, 1.69, 1.658, 2.7, 0.96)
"""Half of the travel of the embedded arm's joints [rad]."""
_START, _NUDGE_RAD, _PUSH_RAD = (0.0, -1.74, 1.68, -1.4, 0.0, -0.8), 0.45, 0.15


class GuidedArm(load_module("so101", "plant").SO101Plant):
    """An arm whose joints a hand pulls while their motors are off: a spring with a damper, to a motion in a file (npz).

    The file has ``t_s`` ``(N,)`` [s] and ``position`` ``(N, joints)`` [rad].
    """

    def __init__(self, hand, **settings):
        self.hand = dict(np.load(hand))
        super().__init__(**settings)

    def forces(self, angles, speeds):
        torques = list(super().forces(angles, speeds))
        for i in (i for i in range(len(torques)) if not self._is_on(i)):
            there = float(np.interp(self.data.time, self.hand["t_s"], self.hand["position"][:, i]))
            torques[i] += np.clip(12.0 * (there - angles[i]) - 0.5 * speeds[i], -4.0, 4.0)
        return torques


def write_motion(path: Path, begin_s: float = 3.0, speed_rad_s: float = 1.5) -> float:
    """Write the motion for a `GuidedArm`; return its end [s].

    From where it was put away the arm is lifted to its middle pose, each joint is nudged, then moved to both stops.

    Args:
        begin_s: When the arm reaches its middle pose [s after the start of the emulated arm].
        speed_rad_s: Speed of the joints [rad/s].
    """
    pose, t_s = np.array(_START), 0.0
    times, poses = [t_s], [pose.copy()]

    def go(target: np.ndarray, rest_s: float, least_s: float = 0.0) -> None:
        nonlocal pose, t_s
        t_s += max(np.abs(target - pose).max() / speed_rad_s, least_s, 1e-3)
        pose = target.copy()
        times.append(t_s)
        poses.append(pose)
        t_s += rest_s
        times.append(t_s)
        poses.append(pose)

    def turned(joint: str, angle: float) -> np.ndarray:
        target = pose.copy()
        target[JOINTS.index(joint)] = angle
        return target

    go(pose, 0.0, max(0.0, begin_s - np.abs(pose).max() / speed_rad_s))
    go(np.zeros(6), 4.0)
    for nudge in NUDGES:
        go(turned(nudge.joint, nudge.direction * _NUDGE_RAD), 0.1)
        go(turned(nudge.joint, 0.0), 1.2)
    # The hand stays above the table: the upper arm leans back for the elbow, and forward with a stretched forearm.
    stops = {name: stop + _PUSH_RAD for name, stop in zip(JOINTS, STOPS_RAD, strict=True)}
    for joint in ("gripper", "shoulder_pan", "wrist_flex", "elbow_flex"):
        if joint == "elbow_flex":
            go(turned("shoulder_lift", -1.2), 0.1)
        for angle in (stops[joint], -stops[joint]):
            go(turned(joint, angle), 0.2)
        go(turned(joint, 0.0), 0.1)
    go(turned("elbow_flex", -1.6), 0.1)
    for angle in (stops["shoulder_lift"], -stops["shoulder_lift"]):
        go(turned("shoulder_lift", angle), 0.3)
    go(np.array([0.0, -1.6, 1.5, -1.4, 0.0, -0.6]), 0.0)
    np.savez(path, t_s=np.array(times), position=np.array(poses))
    return t_s
