"""Networks over the rows of a rollout: all at once, or one after the other where they remember."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax

from sim2real.train.networks.architectures import Network, is_recurrent
from sim2real.train.networks.policy import Policy
from sim2real.train.ppo.rollout import select, spread


class ActorCritic(NamedTuple):
    """The networks of a training.

    Attributes:
        actor: Gives the mean of the actions.
        critic: Gives the value.
        name: The actor's, as a bundle has it.
        teacher: Whom the actor imitates; None: it learns from rewards.
    """

    actor: Network
    critic: Network
    name: str
    teacher: Policy | None = None


class Unrolled(NamedTuple):
    """What a network made of T rows of N copies.

    Attributes:
        carry: What it carries on after the last row; leaves of shape ``(N, ...)``.
        y: Shape ``(T, N, outputs)``: its output.
        following: Shape ``(T, N, outputs)``: its output for what followed the row; None: not asked for.
    """

    carry: Any
    y: jax.Array
    following: jax.Array | None


def unroll(
    network: Network,
    params: Any,
    carry: Any,
    x: jax.Array,
    stepped: jax.Array,
    end: jax.Array,
    following: jax.Array | None = None,
) -> Unrolled:
    """Apply a network to rows; it begins anew after an episode's end, and stays as it is in rows without a policy step.

    Args:
        carry: What it carries into the first row; leaves of shape ``(N, ...)``.
        x: Shape ``(T, N, inputs)``.
        stepped: Shape ``(T, N)``, bool: rows with a policy step.
        end: Shape ``(T, N)``, bool: rows that end an episode.
        following: Shape ``(T, N, inputs)``: the input after each row, before any reset.
    """
    apply = partial(network.apply, params)
    if not is_recurrent(network):
        once = jax.vmap(jax.vmap(lambda x: apply(network.initial_carry(), x)[1]))
        return Unrolled(carry, once(x), None if following is None else once(following))
    start = spread(network.initial_carry(), x.shape[1])

    def row(carry: Any, now: tuple[Any, ...]) -> tuple[Any, tuple[jax.Array, jax.Array | None]]:
        x, stepped, end, following = now
        moved, y = jax.vmap(apply)(carry, x)
        moved = select(stepped, moved, carry)
        after = None if following is None else jax.vmap(apply)(moved, following)[1]
        return select(end, start, moved), (y, after)

    carry, (y, after) = jax.lax.scan(row, carry, (x, stepped, end, following))
    return Unrolled(carry, y, after)
