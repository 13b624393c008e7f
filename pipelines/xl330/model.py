"""The servo and its arm as a graph: goals in, angles out. Angle 0 hangs down.

The recordings show the firmware's law: the reported PWM follows ``kp / 256`` times the error in counts within one step.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.worlds.joint import Forces, JointWorld

MASS_KG, LENGTH_M, GRAVITY = 0.49, 0.10, 9.81
COUNTS_PER_RAD, FULL_PWM, KP_UNIT = 4096 / (2 * jnp.pi), 885.0, 256.0
_OPEN = 0.05
"""Share of the back-EMF's brake that is left when torque is off: the winding is nearly open."""


@pytree.dataclass
class Command(Base):
    """The servo's command.

    Attributes:
        goal: [rad].
        kp: Its position gain, in its own unit.
        enabled: 1 with torque on, 0 with torque off.
    """

    goal: Any
    kp: Any
    enabled: Any


@pytree.dataclass
class Measurement(Base):
    """Angle by the encoder [rad]."""

    position: Any


@pytree.dataclass
class ServoParams(Base):
    """Motor, gears and load.

    Attributes:
        stall: Torque at full duty and standstill, before it saturates [N m].
        back_emf: What a speed takes off [N m s/rad].
        softness: How early the torque saturates [1/(N m)].
        armature: Inertia of the motor behind the gears [kg m^2].
        viscous: [N m s/rad].
        coulomb: [N m].
        gears: Share of the load on the gears, the motor's torque and the weight's, that rubs while they turn [1].
        static: What that grows by at rest [1].
        stribeck_rad_s: Speed at which 1/e of that is left [rad/s].
        released: Share of the gears' friction that is left when torque is off [1].
        offset: Angle of the arm when the encoder reads 0 [rad].
        start: Initial angle and velocity, shape ``(2,)`` [rad, rad/s].
    """

    stall: Any = 1.0
    back_emf: Any = 0.05
    softness: Any = 0.8
    armature: Any = 0.0015
    viscous: Any = 0.005
    coulomb: Any = 0.01
    gears: Any = 0.15
    static: Any = 0.05
    stribeck_rad_s: Any = 0.1
    released: Any = 0.5
    offset: Any = 0.0
    start: Any = pytree.field(default_factory=lambda: jnp.zeros(2))


def position_duty(goal: Any, position: Any, gain: Any, counts_per_unit: float, full: float) -> Any:
    """Return the duty, in [-1, 1], of a position loop that works on integers, like that of DYNAMIXEL's firmware.

    Args:
        goal: Goal position [rad].
        position: Present position [rad].
        gain: PWM steps per count of error.
        counts_per_unit: Encoder counts per radian.
    """
    off = jnp.floor(goal * counts_per_unit + 0.5) - jnp.floor(position * counts_per_unit + 0.5)
    return jnp.trunc(jnp.clip(gain * off, -full, full)) / full


def motor_torque(duty: Any, velocity: Any, stall: Any, back_emf: Any, softness: Any = 0.0) -> Any:
    """Return the torque of a motor under a duty [N m].

    Args:
        duty: In [-1, 1].
        velocity: [rad/s].
        stall: Torque at full duty and standstill, without saturation [N m].
        back_emf: Torque lost to back-EMF per speed [N m s/rad].
        softness: Saturation: the torque stays below ``1 / softness`` [1/(N m)].
    """
    linear = stall * duty - back_emf * velocity
    return linear / (1.0 + softness * jnp.abs(linear))


class ServoWorld(JointWorld):
    """The servo with its arm, driven by the ``actuator`` input."""

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> ServoParams:
        del rng, graph_state
        return ServoParams()

    def command(self, step_state: StepState) -> Command:
        return step_state.inputs["actuator"][-1].data

    def forces(self, params: ServoParams, position: Any, velocity: Any, command: Command) -> Forces:
        p = params
        on = command.enabled > 0.5
        duty = position_duty(command.goal, position, command.kp / KP_UNIT, COUNTS_PER_RAD, FULL_PWM)
        motor = jnp.where(on, motor_torque(duty, velocity, p.stall, p.back_emf, p.softness), 0.0)
        weight = -MASS_KG * GRAVITY * LENGTH_M * jnp.sin(position + p.offset)
        share = p.gears + p.static * jnp.exp(-jnp.abs(velocity) / p.stribeck_rad_s)
        rubbing = p.coulomb + jnp.where(on, 1.0, p.released) * share * (jnp.abs(motor) + jnp.abs(weight))
        inertia = MASS_KG * LENGTH_M**2 + p.armature
        brake = p.viscous + jnp.where(on, 0.0, _OPEN * p.back_emf)
        return Forces(acceleration=(motor + weight) / inertia, damping=brake / inertia, dry=rubbing / inertia)
