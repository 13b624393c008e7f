"""A robot on legs in C MuJoCo whose motors follow laws, for the emulator: on the floor, or on a stand. No JAX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from sim2real.emulation.body import measured_dtype
from sim2real.robots.walking.plain.hidden import HiddenTwin, hidden_spec, hide

_mj: Any = mujoco
_SETTLE_S = 3.0
"""Time in which a body comes to rest on the floor before the emulator starts [s]."""
_TOUCH_M = 0.03
"""Radius of the volume in which a foot's contacts count [m]; a foot has 0.022 m."""


class LeggedBody:
    """A robot of an MJCF file with hidden parameters; see ``sim2real.emulation.body.Body``.

    The torque of a motor is its law's, limited to the actuator's range, times the motor's strength. The motor reports
    the torque of its law, as it does not know its strength. Its encoder has a bias, for the law too.

    Args:
        mjcf: The model: one actuator for each joint with a motor, a site ``imu``, and a free joint of the base.
        feet: Sites in the middle of the feet.
        pose: Positions of the joints at the start [rad].
        height_m: Height of the base at the start [m].
        place: ``floor``, or ``stand``: the base is fixed, and the feet are in the air.
    """

    step_s = 0.001

    def __init__(
        self,
        mjcf: Path,
        feet: Sequence[str],
        pose: Sequence[float],
        height_m: float,
        hidden: HiddenTwin,
        place: Literal["floor", "stand"] = "floor",
    ) -> None:
        # The model, with what an IMU and the feet measure.
        spec = hidden_spec(mjcf, self.step_s)
        spec.option.integrator = _mj.mjtIntegrator.mjINT_IMPLICITFAST  # stable with large kd
        free = next(j for j in spec.joints if j.type == _mj.mjtJoint.mjJNT_FREE)
        base = free.parent.name
        if place == "stand":
            free.parent.pos = (0.0, 0.0, 1.0)
            spec.delete(free)
        kinds = _mj.mjtSensor
        for kind in (kinds.mjSENS_GYRO, kinds.mjSENS_ACCELEROMETER):
            spec.add_sensor(type=kind, objtype=_mj.mjtObj.mjOBJ_SITE, objname="imu")
        for name in feet:
            spec.site(name).size[0] = _TOUCH_M
            spec.add_sensor(type=kinds.mjSENS_TOUCH, objtype=_mj.mjtObj.mjOBJ_SITE, objname=name)
        model = self.model = spec.compile()
        self._base, self._imu, self.motors = model.body(base).id, model.site("imu").id, int(model.nu)
        # The hidden parameters; friction of joints as stiff as the solver allows: with the defaults they creep.
        self.hidden, self.place = hidden, place
        hide(model, self._base, hidden)
        model.dof_solref[-self.motors :] = (4 * self.step_s, 1.0)
        model.dof_solimp[-self.motors :, :3] = (0.999, 0.999, 0.001)
        model.actuator_forcerange *= np.asarray(hidden.strength)[:, None]
        self._strength, self._bias = np.asarray(hidden.strength), np.asarray(hidden.bias_rad)
        # The start: motors without torque until the first command.
        data = self.data = _mj.MjData(model)
        self._measured = np.zeros((), measured_dtype(self.motors))
        data.qpos[-self.motors :] = pose
        self.drive(np.zeros((self.motors, 5)))
        if place == "floor":
            data.qpos[:7] = (0, 0, height_m, 1, 0, 0, 0)
            for _ in range(round(_SETTLE_S / self.step_s)):
                _mj.mj_step(model, data)
        _mj.mj_forward(model, data)

    def drive(self, law: np.ndarray) -> None:
        """Set the laws of all motors ``(motors, 5)``: q, dq, kp, kd, tau."""
        q, dq, kp, kd, tau = np.asarray(law, np.float64).T
        model, strength = self.model, self._strength
        model.actuator_gainprm[:, 0] = strength * kp
        model.actuator_biasprm[:, 0] = strength * (tau + kd * dq)
        model.actuator_biasprm[:, 1], model.actuator_biasprm[:, 2] = -strength * kp, -strength * kd
        self.data.ctrl[:] = q - self._bias

    def step(self) -> None:
        """Integrate one time step."""
        _mj.mj_step(self.model, self.data)

    def measure(self) -> np.ndarray:
        """Return a measurement without noise."""
        data, measured, n = self.data, self._measured.copy(), self.motors
        measured["q"], measured["dq"] = data.qpos[-n:] + self._bias, data.qvel[-n:]
        measured["tau_est"] = data.actuator_force / self._strength
        measured["quaternion"] = data.xquat[self._base]
        measured["gyroscope"] = data.sensordata[:3]
        # MuJoCo computes no acceleration of a body without joints to the world.
        measured["accelerometer"] = data.sensordata[3:6] if self.place == "floor" else -self.model.opt.gravity
        measured["foot_force"] = data.sensordata[6:10]
        return measured

    def state(self) -> dict[str, float]:
        """Return the true state: joints, orientation, rates and velocity of the base in its axes, and its height."""
        data, n = self.data, self.motors
        turn = data.xmat[self._base].reshape(3, 3)
        moving = data.qvel[:6] if self.place == "floor" else np.zeros(6)
        fields: Mapping[str, np.ndarray] = {
            "position": data.qpos[-n:],
            "velocity": data.qvel[-n:],
            "quaternion": data.xquat[self._base],
            "gyro": moving[3:],
            "linear": turn.T @ moving[:3],
            "base": data.xpos[self._base],
        }
        return {f"{name}[{i}]": float(x) for name, values in fields.items() for i, x in enumerate(values)}

    def truth(self) -> dict[str, object]:
        """Return the hidden parameters."""
        return {name: np.asarray(value).tolist() for name, value in asdict(self.hidden).items()}
