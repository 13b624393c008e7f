"""The devices of a training: a row for each group of seeds, in which each has some of their copies.

The policies of a sweep count as seeds.
"""

import math
from typing import TypeVar

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig

SEEDS, COPIES = "seeds", "copies"
"""Names of the mesh's axes."""
T = TypeVar("T")


def mesh_of(config: PPOConfig) -> Mesh | None:
    """Return the devices, those of a seed in a row; None for one device."""
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
            f"{by_copy} devices a seed do not divide its copies",
            hint=f"make num_envs a multiple of {by_copy}",
        )
    # Devices of one host are neighbours in the mesh.
    by_process = [[d for d in jax.devices() if d.process_index == p] for p in range(jax.process_count())]
    devices = [device for devices in by_process for device in devices[: config.devices]]
    return Mesh(np.array(devices).reshape(by_seed, by_copy), (SEEDS, COPIES), (AxisType.Auto,) * 2)


def divide_minibatches(arrays: T, config: PPOConfig) -> T:
    """Return minibatches that the devices of a seed divide.

    A minibatch has copies from all devices. Without this constraint the compiler makes each device compute all of it.

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
