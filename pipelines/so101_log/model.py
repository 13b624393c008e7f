"""The arm as a graph: six goals in, six positions out. Joints see each other through gravity and the table alone."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from sim2real import pytree
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.worlds import friction
from sim2real.worlds.friction import FrictionParams
from sim2real.worlds.joint import Forces, JointState, JointWorld

JOINTS = ("rotation", "pitch", "elbow", "wrist_pitch", "wrist_roll", "jaw")


@pytree.dataclass
class Goal(Base):
    """Goals of the joints, shape ``(6,)`` [rad]."""

    goal: Any


@pytree.dataclass
class Positions(Base):
    """Where the encoders say that they are, shape ``(6,)`` [rad]."""

    position: Any


@pytree.dataclass
class Gravity(Base):
    """By how much weight pushes joints off, over the stiffness of their servos [rad].

    Attributes:
        shoulder: Of the upper arm, on pitch, times the sine of its angle.
        forearm: Of the forearm, on pitch and elbow, times the cosine of its angle.
        hand: Of the hand, on pitch, elbow and wrist, times the cosine of its angle.
    """

    shoulder: Any
    forearm: Any
    hand: Any


@pytree.dataclass
class Table(Base):
    """What the hand comes to rest on: it pushes back once elbow + ``ratio`` * pitch exceeds ``height``.

    Attributes:
        height: [rad].
        ratio: Share of the pitch joint.
        stiffness: Over that of the elbow's servo [1].
    """

    height: Any
    ratio: Any
    stiffness: Any


@pytree.dataclass
class ArmParams(Base):
    """Servos and their links; every leaf of the servos has shape ``(6,)``.

    Attributes:
        stiffness: Firmware's gain over inertia [1/s^2].
        damping: Back-EMF and firmware's damping over inertia [1/s].
        friction: Dry friction over the stiffness: as an error of position [rad].
        bias: Offset between goal and encoder [rad].
        saturation: Error of position beyond which the servo pushes no harder [rad].
        low: Lower stop [rad].
        gravity: Weight.
        table: Contact.
        start: Initial positions and velocities, shape ``(12,)`` [rad, rad/s].
    """

    stiffness: Any
    damping: Any
    friction: FrictionParams
    bias: Any
    saturation: Any
    low: Any
    gravity: Gravity
    table: Table
    start: Any


def nominal() -> ArmParams:
    """Return rough values: 0.08 s of lag, a degree of friction, a servo that saturates at 20 degrees of error."""
    six = jnp.ones(6)
    return ArmParams(
        stiffness=jnp.array([800.0, 440.0, 440.0, 2000.0, 2000.0, 2000.0]),
        damping=jnp.array([63.0, 35.0, 30.0, 160.0, 150.0, 140.0]),
        friction=FrictionParams(static=jnp.array([0.01, 0.03, 0.04, 0.015, 0.01, 0.005]), stribeck_rad_s=0.4 * six),
        bias=0.0 * six,
        saturation=jnp.array([0.45, 1.0, 1.0, 1.0, 0.2, 0.06]),
        low=jnp.array([-3.0, -3.0, -3.0, -3.0, -1.034, -3.0]),
        gravity=Gravity(shoulder=0.005, forearm=0.01, hand=0.001),
        table=Table(height=0.95, ratio=0.85, stiffness=0.8),
        start=jnp.zeros(12),
    )


class ArmWorld(JointWorld):
    """Six servos, driven by the ``actuator`` input."""

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> ArmParams:
        del rng, graph_state
        return nominal()

    def command(self, step_state: StepState) -> Any:
        return step_state.inputs["actuator"][-1].data.goal

    def forces(self, params: ArmParams, position: Any, velocity: Any, command: Any) -> Forces:
        p = params
        error = jnp.clip(command + p.bias - position, -p.saturation, p.saturation) + _weight(p, position)
        return Forces(
            acceleration=p.stiffness * error,
            damping=p.damping,
            dry=p.stiffness * friction.dry(p.friction, velocity),
        )

    def confine(self, params: ArmParams, state: JointState) -> JointState:
        below = state.position < params.low
        return JointState(jnp.maximum(state.position, params.low), jnp.where(below, 0.0, state.velocity))


def _weight(p: ArmParams, q: Any) -> Any:
    """Return what weight and table push, over the servos' stiffness, ``(6,)`` [rad]."""
    upper, fore, hand = q[1], q[1] + q[2], q[1] + q[2] + q[3]
    pushed = p.table.stiffness * jnp.maximum(0.0, q[2] + p.table.ratio * q[1] - p.table.height)
    wrist = p.gravity.hand * jnp.cos(hand)
    elbow = p.gravity.forearm * jnp.cos(fore) + wrist
    pitch = p.gravity.shoulder * jnp.sin(upper) + elbow
    zero = jnp.zeros_like(wrist)
    return jnp.stack([zero, pitch - p.table.ratio * pushed, elbow - pushed, wrist, zero, zero])


class Sensor(BaseNode):
    """The encoders."""

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Positions:
        del rng, graph_state
        return Positions(position=jnp.zeros(6))

    def step(self, step_state: StepState) -> tuple[StepState, Positions]:
        return step_state, Positions(position=step_state.inputs["world"][-1].data.position)
