"""The disk pendulum's model: messages, nodes and parameters. th = 0 is upright, th = pi hangs down."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real import pytree
from sim2real.arrays import namespace
from sim2real.graph.base import Array, Base, GraphState, StepState
from sim2real.identification.parameters import Parameter
from sim2real.later import jnp
from sim2real.robots.agent import PolicyAgent
from sim2real.worlds.joint import Forces, JointState, JointWorld

GRAVITY = 9.81  # [m/s^2]
HISTORY = 4
"""Past steps in the policy's observation."""


@pytree.dataclass
class Command(Base):
    """The motor's command; ``action`` has shape ``(1,)`` [V]."""

    action: Any


@pytree.dataclass
class Measurement(Base):
    """Angle ``th`` [rad] and angular velocity ``thdot`` [rad/s]."""

    th: Any
    thdot: Any


@pytree.dataclass
class PendulumParams(Base):
    """A DC motor that turns an eccentric mass.

    Attributes:
        J: Moment of inertia about the axis [kg m^2].
        mass: Eccentric mass [kg].
        length: Distance of the mass from the axis [m].
        b: Viscous friction [N m s/rad].
        K: Torque constant, and of the back-EMF [N m/A].
        R: Winding resistance [ohm].
        c: Coulomb friction [N m].
        max_speed: Speed limit of the model [rad/s].
        start: Initial angle and velocity, shape ``(2,)`` [rad, rad/s].
    """

    J: Any
    mass: Any
    length: Any
    b: Any
    K: Any
    R: Any
    c: Any
    max_speed: Any
    start: Any


def nominal_params() -> PendulumParams:
    """Return the data-sheet values: those of the seed's tutorial."""
    return PendulumParams(
        J=0.000159931461600856,
        mass=0.0508581731919534,
        length=0.0415233722862552,
        b=1.43298488358436e-05,
        K=0.0333391179016334,
        R=7.73125142447252,
        c=0.000975041213361349,
        max_speed=60.0,
        start=np.array([np.pi, 0.0], np.float32),
    )


def groups(p: PendulumParams) -> dict[str, Any]:
    """Return the identifiable groups of a parameter set."""
    return {
        "gain": p.K / p.R / p.J,
        "gravity": p.mass * GRAVITY * p.length / p.J,
        "damping": (p.b + p.K**2 / p.R) / p.J,
        "friction": p.c / p.J,
    }


def from_groups(values: Mapping[str, Any], start: Any) -> PendulumParams:
    """Return model parameters with these groups: J, R and length stay nominal, b takes what K leaves of the damping.

    Args:
        values: ``gain`` [rad/s^2/V], ``gravity`` [rad/s^2], ``damping`` [1/s], ``friction`` [rad/s^2].
        start: Shape ``(2,)``: initial angle [rad] and velocity [rad/s].
    """
    p = nominal_params()
    K = values["gain"] * p.R * p.J
    return p.replace(
        K=K,
        mass=values["gravity"] * p.J / (GRAVITY * p.length),
        b=values["damping"] * p.J - K**2 / p.R,
        c=values["friction"] * p.J,
        start=jnp.asarray(start),
    )


def dynamics() -> list[Parameter]:
    """Return the parameters to identify, within a factor of 4 of nominal.

    th'' = gain * V + gravity * sin(th) - damping * th' - friction * sign(th'). A log determines these four groups; J,
    K, R and the rest appear only in them: the model keeps its nominal J, R and length and takes the groups through
    the others. A payload where the mass is changes all of them, and inertia about the axis alone.
    """
    p = nominal_params()
    share = float(p.mass * p.length**2 / p.J)  # of the mass in the inertia
    about = {
        "gain": ("rad/s^2/V", "acceleration per volt, K / (R J)"),
        "gravity": ("rad/s^2", "m g l / J"),
        "damping": ("1/s", "viscous friction and back-EMF, (b + K^2/R) / J"),
        "friction": ("rad/s^2", "Coulomb friction, c / J"),
    }
    return [
        Parameter(
            name, about[name][0], float(value), float(value) / 4, float(value) * 4, about=about[name][1],
            vanishes=name in ("damping", "friction"),
            causes={"payload": float(name == "gravity") - share, "inertia": -1.0},
        )
        for name, value in groups(p).items()
    ]  # fmt: skip


class PendulumWorld(JointWorld):
    """The pendulum, driven by the ``actuator`` input; dry friction holds it at rest.

    Its state is the message of the sensor, ``th`` and ``thdot``.

    Args:
        rate: Ticks per second [Hz].
        substep_s: Largest step of the integrator [s].
        options: Options of ``JointWorld``.
    """

    def __init__(self, name: str, rate: float, substep_s: float = 0.002, **options: Any) -> None:
        super().__init__(name, rate, substep_s, **options)

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> PendulumParams:
        del rng, graph_state
        return nominal_params()

    def init_state(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        start = super().init_state(rng, graph_state)
        return Measurement(th=start.position, thdot=start.velocity)

    def command(self, step_state: StepState) -> Any:
        return step_state.inputs["actuator"][-1].data.action[0]

    def integrate(self, params: PendulumParams, state: Any, command: Any) -> Any:
        moved = super().integrate(params, JointState(state.th, state.thdot), command)
        return Measurement(th=moved.position, thdot=moved.velocity)

    def forces(self, params: PendulumParams, position: Any, velocity: Any, command: Any) -> Forces:
        del velocity
        p = params
        push = p.K / p.R * command + p.mass * GRAVITY * p.length * jnp.sin(position)
        return Forces(acceleration=push / p.J, damping=(p.b + p.K**2 / p.R) / p.J, dry=p.c / p.J)

    def confine(self, params: PendulumParams, state: JointState) -> JointState:
        return state.replace(velocity=jnp.clip(state.velocity, -params.max_speed, params.max_speed))

    def velocity(self, state: Any) -> Any:
        return state.thdot

    def with_velocity(self, state: Any, velocity: Array) -> Any:
        return state.replace(thdot=velocity)


class Agent(PolicyAgent):
    """The policy's node: cos, sin, thdot / 10 and a short history of these and of voltages in; a voltage out."""

    def __init__(self, name: str, rate: float, **options: Any) -> None:
        super().__init__(name, rate, 1, HISTORY, (3, 1), **options)

    def features(self, reading: Measurement, step_state: StepState) -> Array:
        return features(reading)

    def row(self, reading: Measurement, features: Array, command: Array, action: Array) -> Array:
        return namespace(features, action).concatenate([features, action])


def features(m: Measurement) -> Array:
    """Return the policy's features of a measurement, ``(3,)``; in numpy on the robot, which runs without JAX."""
    xp = namespace(m.th)
    return xp.stack([xp.cos(m.th), xp.sin(m.th), m.thdot / 10.0]).astype(np.float32)
