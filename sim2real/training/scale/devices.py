"""Training over several devices, of one host or of several: seeds and copies are divided, in one program.

The mesh of devices has a row for each group of seeds; the devices of a row divide the copies of these seeds. The
policies of a sweep count as seeds.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig
from sim2real.types import Array, PyTree

if TYPE_CHECKING:
    from sim2real.training.ppo.update import TrainState

T = TypeVar("T")
SEEDS, COPIES = "seeds", "copies"
"""Names of the mesh's axes."""


def mesh_of(config: PPOConfig) -> Mesh | None:
    """Return the mesh of devices, with the devices of a seed in a row; None for one device."""
    available = jax.local_devices()
    if config.devices > len(available):
        raise UsageError(
            f"devices={config.devices}, but JAX finds {len(available)} on this host: {available[0].device_kind}",
            hint="on a CPU, XLA_FLAGS=--xla_force_host_platform_device_count=8 makes 8 of it, for tests",
        )
    if (total := config.devices * jax.process_count()) == 1:
        return None

    # Divide the seeds by as many devices as possible, then the copies of a seed.
    by_seed = math.gcd(config.num_seeds, total)
    by_copy = total // by_seed
    if config.num_envs % by_copy:
        raise UsageError(
            f"{total} devices cannot divide {config.num_seeds} seeds of {config.num_envs} copies: "
            f"{by_copy} devices for each seed do not divide its copies",
            hint=f"make num_envs a multiple of {by_copy}",
        )
    # Devices of one host are neighbours in the mesh.
    by_process = [[d for d in jax.devices() if d.process_index == p] for p in range(jax.process_count())]
    devices = [device for devices in by_process for device in devices[: config.devices]]
    return Mesh(np.array(devices).reshape(by_seed, by_copy), (SEEDS, COPIES), (AxisType.Auto,) * 2)


def divide_minibatches(arrays: T, config: PPOConfig) -> T:
    """Constrain minibatches so that the devices of a seed divide them.

    A minibatch has copies from all devices. Without this constraint, the compiler makes each device compute all of it.

    Args:
        arrays: Leaves of shape ``(B, M, ...)``: B minibatches of M copies.
    """
    mesh = mesh_of(config)

    def constrain(leaf: jax.Array) -> jax.Array:
        if mesh is None or leaf.shape[1] % mesh.shape[COPIES]:
            return leaf
        where = PartitionSpec(None, COPIES, *[PartitionSpec.UNCONSTRAINED] * (leaf.ndim - 2))
        return jax.lax.with_sharding_constraint(leaf, NamedSharding(mesh, where))

    return jax.tree.map(constrain, arrays)


class Shardings(NamedTuple):
    """The placement of a training's arrays on devices.

    Attributes:
        state: A sharding for each array of its state.
        whole: The sharding of arrays with a copy on every device.
    """

    state: PyTree
    whole: NamedSharding


def shardings_of(state: TrainState, config: PPOConfig) -> Shardings | None:
    """Return the placement of each array of a training's state; None for one device.

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
    """Put a state on its devices; each process has the whole state in memory, and puts its own part."""
    return jax.device_put(state) if layout is None else jax.tree.map(_put, state, layout.state)


def replicate(tree: T, layout: Shardings | None) -> T:
    """Put a copy of arrays in this process's memory on every device."""
    return jax.device_put(tree) if layout is None else jax.tree.map(lambda leaf: _put(leaf, layout.whole), tree)


def _put(leaf: Array, where: NamedSharding) -> jax.Array:
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_put(jax.random.key_data(leaf), where), impl=jax.random.key_impl(leaf))
    array = np.asarray(leaf)
    return jax.make_array_from_callback(array.shape, where, lambda index: array[index])


def gather(state: T, layout: Shardings | None) -> T:
    """Return a state that this process can read, with the parts of other processes; all processes must call this."""
    if layout is None or jax.process_count() == 1:
        return state
    return jax.jit(lambda state: state, out_shardings=layout.whole)(state)
