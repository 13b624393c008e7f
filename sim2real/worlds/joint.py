"""Worlds of joints whose dry friction can hold them at rest (stiction)."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseWorld
from sim2real.later import jax, jnp
from sim2real.types import PyTree
from sim2real.worlds.friction import rubbed
from sim2real.worlds.recorded import delay_of

if TYPE_CHECKING:
    from sim2real.graph.base import Value

T = TypeVar("T")


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
        acceleration: All other forces, which should depend little on the velocity [rad/s^2].
        damping: Coefficient of the forces that are proportional to the velocity and oppose it [1/s].
        dry: Largest dry friction [rad/s^2].
    """

    acceleration: Value
    damping: Value
    dry: Value


class JointWorld(BaseWorld):
    """Joints integrated by position Verlet, with implicit damping (trapezoidal rule) and exact dry friction.

    The parameters' ``start`` has the initial positions, then the velocities: ``(2 * joints,)``, or ``(2,)`` for a
    single joint, whose position and velocity are scalars.

    Forces are evaluated at the middle of a substep. The method is of second order as long as no joint sticks and only
    damping depends on the velocity. With semi-implicit Euler, an identified delay is biased by half a substep.

    If the parameters of the node ``actuator`` have a ``delay``, commands are delayed by it.

    Args:
        rate: Ticks per second [Hz].
        substep_s: Largest step of the integrator [s]; a tick is split into equal parts no longer than this. On a motor
            with an eccentric mass, 5 ms gave the same fit as 0.6 ms.
    """

    def __init__(
        self, name: str, rate: float, substep_s: float = 0.005, color: str | None = None, order: int | None = None
    ) -> None:
        super().__init__(name, rate, color=color, order=order)
        if not substep_s > 0:
            raise UsageError(f"world {name!r}: substep_s must be positive, got {substep_s} s")
        self.substeps = max(1, math.ceil(round(1.0 / (self.rate * substep_s), 9)))

    @abstractmethod
    def command(self, step_state: StepState) -> PyTree:
        """Return the command, which is constant during this tick."""

    def init_state(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> JointState:
        """Return the initial positions and velocities in the parameters' ``start``."""
        start = ((graph_state or GraphState()).params.get(self.name) or self.init_params(rng)).start
        half = len(start) // 2
        return JointState(start[0], start[1]) if half == 1 else JointState(start[:half], start[half:])

    def output(self, params: PyTree, state: PyTree) -> PyTree:
        """Return the message that leaves at the end of the tick; default: the state."""
        del params
        return state

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the output of the initial state: the input of a sensor before the end of the first tick."""
        gs = graph_state or GraphState()
        state = gs.state.get(self.name) or self.init_state(rng, graph_state)
        return self.output(gs.params.get(self.name) or self.init_params(rng), state)

    def init_delays(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        """Return the delay of the commands, if the actuator's parameters set one."""
        del rng
        return delay_of("actuator", "actuator", graph_state)

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Integrate over one tick."""
        params = step_state.params
        state = self.integrate(params, step_state.state, self.command(step_state))
        new = step_state.replace(state=state)
        return new, self.output(params, state)

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

    def over_substeps(self, substep: Callable[[T, float], T], state: T) -> T:
        """Return the state after one tick.

        Args:
            substep: Maps a state and a substep's length [s] to the state after it.
        """
        h = 1.0 / (self.rate * self.substeps)
        # Unrolled on a GPU, where a loop costs a kernel launch per substep. On a CPU, unrolling the pendulum's five
        # substeps made it compile 5 times and run 6 times as long (2 cores, jax 0.10.2).
        unroll = 1 if jax.default_backend() == "cpu" else self.substeps
        start = jax.tree_util.tree_map(jnp.asarray, state)
        return jax.lax.scan(lambda x, _: (substep(x, h), None), start, length=self.substeps, unroll=unroll)[0]
