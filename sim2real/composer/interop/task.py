"""A composed task as the adapters need it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from sim2real.composer.interop.moment import Moment
from sim2real.composer.physics.mjx.environment import MjxEnvironment, State
from sim2real.errors import UsageError


class PureTask:
    """A task on MJX; see ``PureEnvironment``.

    Args:
        flat: Whether the observation is one vector, instead of a dictionary.
    """

    def __init__(self, environment: MjxEnvironment, flat: bool) -> None:
        self.environment, self._flat = environment, flat

    def reset(self, key: jax.Array) -> Moment:
        """Return a copy at the start of an episode."""
        return self._moment(self.environment.reset(key))

    def step(self, state: State, action: jax.Array) -> Moment:
        """Return the copy one control step later."""
        return self._moment(self.environment.step(state, action))

    def cut(self, state: State) -> jax.Array:
        """Return whether the time limit has ended the episode."""
        return state.truncated

    def reseed(self, state: Any, key: jax.Array) -> Any:
        """Return a state that goes on from ``key`` if it is the start of an episode."""
        return self.environment.select(state.steps == 0, state.replace(key=key), state)

    def _moment(self, state: State) -> Moment:
        observation = state.observation
        shown = jnp.concatenate([jnp.ravel(v) for v in observation.values()]) if self._flat else observation
        info = {"discount": state.discount, "failed": state.failed}
        ended = state.done & ~state.truncated
        return Moment(state, shown, state.reward, ended, state.truncated, info, {})


def check_shown(environment: MjxEnvironment) -> dict[str, jax.ShapeDtypeStruct]:
    """Return what a task shows its policy: name -> shape and dtype.

    Raises:
        UsageError: When that is nothing.
    """
    shown = environment.observation_spec()
    if not shown:
        task = environment.task
        there = ", ".join(map(repr, task.observables)) or "none"
        raise UsageError(
            f"task {type(task).__name__} shows its policy nothing: no observable is enabled. There are: {there}",
            hint="set `enabled = True` for what the policy may see; a robot with its delays comes from "
            "sim2real.interop",
        )
    return shown
