"""The disk as a graph: voltage in, angle out. Angle 0 hangs down, as in the recording."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.worlds import friction
from sim2real.worlds.friction import FrictionParams
from sim2real.worlds.joint import Forces, JointWorld


@pytree.dataclass
class Command(Base):
    """Voltage, shape ``(1,)`` [V]."""

    action: Any


@pytree.dataclass
class Measurement(Base):
    """Angle by the encoder [rad]."""

    th: Any


@pytree.dataclass
class DiskParams(Base):
    """A DC motor that turns an eccentric mass, per unit of inertia.

    Attributes:
        gain: Acceleration per volt [rad/s^2/V].
        gravity: m g l / J [rad/s^2].
        friction: Viscous friction holds the back-EMF; ``load`` is the share of the radial load of gravity.
        swing: What the centrifugal force adds to that load, over (rad/s)^2 [1].
        voltage_offset: What the amplifier adds to every command [V].
        cogging: Torque of the motor's magnets that comes twice a turn, at angle 0 [rad/s^2].
        start: Initial angle and velocity, shape ``(2,)`` [rad, rad/s].
    """

    gain: Any
    gravity: Any
    friction: FrictionParams
    swing: Any
    voltage_offset: Any
    cogging: Any
    start: Any


class DiskWorld(JointWorld):
    """The disk, driven by the ``actuator`` input."""

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> DiskParams:
        del rng, graph_state
        return DiskParams(
            gain=28.0,
            gravity=134.0,
            friction=FrictionParams(viscous=1.5, load=0.047),
            swing=0.05,
            voltage_offset=0.0,
            cogging=0.0,
            start=jnp.zeros(2),
        )

    def command(self, step_state: StepState) -> Any:
        return step_state.inputs["actuator"][-1].data.action[0]

    def forces(self, params: DiskParams, position: Any, velocity: Any, command: Any) -> Forces:
        p = params
        along = jnp.cos(position)
        radial = p.gravity * along + p.swing * velocity**2
        return Forces(
            acceleration=p.gain * (command + p.voltage_offset)
            - p.gravity * jnp.sin(position)
            + p.cogging * (2.0 * along**2 - 1.0),
            damping=friction.damping(p.friction, velocity),
            dry=friction.dry(p.friction, velocity, radial),
        )
