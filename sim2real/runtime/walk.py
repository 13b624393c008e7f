"""From one step of the supervisor to its next one: what ``CompiledGraph.reset`` and ``step`` do between their hands."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.runtime.program import RowProgram, select


class Walk:
    """Where in the rows the supervisor makes its steps, and how to get from one to the next.

    Args:
        program: The rows.
        supervisor: The node at whose steps ``reset`` and ``step`` hand over.

    Attributes:
        turns: Slots of the supervisor at a boundary.
    """

    def __init__(self, program: RowProgram, supervisor: str) -> None:
        wiring = program.wiring
        self.program, self.supervisor, self.rows = program, supervisor, wiring.rows
        self.turns = [i for i, n in enumerate(wiring.slots) if n == supervisor]
        self.end = self.rows * len(self.turns)
        # Place of each of the supervisor's steps, (E, K): row * turns + turn; behind the last row where there is none.
        self.places = np.full((program.episodes, 0), 0)
        if self.turns:
            seq = np.stack([wiring.tables[i].seq for i in self.turns], axis=-1).reshape(program.episodes, -1)
            self.places = np.full((program.episodes, int(seq.max()) + 1), seq.shape[1])
            e, at = np.nonzero(seq >= 0)
            self.places[e, seq[e, at]] = at

    @property
    def counts(self) -> np.ndarray:
        """How many steps of the supervisor each episode has, shape ``(E,)``."""
        return (self.places < self.end).sum(axis=1)

    @property
    def longest_gap(self) -> int:
        """The most rows between two steps of the supervisor."""
        return int(np.diff(self.places // max(1, len(self.turns)), axis=1).max(initial=1))

    def first_turn(self) -> int:
        """Return the supervisor's first slot.

        Raises:
            UsageError: When it has none.
        """
        if self.turns:
            return self.turns[0]
        if self.supervisor == self.program.wiring.world:
            raise UsageError(
                f"the supervisor {self.supervisor!r} is the world: it ticks in every row, and nobody takes its place",
                hint="make the node that acts the supervisor, or use rollout(), which works with any",
            )
        raise UsageError(f"the outputs of the supervisor {self.supervisor!r} are given: it makes no steps")

    def only_turn(self) -> int:
        """Return the supervisor's one slot.

        Raises:
            UsageError: When it has none, or several.
        """
        first = self.first_turn()
        if len(self.turns) > 1:
            raise UsageError(
                f"the supervisor {self.supervisor!r} makes up to {len(self.turns)} steps in a row of these timelines",
                hint="draw timelines without bursts, leave the episodes with a hiccup out, or use reset() and step()",
            )
        return first

    def to_first(self, gs: GraphState) -> tuple[GraphState, StepState]:
        """Run from the start of an episode to the supervisor's first step."""
        gs = self.program.run_slots(gs, 0, self.first_turn(), {})
        found = self.program.seq(gs, self.turns[0]) >= 0
        return self._stand(*self._search(gs, jnp.int32(0), found, int(self.places[:, 0].max())))

    def turn_of(self, gs: GraphState, k: Any) -> Any:
        """Return at which of its turns the supervisor makes step ``k``."""
        return jnp.asarray(self.places)[gs.eps, jnp.maximum(k, 0)] % len(self.turns)

    def to_next(self, gs: GraphState, turn: Any, ended: Any) -> tuple[GraphState, StepState]:
        """Run from behind the supervisor's step at ``turn`` to its next one; an episode that has ``ended`` stays."""
        return self._stand(*self._search(gs, turn, ended, int(np.diff(self.places, axis=1).max(initial=1))))

    def seen(self, gs: GraphState, turn: Any) -> StepState:
        """Return what the supervisor sees at a turn; ``seq`` is -1 where it makes no step."""
        step_state = self.program.step_state(gs, self.turns[0])
        for i, slot in enumerate(self.turns[1:], start=1):
            step_state = select(turn == i, self.program.step_state(gs, slot), step_state)
        return step_state

    def _stand(self, gs: GraphState, turn: Any) -> tuple[GraphState, StepState]:
        """Return the state that awaits a step of the supervisor, and what it sees."""
        step_state = self.seen(gs, turn)
        return gs.replace(seq={self.supervisor: step_state.seq}), step_state  # pyright: ignore[reportAttributeAccessIssue]

    def _hop(self, gs: GraphState, i: int) -> GraphState:
        """Run from the supervisor's turn ``i`` of a row to its next turn, in this row or the next one."""
        slots = len(self.program.wiring.slots)
        if i + 1 < len(self.turns):
            return self.program.run_slots(gs, self.turns[i] + 1, self.turns[i + 1], {}, inside=True)
        gs = self.program.run_slots(gs, self.turns[i] + 1, slots, {}, inside=True)
        gs = self.program.run_world(gs, {}, inside=True)
        return self.program.run_slots(gs, 0, self.turns[0], {})

    def _search(self, gs: GraphState, turn: Any, found: Any, hops: int) -> tuple[GraphState, Any]:
        """Hop on until the supervisor makes a step, ``hops`` times at most; return the state and its turn.

        What is computed behind the step that was found, and behind the last row, is selected away. A loop, and not row
        after row: the program is as large as one row, however many lie between two steps.
        """
        turns = len(self.turns)

        def sweep(carry: Any, _: None) -> tuple[Any, None]:
            gs, turn, found = carry
            for i in range(turns):
                active = ~found & (gs.step < self.rows)
                active = active if turns == 1 else active & (turn == i)
                gs = select(active, self._hop(gs, i), gs)
                arrived = (i + 1) % turns
                turn = jnp.where(active, arrived, turn)
                found = found | (active & (self.program.seq(gs, self.turns[arrived]) >= 0))
            return (gs, turn, found), None

        sweeps = hops if turns == 1 else -(-hops // turns) + (hops > 0)  # one more, as it starts at any turn
        carry = (gs, jnp.asarray(turn, jnp.int32), jnp.asarray(found))
        if sweeps == 1:
            carry, _ = sweep(carry, None)
        elif sweeps:
            carry, _ = jax.lax.scan(sweep, carry, length=sweeps)
        return carry[0], carry[1]
