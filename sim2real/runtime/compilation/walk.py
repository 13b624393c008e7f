"""Runs a compiled graph from one step of the supervisor to its next one, for ``CompiledGraph.reset`` and ``step``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.runtime.compilation.program import RowProgram, select

if TYPE_CHECKING:
    from sim2real.graph.base import Number


class Walk:
    """Finds the supervisor's steps in the rows, and runs from one to the next.

    The supervisor may have several slots in a row; its i-th one is called turn i.

    Attributes:
        places: Shape ``(E, K)``: place of each of its steps, ``row * number of turns + turn``.
        end: The place after the last row, also used for steps that an episode does not have.
    """

    def __init__(self, program: RowProgram, supervisor: str) -> None:
        wiring = program.wiring
        self.program, self.supervisor, self.rows = program, supervisor, wiring.rows
        self.turns = [i for i, n in enumerate(wiring.slots) if n == supervisor]
        self.end = self.rows * len(self.turns)
        self.places = np.full((program.episodes, 0), 0)
        if self.turns:
            seq = np.stack([wiring.tables[i].seq for i in self.turns], axis=-1).reshape(program.episodes, -1)
            self.places = np.full((program.episodes, int(seq.max()) + 1), seq.shape[1])
            e, at = np.nonzero(seq >= 0)
            self.places[e, seq[e, at]] = at

    @property
    def counts(self) -> np.ndarray:
        """Number of the supervisor's steps in each episode, shape ``(E,)``."""
        return (self.places < self.end).sum(axis=1)

    @property
    def longest_gap(self) -> int:
        """Largest number of rows from one step of the supervisor to the next."""
        return int(np.diff(self.places // max(1, len(self.turns)), axis=1).max(initial=1))

    def last_row(self, steps: np.ndarray) -> np.ndarray:
        """Return the row of the last of an episode's first ``steps (E,)`` steps that is computed, ``(E,)``."""
        computed = (np.arange(self.places.shape[1]) < steps[:, None]) & (self.places < self.end)
        return np.where(computed, self.places, 0).max(axis=1, initial=0) // max(1, len(self.turns))

    def first_turn(self) -> int:
        """Return the supervisor's first slot; raise a ``UsageError`` if it has none."""
        if self.turns:
            return self.turns[0]
        if self.supervisor == self.program.wiring.world:
            raise UsageError(
                f"the supervisor {self.supervisor!r} is the world: it ticks in every row, and its steps have no turn",
                hint="make the node that acts the supervisor, or use rollout(), which works with any",
            )
        raise UsageError(f"the outputs of the supervisor {self.supervisor!r} are given: it makes no steps")

    def only_turn(self) -> int:
        """Return the supervisor's only slot; raise a ``UsageError`` if it has none, or several."""
        first = self.first_turn()
        if len(self.turns) > 1:
            raise UsageError(
                f"the supervisor {self.supervisor!r} makes up to {len(self.turns)} steps in a row of these timelines",
                hint="draw timelines without bursts, remove the episodes with a hiccup, or use reset() and step()",
            )
        return first

    def to_first(self, gs: GraphState) -> tuple[GraphState, StepState]:
        """Run from the start of an episode to the supervisor's first step."""
        gs = self.program.run_slots(gs, 0, self.first_turn(), {})
        arrived = self.program.seq(gs, self.turns[0]) >= 0
        return self._at_step(*self._search(gs, jnp.int32(0), arrived, int(self.places[:, 0].max())))

    def turn_of(self, gs: GraphState, k: Number) -> jax.Array:
        """Return the turn at which the supervisor makes step ``k``."""
        return jnp.asarray(self.places)[gs.eps, jnp.maximum(k, 0)] % len(self.turns)

    def to_next(self, gs: GraphState, turn: jax.Array, ended: Number) -> tuple[GraphState, StepState]:
        """Run to the supervisor's next step.

        Args:
            turn: The turn of that step.
            ended: Bool scalar: the episode has no further step, and the state stays unchanged.
        """
        return self._at_step(*self._search(gs, turn, ended, int(np.diff(self.places, axis=1).max(initial=1))))

    def step_state(self, gs: GraphState, turn: jax.Array) -> StepState:
        """Return the supervisor's step state at a turn; ``seq`` is -1 if it makes no step there."""
        step_state = self.program.step_state(gs, self.turns[0])
        for i, slot in enumerate(self.turns[1:], start=1):
            step_state = select(turn == i, self.program.step_state(gs, slot), step_state)
        return step_state

    def _at_step(self, gs: GraphState, turn: jax.Array) -> tuple[GraphState, StepState]:
        """Return the state, whose ``seq`` has the supervisor's next step, and the supervisor's step state."""
        step_state = self.step_state(gs, turn)
        return gs.replace(seq={self.supervisor: step_state.seq}), step_state

    def _hop(self, gs: GraphState, i: int) -> GraphState:
        """Run from turn ``i`` to the next turn, in this row or the next one."""
        slots = len(self.program.wiring.slots)
        if i + 1 < len(self.turns):
            return self.program.run_slots(gs, self.turns[i] + 1, self.turns[i + 1], {}, inside=True)
        gs = self.program.run_slots(gs, self.turns[i] + 1, slots, {}, inside=True)
        gs = self.program.run_world(gs, {}, inside=True)
        return self.program.run_slots(gs, 0, self.turns[0], {})

    def _search(self, gs: GraphState, turn: jax.Array, arrived: Number, hops: int) -> tuple[GraphState, jax.Array]:
        """Run from turn to turn until the supervisor makes a step; return the state and the turn.

        The loop always runs ``hops`` turns, the most that any step needs. After the step, and after the last row, the
        state is masked.
        """
        turns = len(self.turns)

        def sweep(
            carry: tuple[GraphState, jax.Array, jax.Array], _: None
        ) -> tuple[tuple[GraphState, jax.Array, jax.Array], None]:
            gs, turn, arrived = carry
            for i in range(turns):
                active = ~arrived & self.program.within(gs)
                active = active if turns == 1 else active & (turn == i)
                gs = select(active, self._hop(gs, i), gs)
                following = (i + 1) % turns
                turn = jnp.where(active, following, turn)
                arrived = arrived | (active & (self.program.seq(gs, self.turns[following]) >= 0))
            return (gs, turn, arrived), None

        # One sweep more than the hops need, as the first may start at any turn.
        sweeps = hops if turns == 1 else -(-hops // turns) + (hops > 0)
        carry = (gs, jnp.asarray(turn, jnp.int32), jnp.asarray(arrived))
        if sweeps == 1:
            carry, _ = sweep(carry, None)
        elif sweeps:
            carry, _ = jax.lax.scan(sweep, carry, length=sweeps)
        return carry[0], carry[1]
