"""Training over several devices of a host: seeds and copies are divided among them, in one program."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from sim2real.errors import UsageError
from sim2real.train.config import PPOConfig

if TYPE_CHECKING:
    from sim2real.train.update import TrainState

_SEEDS, _COPIES = "seeds", "copies"


def placements(state: TrainState, config: PPOConfig) -> Any:
    """Return where each array of a training's state goes: a sharding for each; None for one device.

    Seeds are divided first, as they have nothing to tell each other; the devices of a seed divide its copies. The
    compiler sees to it that they exchange what an update needs. Random numbers do not depend on it.

    Args:
        state: The state, with a leading seed axis; the environments' part has the copies as its second axis.
        config: Numbers of devices, seeds and copies.

    Raises:
        UsageError: When there are not as many devices, or they cannot divide seeds and copies.
    """
    if config.devices == 1:
        return None
    there = jax.local_devices()
    if config.devices > len(there):
        raise UsageError(
            f"devices={config.devices}, but JAX finds {len(there)} on this host: {there[0].device_kind}",
            hint="on a CPU, XLA_FLAGS=--xla_force_host_platform_device_count=8 makes 8 of it, for tests",
        )
    by_seed = math.gcd(config.num_seeds, config.devices)
    by_copy = config.devices // by_seed
    if config.num_envs % by_copy:
        raise UsageError(
            f"{config.devices} devices cannot divide {config.num_seeds} seeds of {config.num_envs} copies: "
            f"{by_copy} devices a seed do not divide its copies",
            hint=f"make num_envs a multiple of {by_copy}",
        )
    mesh = Mesh(np.array(there[: config.devices]).reshape(by_seed, by_copy), (_SEEDS, _COPIES))
    whole = NamedSharding(mesh, PartitionSpec(_SEEDS))
    split = NamedSharding(mesh, PartitionSpec(_SEEDS, _COPIES))
    return jax.tree.map(lambda _: whole, state)._replace(copies=jax.tree.map(lambda _: split, state.copies))
