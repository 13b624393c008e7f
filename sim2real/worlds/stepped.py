"""Worlds that integrate their state over a tick in equal substeps, under a command that is held."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from sim2real.errors import UsageError
from sim2real.graph.base import StepState
from sim2real.graph.node import BaseWorld


class SteppedWorld(BaseWorld):
    """What such worlds share; what happens in a substep is theirs.

    Args:
        name: Unique in the graph.
        rate: Ticks per second [Hz].
        substep_s: Largest step of the integrator [s]; a tick is split into equal parts no longer than this.
        color: Colour in drawings.
        order: Place in drawings.
    """

    def __init__(
        self, name: str, rate: float, substep_s: float, color: str | None = None, order: int | None = None
    ) -> None:
        super().__init__(name, rate, color=color, order=order)
        if not substep_s > 0:
            raise UsageError(f"world {name!r}: substep_s must be positive, got {substep_s} s")
        self.substeps = max(1, math.ceil(round(1.0 / (self.rate * substep_s), 9)))

    @abstractmethod
    def command(self, step_state: StepState) -> Any:
        """Return the command that is held during this tick."""

    @abstractmethod
    def integrate(self, params: Any, state: Any, command: Any) -> Any:
        """Return the state one tick later, under a command that is held."""

    def output(self, params: Any, state: Any) -> Any:
        """Return the message that leaves at the end of the tick; default: the state."""
        del params
        return state

    def step(self, step_state: StepState) -> tuple[StepState, Any]:
        """Integrate over one tick."""
        params = step_state.params
        state = self.integrate(params, step_state.state, self.command(step_state))
        new = step_state.replace(state=state)  # pyright: ignore[reportAttributeAccessIssue]
        return new, self.output(params, state)

    def over_substeps(self, substep: Callable[[Any, float], Any], state: Any) -> Any:
        """Return the state after a tick of substeps ``(state, seconds) -> state``."""
        h = 1.0 / (self.rate * self.substeps)
        # A loop costs a GPU a kernel launch a substep. On a CPU the unrolled pendulum took 5 times as long to compile
        # and 6 times as long to run as the loop (2 cores, jax 0.10.2, five substeps).
        unroll = 1 if jax.default_backend() == "cpu" else self.substeps
        start = jax.tree_util.tree_map(jnp.asarray, state)
        return jax.lax.scan(lambda x, _: (substep(x, h), None), start, length=self.substeps, unroll=unroll)[0]
