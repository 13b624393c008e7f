"""The embedded arm's physics: servos in C MuJoCo, with numbers that no stage of the pipeline reads.

Run by the emulator's process; imports neither JAX nor the pipeline's robot, so nothing here can leak into it. The
geometry alone is the same: arm.xml.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from sim2real.emulation.servo_plant import ServoPlant

NOMINAL_P_GAIN: Final = 800
"""Position P Gain that the gain is given for until the host writes another."""
_STALL, _BACK_EMF, _ARMATURE, _VISCOUS, _COULOMB = 1.4, 0.22, 0.0045, 0.01, 0.03  # data sheet, at 12 V
_DUTY_PER_RAD = NOMINAL_P_GAIN / 256 / (2.0 * math.pi / 4096) / 885
"""At this gain. Counts of PWM per count of error are P Gain / 256, as the recordings in pipelines/xl330 show; the
e-Manual says 128. 885 counts are the whole supply."""
_JOINTS = ("pan", "shoulder", "elbow")


class ArmPlant(ServoPlant):
    """A three-joint arm of X430-like servos that hangs from a gantry; all joints are at 0 while it hangs straight.

    Compared with the data sheet: a weaker motor, heavier rotors, and more friction, part of it only near standstill.

    Args:
        stall: Factor on the stall torque.
        back_emf: Factor on the torque that the back-EMF takes from the motor.
        armature: Factor on the rotors' reflected inertia.
        coulomb: Factors on dry friction: pan, shoulder, elbow.
        bump: Stribeck: by what share friction at standstill exceeds that at speed.
    """

    def __init__(
        self,
        stall: float = 0.87,
        back_emf: float = 1.1,
        armature: float = 1.25,
        coulomb: Sequence[float] = (1.5, 1.9, 1.2),
        bump: float = 0.2,
        carried_kg: float = 0.0,
        step_s: float = 0.0005,
    ) -> None:
        friction = [factor * _COULOMB for factor in coulomb]
        truth = {
            "gain": stall * _STALL * _DUTY_PER_RAD,
            "limit": stall * _STALL,
            "damping": back_emf * _BACK_EMF + _VISCOUS,
            "damping_off": _VISCOUS,
            "armature": armature * _ARMATURE,
            "friction": friction,
            "static": [bump * level for level in friction],
        }
        names = ("gain", "damping", "armature", *(f"friction_{joint}" for joint in _JOINTS), "payload")
        mjcf = Path(__file__).with_name("arm.xml")
        super().__init__(mjcf, _JOINTS, (1, 2, 3), truth, NOMINAL_P_GAIN, names, carried_kg=carried_kg, step_s=step_s)
