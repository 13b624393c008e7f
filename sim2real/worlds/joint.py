"""Worlds of joints with dry friction that sticks."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from sim2real.errors import UsageError
from sim2real.graph.base import Base, StepState
from sim2real.graph.node import BaseWorld
from sim2real.worlds.friction import stopped


@struct.dataclass
class JointState(Base):
    """Position [rad] and velocity [rad/s] of one joint or of several, shape ``()`` or ``(joints,)``."""

    position: Any
    velocity: Any


class Forces(NamedTuple):
    """What acts on a joint, per unit of its inertia.

    Attributes:
        acceleration: All that does not depend on the velocity, or little [rad/s^2].
        damping: What is proportional to the velocity, taken out of ``acceleration`` [1/s].
        dry: The largest dry friction [rad/s^2].
    """

    acceleration: Any
    damping: Any
    dry: Any


class JointWorld(BaseWorld):
    """Integrates joints: position Verlet, damping by the trapezoidal rule, dry friction exactly.

    Forces are evaluated in the middle of a substep, so the method is of second order where nothing sticks and nothing
    but damping depends on the speed. On a motor
    with an eccentric mass, substeps of 5 ms were as good as of 0.6 ms, and a delay that was fitted with them was not
    biased; with semi-implicit Euler it was off by half a substep.

    Args:
        name: Unique in the graph.
        rate: Ticks per second [Hz].
        substep_s: Largest step of the integrator [s]; a tick is split into equal parts no longer than this.
        color: Colour in drawings.
        order: Place in drawings.
    """

    def __init__(
        self, name: str, rate: float, substep_s: float = 0.005, color: str | None = None, order: int | None = None
    ) -> None:
        super().__init__(name, rate, color=color, order=order)
        if not substep_s > 0:
            raise UsageError(f"world {name!r}: substep_s must be positive, got {substep_s} s")
        self.substeps = max(1, math.ceil(round(1.0 / (self.rate * substep_s), 9)))

    @abstractmethod
    def forces(self, params: Any, position: Any, velocity: Any, command: Any) -> Forces:
        """Return what acts at a position [rad] and velocity [rad/s] under a command."""

    @abstractmethod
    def command(self, step_state: StepState) -> Any:
        """Return the command that is held during this tick."""

    def confine(self, params: Any, state: Any) -> Any:
        """Return the state within the joints' stops; called after every substep."""
        del params
        return state

    def output(self, params: Any, state: Any) -> Any:
        """Return the message that leaves at the end of the tick; default: the state."""
        del params
        return state

    def integrate(self, params: Any, state: Any, command: Any) -> Any:
        """Return the state one tick later, under a command that is held."""
        h = 1.0 / (self.rate * self.substeps)

        def substep(s: Any, _: None) -> tuple[Any, None]:
            w = s.velocity
            f = self.forces(params, s.position + 0.5 * h * w, w, command)
            pushed = w * (1.0 - 0.5 * h * f.damping) + h * f.acceleration
            after = stopped(pushed, h * f.dry) / (1.0 + 0.5 * h * f.damping)
            moved = s.replace(position=s.position + 0.5 * h * (w + after), velocity=after)
            return self.confine(params, moved), None

        start = jax.tree_util.tree_map(jnp.asarray, state)
        unroll = 1 if jax.default_backend() == "cpu" else self.substeps  # as in OdeWorld
        return jax.lax.scan(substep, start, length=self.substeps, unroll=unroll)[0]

    def step(self, step_state: StepState) -> tuple[StepState, Any]:
        """Integrate over one tick."""
        params = step_state.params
        state = self.integrate(params, step_state.state, self.command(step_state))
        new = step_state.replace(state=state)  # pyright: ignore[reportAttributeAccessIssue]
        return new, self.output(params, state)
