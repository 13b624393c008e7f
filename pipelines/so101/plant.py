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

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
from mujoco import MjData, mj_kinematics, mj_step  # pyright: ignore[reportAttributeAccessIssue]

from sim2real.emulation.servo_plant import plain_model
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.feetech.registers import RAD_PER_COUNT

ZERO_COUNTS: Final = (2133, 2118, 2154, 2127, 2133, 2098)
"""Counts of the encoders while the joints are at 0, before the servos' homing offset."""
NOMINAL_P_GAIN: Final = 16
"""P gain for which the numbers below are."""

_GAIN, _ARMATURE = 6.53, 0.00266
_DAMPING = (0.560, 0.534, 0.616, 0.533, 0.500, 0.434)
_FRICTION = (0.0644, 0.222, 0.302, 0.0706, 0.0654, 0.0167)
_STRIBECK_RAD_S = (0.336, 0.451, 0.334, 0.320, 0.264, 0.0534)
_SATURATION_RAD = (0.450, 0.450, 0.450, 0.450, 0.170, 0.0615)  # of those that were not identified, rotation's
_BIAS_RAD = (-0.0008, 0.0098, 0.0061, 0.0070, -0.0011, -0.0002)
_OFF_DAMPING: Final = 0.1  # assumed: what brakes an open winding [N m s/rad]
_HAND_NM_RAD, _HAND_DAMPING, _HAND_MOST_NM = 12.0, 0.5, 4.0  # assumed: a person's hand [N m/rad, N m s/rad, N m]


