"""The embedded SO-101's physics: C MuJoCo, with parameters that no stage of the pipeline reads.

Run by the emulator's process; imports neither JAX nor the pipeline's robot, so nothing here can leak into it. The
geometry alone is the same: so101.xml.

The parameters are those that were identified on recordings of a real SO-101, isaac-sim2real/sage @ 4ffd2627
(Apache-2.0), by `sim2real identify so101_log`. There they are
divided by a joint's inertia, or by its servo's stiffness. In units of torque:

- Gain. Rotation's servo pushes no harder beyond 0.45 rad; taken for the 2.94 N m of its data sheet, the gain is 6.53
  N m/rad. The driver's source for the gain (BAM's oscilloscope) is 7.8.
- Rotors. The gain over the identified stiffness is a joint's inertia. What the public description has for the links in
  the recordings' pose explains it for five joints, 11 % off (rms), with 0.00266 kg m^2 more on every joint. The jaw's
  is not determined by samples 20 ms apart.
- Damping, dry friction, saturation: identified value times inertia, or gain.

The same recordings have the hand on the table from elbow 0.934 rad on; by the public description it is 0.93.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sim2real.emulation.servo_plant import ServoPlant

ZERO_COUNTS: Final = (2133, 2118, 2154, 2127, 2133, 2098)
"""Counts of the encoders while the joints are at 0, before the servos' homing offset."""
NOMINAL_P_GAIN: Final = 16
"""P gain for which the numbers below are."""
_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
_GAIN, _ARMATURE = 6.53, 0.00266
_DAMPING = (0.560, 0.534, 0.616, 0.533, 0.500, 0.434)
_FRICTION = (0.0644, 0.222, 0.302, 0.0706, 0.0654, 0.0167)
_STRIBECK_RAD_S = (0.336, 0.451, 0.334, 0.320, 0.264, 0.0534)
_SATURATION_RAD = (0.450, 0.450, 0.450, 0.450, 0.170, 0.0615)  # of those that were not identified, rotation's
_BIAS_RAD = (-0.0008, 0.0098, 0.0061, 0.0070, -0.0011, -0.0002)
_OFF_DAMPING: Final = 0.1  # assumed: what brakes an open winding [N m s/rad]


class SO101Plant(ServoPlant):
    """An SO-101 on a table: six STS3215.

    What the stages' model lacks: that the jaw's friction wears off, errors in whole counts, the stops, and the table.

    Args:
        start: Joint angles at the beginning [rad]; default: folded, as it was put away.
        gain: Factor on the servos' gain.
        friction: Factor on dry friction.
        damping: Factor on what brakes driven servos.
    """

    def __init__(
        self,
        start: Sequence[float] = (0.0, -1.74, 1.68, -1.4, 0.0, -0.8),
        step_s: float = 0.0005,
        gain: float = 1.0,
        friction: float = 1.0,
        damping: float = 1.0,
        carried_kg: float = 0.0,
    ) -> None:
        truth = {
            "gain": gain * _GAIN,
            "limit": [gain * _GAIN * most for most in _SATURATION_RAD],
            "damping": [damping * level for level in _DAMPING],
            "damping_off": _OFF_DAMPING,
            "armature": _ARMATURE,
            "friction": 0.0,
            "static": [friction * level for level in _FRICTION],
            "stribeck_rad_s": _STRIBECK_RAD_S,
            "offset_rad": _BIAS_RAD,
        }
        of_each = [f"{what}_{joint}" for what in ("damping", "friction", "goal_offset") for joint in _JOINTS]
        worn = [f"stribeck_{joint}" for joint in _JOINTS[:-1]]
        limits = ["saturation", "saturation_wrist_roll", "saturation_gripper"]
        names = ["gain", "armature", *of_each, *worn, *limits, "payload"]
        super().__init__(
            Path(__file__).with_name("so101.xml"),
            _JOINTS,
            (1, 2, 3, 4, 5, 6),
            truth,
            NOMINAL_P_GAIN,
            names,
            zero_counts=ZERO_COUNTS,
            start=start,
            carried_kg=carried_kg,
            contact=True,
            step_s=step_s,
        )
