"""Training over several devices, of one host or of several: seeds and copies are divided, in one program."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from sim2real.training.config import PPOConfig
from sim2real.training.scale.mesh import COPIES, SEEDS, mesh_of
from sim2real.types import Array, PyTree

if TYPE_CHECKING:
    from sim2real.training.ppo.update import TrainState


T = TypeVar("T")


class Shardings(NamedTuple):
    """Where the arrays of a training lie.

    Attributes:
        state: A sharding for each array of its state.
        whole: The sharding of arrays with a copy on every device.
    """

    state: PyTree
    whole: NamedSharding


def shardings_of(state: TrainState, config: PPOConfig) -> Shardings | None:
    """Return where each array of a training's state goes; None for one device.

    Seeds are divided first, as they are independent; the devices of a seed divide its copies. The compiler inserts the
    exchange of gradients. Random numbers do not depend on the division.

    Args:
        state: With a leading seed axis; its ``copies`` have the copies as second axis.

    Raises:
        UsageError: There are too few devices, or they cannot divide seeds and copies.
    """
    if (mesh := mesh_of(config)) is None:
        return None
    by_seed = NamedSharding(mesh, PartitionSpec(SEEDS))
    split = NamedSharding(mesh, PartitionSpec(SEEDS, COPIES))
    shardings = jax.tree.map(lambda _: by_seed, state)._replace(copies=jax.tree.map(lambda _: split, state.copies))
    return Shardings(shardings, NamedSharding(mesh, PartitionSpec()))


def place(state: T, layout: Shardings | None) -> T:
    """Return a state on its devices; each process, which has the whole state in memory, puts its own part."""
    return state if layout is None else jax.tree.map(_put, state, layout.state)


def replicate(tree: T, layout: Shardings | None) -> T:
    """Return arrays with a copy on every device, from arrays in this process's memory."""
    return jax.tree.map(jnp.asarray if layout is None else lambda leaf: _put(leaf, layout.whole), tree)


def _put(leaf: Array, where: NamedSharding) -> jax.Array:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_put(jax.random.key_data(leaf), where), impl=jax.random.key_impl(leaf))
    array = np.asarray(leaf)
    return jax.make_array_from_callback(array.shape, where, lambda index: array[index])


def gather(state: T, layout: Shardings | None) -> T:
    """Return a state that this process can read, also the parts of other processes; all of them must call this."""
    if layout is None or jax.process_count() == 1:
        return state
    return jax.jit(lambda state: state, out_shardings=layout.whole)(state)