class SO101Plant:
    """An SO-101 on a table: six STS3215 in position mode; any other mode is torque off.

    What the stages' model lacks: that the jaw's friction wears off, errors in whole counts, the stops, and the table.

    Args:
        start: Joint angles at the beginning [rad]; default: folded, as it was put away.
        step_s: MuJoCo's time step [s].
        gain: Factor on the servos' gain.
        friction: Factor on dry friction.
        carried_kg: Mass between the jaws [kg].
        hand: File (npz) of a person's motion, ``t_s`` ``(N,)`` [s] and ``position`` ``(N, 6)`` [rad]: a hand pulls each
            joint without torque towards it, as a spring with a damper; None: there is no hand.
    """

    servo_ids = (1, 2, 3, 4, 5, 6)

    def __init__(
        self,
        start: tuple[float, ...] = (0.0, -1.74, 1.68, -1.4, 0.0, -0.8),
        step_s: float = 0.0005,
        gain: float = 1.0,
        friction: float = 1.0,
        carried_kg: float = 0.0,
        hand: str | None = None,
    ) -> None:
        self._hand = None if hand is None else dict(np.load(hand))
        # Friction with the stiffest impedance of the solver: at the default, a joint that should stick creeps.
        self._carried_kg = carried_kg
        self._gain, self._levels = gain * _GAIN, [friction * level for level in _FRICTION]
        mjcf = Path(__file__).with_name("so101.xml")
        self.model = plain_model(mjcf, step_s, _ARMATURE, _OFF_DAMPING, carried_kg, "tip")
        self.data = MjData(self.model)
        self.data.qpos[:] = start
        n = len(self.servo_ids)
        self._p_gain = [float(NOMINAL_P_GAIN)] * n
        self._goals: list[float | None] = [None] * n
        self._zero_rad = [count * RAD_PER_COUNT for count in ZERO_COUNTS]
        # Kept, as looking an array up in MuJoCo's structures costs as much as reading it.
        self._qpos, self._qvel, self._applied = self.data.qpos, self.data.qvel, self.data.qfrc_applied
        self._friction, self._damping = self.model.dof_frictionloss, self.model.dof_damping
        self._torques = [0.0] * n

    def advance(self, t_s: float) -> None:
        """Integrate up to ``t_s`` [s]."""
        model, data = self.model, self.data
        for _ in range(round((t_s - data.time) / model.opt.timestep)):
            angles, speeds = self._qpos.tolist(), self._qvel.tolist()
            self._torques = [self._torque(i, angle) for i, angle in enumerate(angles)]
            self._applied[:] = self._torques if self._hand is None else self._with_hand(angles, speeds)
            self._friction[:] = [
                level * math.exp(-abs(speed) / width)
                for level, speed, width in zip(self._levels, speeds, _STRIBECK_RAD_S, strict=True)
            ]
            mj_step(model, data)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Set a servo's goal: rad from the encoder's count 0."""
        joint = self.servo_ids.index(servo_id)
        self._goals[joint] = goal - self._zero_rad[joint] if mode == OperatingMode.POSITION else None
        # The back-EMF brakes as damping does; there MuJoCo integrates it implicitly.
        self._damping[joint] = _OFF_DAMPING if self._goals[joint] is None else _DAMPING[joint]

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's P gain.

        Args:
            p_gain: P gain [counts].
            d_gain: Not emulated; what the register's default does is part of the damping.
            profile_velocity_rad_s: Not emulated here; the emulator moves the goals.
        """
        del d_gain, profile_velocity_rad_s
        self._p_gain[self.servo_ids.index(servo_id)] = float(p_gain)

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return angle from the encoder's count 0 [rad], velocity [rad/s] and load [share of the stall torque]."""
        joint = self.servo_ids.index(servo_id)
        load = self._torques[joint] / (self._gain * _SATURATION_RAD[0])
        return float(self._qpos[joint]) + self._zero_rad[joint], float(self._qvel[joint]), load

    def state(self) -> dict[str, float]:
        """Return the true joint angles [rad] and velocities [rad/s], and where the tip is [m]."""
        mj_kinematics(self.model, self.data)  # a step leaves the site where the step began
        rows = {"position": self._qpos, "velocity": self._qvel, "tip": self.data.site_xpos[0]}
        return {f"{name}[{i}]": value for name, row in rows.items() for i, value in enumerate(row.tolist())}

    def truth(self) -> dict[str, Any]:
        """Return what a log can determine, named as the stages do; friction at standstill."""
        joints = [self.model.joint(i).name for i in range(self.model.njnt)]
        return {
            "gain": self._gain,
            "armature": _ARMATURE,
            **{f"damping_{j}": d for j, d in zip(joints, _DAMPING, strict=True)},
            **{f"friction_{j}": f for j, f in zip(joints, self._levels, strict=True)},
            **{f"stribeck_{j}": s for j, s in zip(joints[:-1], _STRIBECK_RAD_S, strict=False)},
            **{f"goal_offset_{j}": b for j, b in zip(joints, _BIAS_RAD, strict=True)},
            "saturation": _SATURATION_RAD[0],
            **{f"saturation_{j}": _SATURATION_RAD[joints.index(j)] for j in ("wrist_roll", "gripper")},
            "payload": self._carried_kg,
        }

    def _with_hand(self, angles: list[float], speeds: list[float]) -> list[float]:
        """Return the torques on the joints: of the motors, and of the hand on joints without a motor's torque [N m]."""
        hand, torques = self._hand or {}, list(self._torques)
        for i, goal in enumerate(self._goals):
            if goal is None:
                there = float(np.interp(self.data.time, hand["t_s"], hand["position"][:, i]))
                pull = _HAND_NM_RAD * (there - angles[i]) - _HAND_DAMPING * speeds[i]
                torques[i] += min(max(pull, -_HAND_MOST_NM), _HAND_MOST_NM)
        return torques

    def _torque(self, joint: int, angle: float) -> float:
        """Return what the motor's duty makes of the error, without back-EMF [N m]."""
        goal = self._goals[joint]
        if goal is None:
            return 0.0
        share, most = self._p_gain[joint] / NOMINAL_P_GAIN, _SATURATION_RAD[joint]
        error = (round(goal / RAD_PER_COUNT) - round(angle / RAD_PER_COUNT)) * RAD_PER_COUNT + _BIAS_RAD[joint]
        return self._gain * min(max(share * error, -most), most)
