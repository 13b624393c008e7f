"""Worlds of joints whose dry friction can hold them at rest (stiction)."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, NamedTuple

from sim2real import pytree
from sim2real.graph.base import Base, GraphState
from sim2real.types import PyTree
from sim2real.worlds.friction import rubbed
from sim2real.worlds.stepped import SteppedWorld

if TYPE_CHECKING:
    import jax

    from sim2real.graph.base import Value


@pytree.dataclass
class JointState(Base):
    """State of one joint or of several.

    Attributes:
        position: Shape ``()`` or ``(joints,)`` [rad].
        velocity: Shape ``()`` or ``(joints,)`` [rad/s].
    """

    position: Value
    velocity: Value


class Forces(NamedTuple):
    """The forces on a joint, divided by its inertia.

    Attributes:
        acceleration: All forces but the next two; they should depend little on the velocity [rad/s^2].
        damping: Coefficient of the forces that are proportional to the velocity and oppose it [1/s].
        dry: Largest dry friction [rad/s^2].
    """

    acceleration: Value
    damping: Value
    dry: Value


class JointWorld(SteppedWorld):
    """Joints integrated by position Verlet, with implicit damping (trapezoidal rule) and exact dry friction.

    The parameters' ``start`` has the initial positions, then the velocities: shape ``(2,)`` for one joint, whose state
    are numbers, or ``(2 * joints,)``.

    Forces are evaluated at the middle of a substep. The method is of second order as long as no joint sticks and only
    damping depends on the velocity. With semi-implicit Euler, an identified delay is biased by half a substep.

    Args:
        rate: Ticks per second [Hz].
        substep_s: Largest step of the integrator [s]; a tick is split into equal parts no longer than this. On a motor
            with an eccentric mass, 5 ms gave the same fit as 0.6 ms.
    """

    def __init__(
        self, name: str, rate: float, substep_s: float = 0.005, color: str | None = None, order: int | None = None
    ) -> None:
        super().__init__(name, rate, substep_s, color=color, order=order)

    def init_state(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> JointState:
        """Return the initial positions and velocities that the parameters name."""
        start = ((graph_state or GraphState()).params.get(self.name) or self.init_params(rng)).start
        half = len(start) // 2
        return JointState(start[0], start[1]) if half == 1 else JointState(start[:half], start[half:])

    def velocity(self, state: JointState) -> Value:
        """Return the joints' velocities, ``()`` or ``(joints,)`` [rad/s]."""
        return state.velocity

    def with_velocity(self, state: JointState, velocity: jax.Array) -> JointState:
        """Return the state with other velocities [rad/s]."""
        return state.replace(velocity=velocity)

    @abstractmethod
    def forces(self, params: PyTree, position: Value, velocity: Value, command: PyTree) -> Forces:
        """Return the forces on the joints.

        Args:
            position: [rad].
            velocity: [rad/s].
        """

    def confine(self, params: PyTree, state: JointState) -> JointState:
        """Return the state with the joints kept within their stops; called after every substep."""
        del params
        return state

    def integrate(self, params: PyTree, state: JointState, command: PyTree) -> JointState:
        """Return the state one tick later, under a constant command."""

        def substep(s: JointState, h: float) -> JointState:
            w = s.velocity
            f = self.forces(params, s.position + 0.5 * h * w, w, command)
            damped = w * (1.0 - 0.5 * h * f.damping)
            after = rubbed(damped, h * f.acceleration, h * f.dry) / (1.0 + 0.5 * h * f.damping)
            return self.confine(params, s.replace(position=s.position + 0.5 * h * (w + after), velocity=after))

        return self.over_substeps(substep, state)
