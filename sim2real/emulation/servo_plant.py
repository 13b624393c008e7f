"""Position servos on the joints of an MJCF, with hidden parameters: the physics of emulated arms, and of twins."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sim2real.errors import UsageError
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import RAD_PER_COUNT

mj: Any = mujoco
Each = float | Sequence[float]
"""A number for all joints, or one for each."""


@dataclass(frozen=True)
class ServoTruth:
    """The hidden parameters of servos, at their joints.

    Attributes:
        gain: Torque per error of position, at the P gain ``p_gain`` of the plant [N m/rad].
        limit: Torque at full duty [N m].
        damping: Back-EMF and viscous friction, while the winding is driven [N m s/rad].
        damping_off: Damping with torque off: an open winding has no back-EMF [N m s/rad].
        armature: Inertia of the rotor behind the gears [kg m^2].
        friction: Dry friction at speed [N m].
        static: Additional friction at standstill [N m].
        stribeck_rad_s: Speed at which 1/e of ``static`` is left [rad/s].
        offset_rad: Constant that is added to the error of position [rad].
    """

    gain: Each
    limit: Each
    damping: Each
    damping_off: Each
    armature: Each
    friction: Each
    static: Each = 0.0
    stribeck_rad_s: Each = 0.1
    offset_rad: Each = 0.0


class ServoPlant:
    """Servos in position or PWM mode; in other modes torque is off. See ``sim2real.emulation.plant.Plant``.

    The firmware moves its setpoint to the goal with limited speed, and computes the error in whole counts. D and I
    gains are not emulated.

    Args:
        mjcf: The model: its path, or its text.
        joints: Names of the joints, in the order of the servos.
        truth: Fields of ``ServoTruth``.
        p_gain: Position P Gain to which ``gain`` refers [counts].
        names: Parameters that ``truth`` returns, such as ``gain`` or ``friction_JOINT``.
        zero_counts: Counts of the encoders while the joints are at 0; default: the centre of their range.
        gears: Turns of each servo for one turn of its joint; default: 1. ``MountedPlant`` converts the angles.
        start: Joint angles at the beginning [rad]; default: 0.
        carried_kg: Mass at the site ``tip`` [kg].
        contact: Whether bodies touch.
        step_s: MuJoCo's time step [s].

    Raises:
        UsageError: The model lacks a joint.
    """

    def __init__(
        self,
        mjcf: str | Path,
        joints: Sequence[str],
        servo_ids: Sequence[int],
        truth: Mapping[str, Any],
        p_gain: int,
        names: Sequence[str] = (),
        *,
        zero_counts: Sequence[float] = (),
        gears: Sequence[float] = (),
        start: Sequence[float] = (),
        carried_kg: float = 0.0,
        contact: bool = False,
        step_s: float = 0.0005,
    ) -> None:
        self.joints, self.servo_ids, self._names, self._carried_kg = tuple(joints), tuple(servo_ids), names, carried_kg
        self._nominal, n, t = p_gain, len(self.joints), ServoTruth(**truth)
        own = {f: (np.zeros(n) + getattr(t, f)).tolist() for f in ServoTruth.__dataclass_fields__}
        self._gain, self._limit, self._on, self._off = (own[f] for f in ("gain", "limit", "damping", "damping_off"))
        self._at_speed, self._static, self._widths = own["friction"], own["static"], own["stribeck_rad_s"]
        self._offset, self._armature = own["offset_rad"], own["armature"]
        self._gears = tuple(gears) or (1.0,) * n
        self._count_rad = [RAD_PER_COUNT / gear for gear in self._gears]
        self._zero_rad = [count * RAD_PER_COUNT for count in zero_counts or (2048,) * n]
        self.model = self._compiled(mjcf, step_s, contact)
        self.data = mj.MjData(self.model)
        places = [self.model.joint(name) for name in self.joints]
        self._at, self._dofs = [int(p.qposadr[0]) for p in places], [int(p.dofadr[0]) for p in places]
        self.data.qpos[self._at] = start or 0.0
        mj.mj_forward(self.model, self.data)
        self._p_gain, self._profile = [float(p_gain)] * n, [math.inf] * n
        self._mode, self._goal, self._reference = [int(OperatingMode.OFF)] * n, [0.0] * n, [0.0] * n
        self._torques = [0.0] * n
        # Keep the arrays: looking one up in MuJoCo's structures takes as long as reading it.
        self._qpos, self._qvel, self._applied = self.data.qpos, self.data.qvel, self.data.qfrc_applied
        self._friction, self._damping = self.model.dof_frictionloss, self.model.dof_damping

    def advance(self, t_s: float) -> None:
        model, data, step_s = self.model, self.data, self.model.opt.timestep
        for _ in range(round((t_s - data.time) / step_s)):
            angles, speeds = self._qpos[self._at].tolist(), self._qvel[self._dofs].tolist()
            self._torques = [self._torque(i, angle, step_s) for i, angle in enumerate(angles)]
            self._applied[self._dofs] = self.forces(angles, speeds)
            self._friction[self._dofs] = [
                level + more * math.exp(-abs(speed) / width)
                for level, more, speed, width in zip(self._at_speed, self._static, speeds, self._widths, strict=True)
            ]
            mj.mj_step(model, data)

    def forces(self, angles: list[float], speeds: list[float]) -> list[float]:
        """Return the torques on the joints at angles and speeds [N m]; default: the motors' torques."""
        del angles, speeds
        return self._torques

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Set a servo's goal: rad from the encoder's count 0 (position), or the share of the supply voltage (PWM)."""
        i, position = self.servo_ids.index(servo_id), int(OperatingMode.POSITION)
        # The setpoint starts from the present angle when position mode begins.
        if mode == position and self._mode[i] != mode:
            self._reference[i] = float(self._qpos[self._at[i]])
        known = (position, int(OperatingMode.PWM))
        self._mode[i] = int(mode) if mode in known else int(OperatingMode.OFF)
        self._goal[i] = goal - self._zero_rad[i] if mode == position else goal
        # The back-EMF acts as damping, which MuJoCo integrates implicitly.
        self._damping[self._dofs[i]] = (self._on if self._is_on(i) else self._off)[i]

    def configure(self, servo_id: int, p_gain: int, d_gain: int, profile_velocity_rad_s: float) -> None:
        i = self.servo_ids.index(servo_id)
        self._p_gain[i], self._profile[i] = float(p_gain), profile_velocity_rad_s

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return angle from the encoder's count 0 [rad], velocity [rad/s] and load [share of the stall torque]."""
        i = self.servo_ids.index(servo_id)
        velocity = float(self._qvel[self._dofs[i]])
        braking = (self._on[i] - self._off[i]) * velocity if self._is_on(i) else 0.0
        load = (self._torques[i] - braking) / max(self._limit)
        return float(self._qpos[self._at[i]]) + self._zero_rad[i], velocity, load

    def state(self) -> dict[str, float]:
        """Return the true joint angles [rad] and velocities [rad/s], and the position of a site ``tip`` [m]."""
        rows = {"position": self._qpos[self._at], "velocity": self._qvel[self._dofs]}
        if mj.mj_name2id(self.model, mj.mjtObj.mjOBJ_SITE, "tip") >= 0:
            mj.mj_kinematics(self.model, self.data)  # after a step, positions of sites are those before it
            rows["tip"] = self.data.site("tip").xpos
        return {f"{name}[{i}]": value for name, row in rows.items() for i, value in enumerate(row.tolist())}

    def truth(self) -> dict[str, Any]:
        """Return the true parameters at the servos' shafts, with the names of ``sim2real.robots.servo.model``.

        The gain refers to ``p_gain``. Friction is the value at standstill if it decreases with speed in the robot's
        model, otherwise the value at speed.
        """
        worn = any(name.startswith("stribeck") for name in self._names)
        friction = [f + s if worn else f for f, s in zip(self._at_speed, self._static, strict=True)]
        gears = list(zip(self._gears, range(len(self.joints)), strict=True))
        of_each = {
            "gain": [self._gain[i] / g**2 for g, i in gears],
            "damping": [self._on[i] / g**2 for g, i in gears],
            "armature": [self._armature[i] / g**2 for g, i in gears],
            "friction": [friction[i] / g for g, i in gears],
            "stribeck": [self._widths[i] * g for g, i in gears],
            "goal_offset": [self._offset[i] * g for g, i in gears],
            "saturation": [self._limit[i] / self._gain[i] * g for g, i in gears],
            "payload": [self._carried_kg],
        }
        labels = {name: values[0] for name, values in of_each.items()}
        for quantity, values in of_each.items():
            labels |= {f"{quantity}_{joint}": value for joint, value in zip(self.joints, values, strict=False)}
        return {name: labels[name] for name in self._names}

    def _is_on(self, i: int) -> bool:
        return self._mode[i] != OperatingMode.OFF

    def _torque(self, i: int, angle: float, step_s: float) -> float:
        """Return the motor's torque for goal and angle, without back-EMF [N m]."""
        if self._mode[i] == OperatingMode.PWM:
            return self._limit[i] * self._goal[i]
        if not self._is_on(i):
            return 0.0
        reach, count_rad = self._profile[i] * step_s, self._count_rad[i]
        self._reference[i] += min(max(self._goal[i] - self._reference[i], -reach), reach)
        error = (round(self._reference[i] / count_rad) - round(angle / count_rad)) * count_rad + self._offset[i]
        torque = self._gain[i] * self._p_gain[i] / self._nominal * error
        return min(max(torque, -self._limit[i]), self._limit[i])

    def _compiled(self, mjcf: str | Path, step_s: float, contact: bool) -> Any:
        """Return the model: friction constraints as stiff as the solver allows; with the defaults, joints creep."""
        text = str(mjcf)
        spec = mj.MjSpec.from_string(text) if text.lstrip().startswith("<") else mj.MjSpec.from_file(text)
        there = [joint.name for joint in spec.joints]
        if missing := [name for name in self.joints if name not in there]:
            raise UsageError(f"the plant's model has no joint {missing[0]!r}. Available: {', '.join(there)}")
        spec.option.timestep, spec.option.integrator = step_s, mj.mjtIntegrator.mjINT_IMPLICITFAST
        if not contact:
            spec.option.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONTACT)
        for actuator in spec.actuators:
            spec.delete(actuator)
        if self._carried_kg:
            tip = spec.site("tip")
            body = tip.parent.add_body(name="carried", pos=tip.pos)
            body.explicitinertial, body.ipos, body.mass, body.inertia = True, [0.0] * 3, self._carried_kg, [1e-8] * 3
        # Set rotors before compiling: MuJoCo derives the stiffness of stops and friction from them.
        for i, name in enumerate(self.joints):
            joint = spec.joint(name)
            joint.armature, joint.damping = self._armature[i], [self._off[i], 0.0, 0.0]
            joint.frictionloss = self._at_speed[i] + self._static[i]
            joint.solref_friction, joint.solimp_friction[:3] = [4 * step_s, 1.0], [0.999, 0.999, 0.001]
        return spec.compile()
