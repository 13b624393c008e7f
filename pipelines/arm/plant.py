"""The embedded arm's physics: C MuJoCo, with parameters that no stage of the pipeline reads.

Run by the emulator's process; imports neither JAX nor the pipeline's robot, so nothing here can leak into it. The
geometry alone is the same: arm.xml.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

from mujoco import MjData, mj_kinematics, mj_step  # pyright: ignore[reportAttributeAccessIssue]

from sim2real.emulation.servo_plant import plain_model
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel.registers import PWM_FULL_SCALE, RAD_PER_COUNT

CENTRE_RAD: Final = 2048 * RAD_PER_COUNT
"""Reading of the encoder while the joint is at 0 and the arm hangs [rad]."""

NOMINAL_P_GAIN: Final = 800
"""Position P Gain that ``gain`` is given for until the host writes another."""

_STALL, _BACK_EMF, _ARMATURE, _VISCOUS, _COULOMB = 1.4, 0.22, 0.0045, 0.01, 0.03  # data sheet, at 12 V
_P_GAIN_UNIT = 256  # counts of PWM per count of error, as the recordings in pipelines/xl330 show; 128 in the e-Manual
_STRIBECK_RAD_S = 0.1


class _Firmware:
    """What one servo's firmware makes of its goal: a share of the supply voltage. Angles are the joint's [rad]."""

    def __init__(self) -> None:
        self.mode = int(OperatingMode.OFF)
        self.p_gain = NOMINAL_P_GAIN
        self.profile_rad_s = math.inf
        self._goal = 0.0
        self._reference = 0.0

    @property
    def is_on(self) -> bool:
        """Whether the winding is driven; an open winding has no back-EMF."""
        return self.mode != OperatingMode.OFF

    def command(self, mode: int, goal: float, angle: float) -> None:
        """Take a goal over; a position's reference starts from the present angle when this mode begins."""
        if mode == OperatingMode.POSITION and self.mode != mode:
            self._reference = angle
        self.mode = mode if mode in (OperatingMode.POSITION, OperatingMode.PWM) else int(OperatingMode.OFF)
        self._goal = goal - CENTRE_RAD if mode == OperatingMode.POSITION else goal

    def duty(self, angle: float, step_s: float) -> float:
        """Return the share of the supply voltage for the next step, in [-1, 1]."""
        if self.mode == OperatingMode.PWM:
            return self._goal
        if self.mode != OperatingMode.POSITION:
            return 0.0
        reach = self.profile_rad_s * step_s
        self._reference += min(max(self._goal - self._reference, -reach), reach)
        error = round(self._reference / RAD_PER_COUNT) - round(angle / RAD_PER_COUNT)
        pwm = self.p_gain / _P_GAIN_UNIT * error
        return min(max(pwm / PWM_FULL_SCALE, -1.0), 1.0)


