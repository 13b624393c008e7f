"""Networks over the rows of a rollout: all rows at once, or in the order of time if the network has memory."""

from functools import partial
from typing import NamedTuple

import jax

from sim2real.training.environment.protocol import select
from sim2real.training.networks.architectures import Network, is_recurrent
from sim2real.training.ppo.rollout import repeat
from sim2real.types import PyTree


class ActorCritic(NamedTuple):
    """The networks of a training.

    Attributes:
        actor: Computes the mean of the actions.
        critic: Computes the value.
        name: The actor's name in a bundle.
    """

    actor: Network
    critic: Network
    name: str


class Unrolled(NamedTuple):
    """The outputs of a network for T rows of N copies.

    Attributes:
        carry: The carry after the last row; leaves of shape ``(N, ...)``.
        y: Shape ``(T, N, outputs)``.
        following: Shape ``(T, N, outputs)``: outputs for the inputs after each row; None without such inputs.
    """

    carry: PyTree
    y: jax.Array
    following: jax.Array | None


def unroll(
    network: Network,
    params: PyTree,
    carry: PyTree,
    x: jax.Array,
    stepped: jax.Array,
    end: jax.Array,
    following: jax.Array | None = None,
) -> Unrolled:
    """Apply a network to rows, with an initial carry after an episode's end.

    Args:
        carry: The carry before the first row; leaves of shape ``(N, ...)``.
        x: Shape ``(T, N, inputs)``.
        stepped: Shape ``(T, N)``, bool: rows with a policy step.
        end: Shape ``(T, N)``, bool: rows that end an episode.
        following: Shape ``(T, N, inputs)``: the input after each row, before any reset.
    """
    apply = partial(network.apply, params)
    if not is_recurrent(network):
        # Without memory, all rows are independent.
        rows = jax.vmap(jax.vmap(lambda x: apply(network.initial_carry(), x)[1]))
        return Unrolled(carry, rows(x), None if following is None else rows(following))
    # With memory, scan over the rows.
    start = repeat(network.initial_carry(), x.shape[1])

    def row(
        carry: PyTree, now: tuple[jax.Array, jax.Array, jax.Array, jax.Array | None]
    ) -> tuple[PyTree, tuple[jax.Array, jax.Array | None]]:
        x, stepped, end, following = now
        # A row without a policy step leaves the carry unchanged, the end of an episode resets it.
        new, y = jax.vmap(apply)(carry, x)
        new = select(stepped, new, carry)
        after = None if following is None else jax.vmap(apply)(new, following)[1]
        return select(end, start, new), (y, after)

    carry, (y, after) = jax.lax.scan(row, carry, (x, stepped, end, following))
    return Unrolled(carry, y, after)
