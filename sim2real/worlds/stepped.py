"""Worlds that integrate their state over a tick in equal substeps, with a constant command."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseWorld
from sim2real.later import jax, jnp
from sim2real.types import PyTree
from sim2real.worlds.recorded import command_delay

if TYPE_CHECKING:
    from sim2real.graph.base import Value


T = TypeVar("T")


class SteppedWorld(BaseWorld):
    """Base class of worlds that divide a tick into substeps; subclasses integrate.

    If the parameters of the node ``actuator`` have a ``delay``, it is that of its commands.

    Args:
        rate: Ticks per second [Hz].
        substep_s: Largest step of the integrator [s]; a tick is split into equal parts no longer than this.
    """

    def __init__(
        self, name: str, rate: float, substep_s: float, color: str | None = None, order: int | None = None
    ) -> None:
        super().__init__(name, rate, color=color, order=order)
        if not substep_s > 0:
            raise UsageError(f"world {name!r}: substep_s must be positive, got {substep_s} s")
        self.substeps = max(1, math.ceil(round(1.0 / (self.rate * substep_s), 9)))

    @abstractmethod
    def command(self, step_state: StepState) -> PyTree:
        """Return the command, which is constant during this tick."""

    @abstractmethod
    def integrate(self, params: PyTree, state: PyTree, command: PyTree) -> PyTree:
        """Return the state one tick later.

        Args:
            command: The command, constant during the tick.
        """

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
        """Return the delay of the commands, where the actuator's parameters set one."""
        del rng
        return command_delay(graph_state)

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Integrate over one tick."""
        params = step_state.params
        state = self.integrate(params, step_state.state, self.command(step_state))
        new = step_state.replace(state=state)
        return new, self.output(params, state)

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
