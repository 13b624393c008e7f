"""The embedded robot's physics: C MuJoCo, with parameters that no stage of the pipeline reads.

Run by the emulator's process; imports neither JAX nor the pipeline's model, so nothing here can leak into it.
"""

from __future__ import annotations

import math
from typing import Any

SUPPLY_V = 5.0
"""Voltage of the motor at full PWM [V]."""

_J, _MASS, _LENGTH = 0.000159931461600856, 0.0508581731919534, 0.0415233722862552
_B, _K, _R, _C = 1.43298488358436e-05, 0.0333391179016334, 7.73125142447252, 0.000975041213361349
_PWM_MODE = 16

_MODEL = """
<mujoco model="disk pendulum">
  <option timestep="{step_s}" gravity="0 0 -9.81" integrator="implicitfast"/>
  <worldbody>
    <body name="disk">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}" frictionloss="{friction}"
             solreffriction="{time_constant} 1"/>
      <inertial pos="0 0 {length}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge"/></actuator>
</mujoco>
"""


class PendulumPlant:
    """A disk pendulum on a DC motor. Angle 0 is upright and is the encoder's zero; it starts hanging, at pi.

    Against the data sheet: friction 1.6 times, inertia +15 %, motor constant -10 %.

    Args:
        friction: Factor on both kinds of friction.
        inertia: Factor on the moment of inertia.
        motor: Factor on the motor constant.
        step_s: MuJoCo's time step [s]. Its integrator is of first order, and forces act half a step early: with 0.5 ms
            an identification finds the round trip 0.25 ms too short, and gravity 0.1 % too small.
    """

    servo_ids = (1,)

    def __init__(
        self, friction: float = 1.6, inertia: float = 1.15, motor: float = 0.9, step_s: float = 0.0001
    ) -> None:
        # Not above: the robot's own module takes the supply's voltage from here, and need not wait for MuJoCo.
        from mujoco import MjData, MjModel, mj_forward, mj_step  # pyright: ignore[reportAttributeAccessIssue]

        self._J, self._K = inertia * _J, motor * _K
        self._b, self._c = friction * _B, friction * _C
        text = _MODEL.format(
            step_s=step_s,
            damping=self._b,
            friction=self._c,
            time_constant=4 * step_s,  # the stiffest of the solver: friction, not viscous creep
            length=_LENGTH,
            mass=_MASS,
            inertia=self._J - _MASS * _LENGTH**2,
        )
        self.model = MjModel.from_xml_string(text)
        self.data = MjData(self.model)
        self.data.qpos[0] = math.pi
        self._voltage: float | None = None  # None: the driver is off and the winding open
        mj_forward(self.model, self.data)
        self._step = mj_step

    def advance(self, t_s: float) -> None:
        """Integrate up to ``t_s`` [s]."""
        data, step_s = self.data, self.model.opt.timestep
        for _ in range(round((t_s - data.time) / step_s)):
            data.ctrl[0] = 0.0 if self._voltage is None else self._torque_nm(self._voltage)
            self._step(self.model, data)

    def command(self, servo_id: int, mode: int, goal: float) -> None:
        """Set the voltage: ``goal`` is its share of the supply; with torque off the winding is open."""
        del servo_id
        self._voltage = goal * SUPPLY_V if mode == _PWM_MODE else None

    def measure(self, servo_id: int) -> tuple[float, float, float]:
        """Return angle [rad], velocity [rad/s] and load [share of the stall torque]."""
        del servo_id
        stall_nm = self._K * SUPPLY_V / _R
        return float(self.data.qpos[0]), float(self.data.qvel[0]), float(self.data.ctrl[0]) / stall_nm

    def state(self) -> dict[str, float]:
        """Return the true angle [rad], velocity [rad/s] and voltage [V]."""
        return {"th": float(self.data.qpos[0]), "thdot": float(self.data.qvel[0]), "voltage": self._voltage or 0.0}

    def truth(self) -> dict[str, Any]:
        """Return the groups that a log can determine, in the units of ``pipelines/pendulum/model.py``."""
        return {
            "gain": self._K / _R / self._J,
            "gravity": _MASS * 9.81 * _LENGTH / self._J,
            "damping": (self._b + self._K**2 / _R) / self._J,
            "friction": self._c / self._J,
        }

    def _torque_nm(self, voltage: float) -> float:
        return self._K / _R * (voltage - self._K * float(self.data.qvel[0]))
