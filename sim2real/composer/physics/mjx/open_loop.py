"""Whether the physics can be taken out of a task: its hooks get a physics that refuses to read the state."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from sim2real.composer.physics.mjx.environment import MjxEnvironment, State
from sim2real.composer.physics.mjx.warp import warp_fields
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.types import PyTree


class UnreadData:
    """An ``mjx.Data`` of which only some fields can be read and set.

    Args:
        user: Who reads it, for the error.
    """

    def __init__(self, data: PyTree, readable: tuple[str, ...], user: str) -> None:
        self._data, self._readable, self._user = data, readable, user

    def __getattr__(self, name: str) -> PyTree:
        if name == "__dataclass_fields__":
            return self._data.__dataclass_fields__
        if name == "_impl":
            return UnreadData(self._data._impl, (), self._user)
        if name not in self._readable:
            raise UsageError(f"{self._user} {name!r} of the state")
        return getattr(self._data, name)

    def replace(self, **values: jax.Array) -> UnreadData:
        """Return the data with other values; UsageError for fields that cannot be read."""
        for name in values:
            getattr(self, name)
        return UnreadData(self._data.replace(**values), self._readable, self._user)


def check(
    environment: MjxEnvironment,
    entered: Callable[[State, jax.Array], State],
    output: Callable[[PyTree], PyTree],
    name: str,
) -> None:
    """Refuse a task whose hooks use what the physics computes.

    At the start they may use and set ``qpos`` and ``qvel``, and fields of the model; in a step the controls. The
    message may use positions, velocities and accelerations.

    Args:
        entered: Maps state and action to the state with which a control step begins.

    Raises:
        UsageError: With what is used.
    """

    def start(key: jax.Array) -> State:
        data = UnreadData(environment.initial, ("qpos", "qvel", "ctrl"), "hooks use at the start")
        place = (environment.initial.qpos, environment.initial.qvel)
        state = environment.reset_apart(key, None, place, data)
        return dataclasses.replace(state, data=state.data._data)

    def tick(state: State, action: jax.Array) -> jax.Array:
        data: PyTree = UnreadData(state.data, ("ctrl",), "hooks use in a step")
        after, controls = environment.step_apart(entered(dataclasses.replace(state, data=data), action), action)
        if changed := [k for k, leaf in after.leaves.items() if leaf is not state.leaves[k]]:
            raise UsageError(f"hooks set {changed[0]!r} of the model in a step")
        return controls

    def message(state: State) -> PyTree:
        data = UnreadData(state.data, ("qpos", "qvel", "qacc"), "its message uses")
        return output(SimpleNamespace(data=data))

    try:
        if warp_fields.is_warp(environment.mjx_model):
            raise UsageError("it is one of MuJoCo Warp's")
        state = jax.eval_shape(start, jax.random.key(0))
        spec = environment.action_spec()
        jax.eval_shape(tick, state, jnp.zeros(spec.shape, jax.dtypes.canonicalize_dtype(spec.dtype)))
        jax.eval_shape(message, state)
    except (UsageError, AttributeError) as error:
        raise UsageError(
            f"the physics of world {name!r} cannot run outside of the program: {error.args[0]}",
            hint="use the compiled engine",
        ) from None
