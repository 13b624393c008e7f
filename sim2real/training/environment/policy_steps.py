"""An environment in which every call of ``step`` is a step of the policy, for learners other than our PPO."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.training.environment.protocol import Step, choose

if TYPE_CHECKING:
    from sim2real.training.environment.graph_environment import EnvState, GraphEnvironment


class PolicySteps:
    """A ``GraphEnvironment`` without rows in which the policy makes no step.

    A graph has such rows where the policy paused, or where its rate does not divide the world's; ``Step.valid`` marks
    them for our PPO. Here such a row belongs to the policy's step before it: its reward is added to that step's, and
    the observation is that of the next step. An episode ends at the policy's last step in the timeline, whose
    observation is the final one.

    If the policy makes a step in every row, the environment inside is used unchanged, at no cost.

    Raises:
        UsageError: The policy makes fewer than two steps in a timeline.
    """

    def __init__(self, env: GraphEnvironment) -> None:
        turns = env.graph.turns
        if (turns.sum(axis=1) < 2).any():
            raise UsageError(
                f"the policy {env.task.supervisor!r} makes fewer than two steps in a timeline",
                hint="draw longer timelines",
            )
        self.env = env
        self.observation_size = env.observation_size
        self.action_low, self.action_high = env.action_low, env.action_high
        self._last = turns.shape[1] - 1 - np.argmax(turns[:, ::-1], axis=1)
        self._wait = int(np.argmax(turns, axis=1).max())  # rows before the first step
        self._gap = max(int(np.diff(np.flatnonzero(t)).max()) for t in turns) - 1
        self._always = bool(turns.all())

    @property
    def length(self) -> int:
        """Largest number of steps of an episode."""
        return int(self.env.graph.turns.sum(axis=1).max()) - 1

    def reset(self, key: jax.Array) -> tuple[EnvState, jax.Array]:
        """Start an episode, and run to the policy's first step."""
        state, observation = self.env.reset(key)
        if not self._wait:
            return state, observation
        idle = jnp.asarray(self.action_low, jnp.float32)

        def play(now: tuple[EnvState, jax.Array], _: None) -> tuple[tuple[EnvState, jax.Array], None]:
            result = self.env.step(now[0], idle, key)
            # The policy has not acted yet: rewards so far are no part of the episode's return.
            state = result.state._replace(total=now[0].total, good=now[0].good)
            return choose(jnp.asarray(now[0].step_state.seq >= 0), now, (state, result.observation)), None

        return jax.lax.scan(play, (state, observation), length=self._wait)[0]

    def step(self, state: EnvState, action: jax.Array, key: jax.Array) -> Step:
        """Make a step of the policy with ``action (A,)`` [the action's units], and run to its next one."""
        result = self._truncated(self.env.step(state, action, key))

        def play(now: Step, _: None) -> tuple[Step, None]:
            following = self._truncated(self.env.step(now.state, action, key))
            following = following._replace(reward=now.reward + following.reward, valid=now.valid)
            over = now.terminated | now.truncated | (now.state.step_state.seq >= 0)
            return choose(over, now, following), None

        return jax.lax.scan(play, result, length=self._gap)[0] if self._gap else result

    def _truncated(self, row: Step) -> Step:
        """Return a row, truncated if it leads to the policy's last step."""
        if self._always:
            return row
        graph = row.state.graph
        return row._replace(truncated=row.truncated | (graph.step >= jnp.asarray(self._last)[graph.eps]))
