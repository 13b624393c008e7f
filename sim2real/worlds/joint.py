"""Worlds of joints with dry friction that sticks."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

from flax import struct

from sim2real.graph.base import Base
from sim2real.worlds.friction import stopped
from sim2real.worlds.stepped import SteppedWorld


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


class JointWorld(SteppedWorld):
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
        super().__init__(name, rate, substep_s, color=color, order=order)

    @abstractmethod
    def forces(self, params: Any, position: Any, velocity: Any, command: Any) -> Forces:
        """Return what acts at a position [rad] and velocity [rad/s] under a command."""

    def confine(self, params: Any, state: Any) -> Any:
        """Return the state within the joints' stops; called after every substep."""
        del params
        return state

    def integrate(self, params: Any, state: Any, command: Any) -> Any:
        """Return the state one tick later, under a command that is held."""

        def substep(s: Any, h: float) -> Any:
            w = s.velocity
            f = self.forces(params, s.position + 0.5 * h * w, w, command)
            pushed = w * (1.0 - 0.5 * h * f.damping) + h * f.acceleration
            after = stopped(pushed, h * f.dry) / (1.0 + 0.5 * h * f.damping)
            return self.confine(params, s.replace(position=s.position + 0.5 * h * (w + after), velocity=after))

        return self.over_substeps(substep, state)
