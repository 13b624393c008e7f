"""Pushes: sudden changes of the joints' velocities at random times, as if something had hit the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode
from sim2real.training.environment.variation import VariationConfig


@dataclass(frozen=True)
class Pushes:
    """Pushes of each joint, independent of the others, at the times of policy steps.

    Attributes:
        world: World with ``velocity(state)``, the joints' velocities ``()`` or ``(joints,)`` [rad/s, or m/s], and
            ``with_velocity(state, velocity)``. A world with a floating base (``floats``) has the base's velocities:
            linear ``(3,)`` [m/s], then angular ``(3,)`` [rad/s].
        sizes: Largest change of each velocity, or one number for all [rad/s, or m/s]; changes are uniform in both
            directions. For a floating base six numbers, linear ones first.
        chance: Probability that a joint is pushed in a row.
    """

    node: str
    world: Any
    sizes: tuple[float, ...]
    chance: float

    @staticmethod
    def of(vary: VariationConfig, world: BaseNode, rate_hz: float) -> Pushes | None:
        """Return the configured pushes for a policy of ``rate_hz``; None if there are none."""
        if not vary.push:
            return None
        if not hasattr(world, "with_velocity"):
            raise UsageError(
                f"a {type(world).__name__} cannot be pushed: it has no `velocity` and `with_velocity`",
                hint="give the world velocity(state) and with_velocity(state, velocity), or leave out --vary.push",
            )
        if vary.push_hz > rate_hz:
            raise UsageError(f"vary.push_hz must not exceed the policy's rate, {rate_hz:g} Hz, got {vary.push_hz:g}")
        floating_base, angular = getattr(world, "floats", False), vary.push_angular
        if angular is not None and not floating_base:
            raise UsageError(
                f"vary.push_angular: a {type(world).__name__} has no floating base", hint="--vary.push pushes joints"
            )
        every = vary.push if angular is None else angular
        sizes = (vary.push,) * 3 + (every,) * 3 if floating_base else (vary.push,)
        return Pushes(world.name, world, sizes, vary.push_hz / rate_hz)

    def kicks(self, key: jax.Array, shape: tuple[int, ...], width: jax.Array | None = None) -> jax.Array:
        """Draw the changes of the velocities in a row, 0 for a joint that is not pushed.

        Args:
            width: Share of ``sizes``; None: all of them.
        """
        k_whether, k_how = jax.random.split(key)
        size = jnp.float32(self.sizes[0] if len(self.sizes) == 1 else self.sizes) * (1.0 if width is None else width)
        hit = jax.random.bernoulli(k_whether, self.chance, shape)
        return jnp.where(hit, size * jax.random.uniform(k_how, shape, minval=-1.0, maxval=1.0), 0.0)

    def named(self, kicks: jax.Array) -> list[tuple[str, str, jax.Array]]:
        """Return name, unit and values of drawn changes ``(N, len(sizes))``."""
        if len(self.sizes) == 1:
            return [("push", "rad/s", kicks)]
        return [("push", "m/s", kicks[:, :3]), ("push angular", "rad/s", kicks[:, 3:])]

    def apply(self, graph_state: GraphState, key: jax.Array, width: jax.Array | None = None) -> GraphState:
        """Return the graph's state after the pushes of a row; ``width`` as in ``kicks``."""
        state = graph_state.state[self.node]
        before = jnp.asarray(self.world.velocity(state))
        after = before + self.kicks(key, before.shape, width).astype(before.dtype)
        return graph_state.replace(state={**graph_state.state, self.node: self.world.with_velocity(state, after)})