class ArmPlant:
    """A three-joint arm of X430-like servos that hangs from a gantry; all joints are at 0 while it hangs straight.

    Servos 1, 2, 3 turn pan, shoulder and elbow. Modes 3 (position) and 16 (PWM) are emulated, any other one is torque
    off. Position D Gain is not emulated, as the pipeline sets it to 0, nor are I Gain and Profile Acceleration.

    Compared with the data sheet: a weaker motor, heavier rotors, and more friction, part of it only near standstill.

    Args:
        stall: Factor on the stall torque.
        back_emf: Factor on the torque that the back-EMF takes from the motor.
        armature: Factor on the rotors' reflected inertia.
        coulomb: Factors on dry friction: pan, shoulder, elbow.
        bump: Stribeck: by what share friction at standstill exceeds that at speed.
        step_s: MuJoCo's time step [s].
    """

    servo_ids = (1, 2, 3)

    def __init__(
        self,
        stall: float = 0.87,
        back_emf: float = 1.1,
        armature: float = 1.25,
        coulomb: tuple[float, float, float] = (1.5, 1.9, 1.2),
        bump: float = 0.2,
        carried_kg: float = 0.0,
        step_s: float = 0.0005,
    ) -> None:
        self._stall, self._back_emf, self._armature = stall * _STALL, back_emf * _BACK_EMF, armature * _ARMATURE
        self._coulomb = [factor * _COULOMB for factor in coulomb]
        self._bump, self._carried_kg = bump, carried_kg
        # The stiffest impedance of the solver: at the default, an arm that friction should hold creeps.
        self.model = plain_model(
            Path(__file__).with_name("arm.xml"), step_s, self._armature, _VISCOUS, carried_kg, "tip"
        )
        self.data = MjData(self.model)
        self._servos = [_Firmware() for _ in self.servo_ids]
        # Kept, as looking an array up in MuJoCo's structures costs as much as reading it.
        self._qpos, self._qvel, self._applied = self.data.qpos, self.data.qvel, self.data.qfrc_applied
        self._friction, self._damping = self.model.dof_frictionloss, self.model.dof_damping
        self._torques = [0.0, 0.0, 0.0]  # what drives the joints, without back-EMF [N m]

    def advance(self, t_s: float) -> None:
        """Integrate up to ``t_s`` [s]."""
        model, data, step_s = self.model, self.data, self.model.opt.timestep
        for _ in range(round((t_s - data.time) / step_s)):
            angles, speeds = self._qpos.tolist(), self._qvel.tolist()
            self._torques = [
                self._stall * servo.duty(angle, step_s) for servo, angle in zip(self._servos, angles, strict=True)
            ]
            self._applied[:] = self._torques
            self._friction[:] = [
                level * (1.0 + self._bump * math.exp(-abs(speed) / _STRIBECK_RAD_S))
                for level, speed in zip(self._coulomb, speeds, strict=True)
            ]
            mj_step(model, data)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Set a servo's goal: rad from the encoder's count 0 (position) or the share of the supply voltage (PWM)."""
        joint = self.servo_ids.index(servo_id)
        servo = self._servos[joint]
        servo.command(mode, goal, float(self._qpos[joint]))
        # The back-EMF brakes as damping does; there MuJoCo integrates it implicitly.
        self._damping[joint] = _VISCOUS + (self._back_emf if servo.is_on else 0.0)

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        """Set a servo's Position P Gain, and how fast its reference moves at most [rad/s]; inf is no limit."""
        del d_gain  # not emulated
        servo = self._servos[self.servo_ids.index(servo_id)]
        servo.p_gain, servo.profile_rad_s = p_gain, profile_velocity_rad_s

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return angle from the encoder's count 0 [rad], velocity [rad/s] and load [share of the stall torque]."""
        joint = self.servo_ids.index(servo_id)
        velocity = float(self._qvel[joint])
        braking = self._back_emf * velocity if self._servos[joint].is_on else 0.0
        return float(self._qpos[joint]) + CENTRE_RAD, velocity, (self._torques[joint] - braking) / self._stall

    def state(self) -> dict[str, float]:
        """Return the true joint angles [rad] and velocities [rad/s], and where the tip is [m]."""
        mj_kinematics(self.model, self.data)  # a step leaves the site where the step began
        rows = {"position": self._qpos, "velocity": self._qvel, "tip": self.data.site_xpos[0]}
        return {f"{name}[{i}]": value for name, row in rows.items() for i, value in enumerate(row.tolist())}

    def truth(self) -> dict[str, Any]:
        """Return what a log can determine: position gain [N m/rad], damping, armature, friction, payload, in SI units.

        The gain is servo 1's, at the P gain that it has now; friction is the level at speed, without the bump.
        """
        duty_per_rad = self._servos[0].p_gain / _P_GAIN_UNIT / RAD_PER_COUNT / PWM_FULL_SCALE
        return {
            "gain": self._stall * duty_per_rad,
            "damping": self._back_emf + _VISCOUS,
            "armature": self._armature,
            "friction_pan": self._coulomb[0],
            "friction_shoulder": self._coulomb[1],
            "friction_elbow": self._coulomb[2],
            "payload": self._carried_kg,
        }
