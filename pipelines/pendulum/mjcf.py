"""The identified pendulum as MJCF, for other simulators."""

from __future__ import annotations

from collections.abc import Mapping

from sim2real.types import Scalar

from .model import GRAVITY, nominal_params

HINGE = "hinge"
"""The joint; angle 0 is upright."""
STEP_S = 0.0005
"""Time step of the exported model [s]."""
_MJCF = """<mujoco model="pendulum">
  <option timestep="{step_s}" gravity="0 0 -{gravity}" integrator="implicitfast"/>
  <worldbody>
    <body name="disk">
      <joint name="{hinge}" type="hinge" axis="0 1 0" damping="{damping}" frictionloss="{friction}"
             solreffriction="{stiff_s} 1"/>
      <inertial pos="0 0 {length}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      <geom type="cylinder" size="0.055 0.006" euler="90 0 0" contype="0" conaffinity="0" rgba="0.6 0.6 0.7 1"/>
      <geom type="sphere" size="0.009" pos="0 -0.006 {mass_at}" contype="0" conaffinity="0" rgba="0.8 0.3 0.2 1"/>
    </body>
  </worldbody>
  <actuator><general name="motor" joint="{hinge}" gainprm="{gain}"/></actuator>
</mujoco>
"""


def mjcf_of(values: Mapping[str, Scalar], step_s: float = STEP_S) -> str:
    """Return the model with identified groups of parameters; the actuator's control is the voltage [V].

    Args:
        values: ``gain`` [rad/s^2/V], ``gravity`` [rad/s^2], ``damping`` [1/s], ``friction`` [rad/s^2].
        step_s: Time step [s]; MuJoCo's dry friction acts over two steps, and the identified one at once.
    """
    nominal = nominal_params()
    inertia = float(nominal.J)
    # Only mass times distance counts. At a quarter of the distance the mass's own inertia stays below the total one.
    length = float(nominal.length) / 4
    mass = float(values["gravity"]) * inertia / (GRAVITY * length)
    return _MJCF.format(
        step_s=step_s,
        gravity=GRAVITY,
        hinge=HINGE,
        damping=float(values["damping"]) * inertia,
        friction=float(values["friction"]) * inertia,
        stiff_s=2 * step_s,
        length=length,
        mass_at=float(nominal.length),
        mass=mass,
        inertia=inertia - mass * length**2,
        gain=float(values["gain"]) * inertia,
    )
