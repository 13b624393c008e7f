"""The state before the first update."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.train.config import PPOConfig
from sim2real.train.networks import init_mlp
from sim2real.train.normaliser import Normaliser
from sim2real.train.optimiser import make_optimiser, set_rate
from sim2real.train.protocol import TrainingEnvironment, get_privileged
from sim2real.train.rollout import Copies
from sim2real.train.sweep import Sweep
from sim2real.train.update import TrainState

if TYPE_CHECKING:
    import optax


def make_start(env: TrainingEnvironment, configs: Sequence[PPOConfig], key: jax.Array) -> TrainState:
    """Return the states before the first update, with a leading axis; compiles nothing.

    The environments' states are zeros; the first rollout resets them.

    Args:
        env: The environment.
        configs: Settings; they may differ in numbers alone. The leading axis has all seeds of the first, then those of
            the next.
        key: Source of all randomness; seed i depends on it and on i alone.
    """
    first = configs[0]
    shapes = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0)))
    see = get_privileged(env, first)
    more = None if see is None else _length(jax.eval_shape(see, shapes[0]).shape)
    keys = jnp.stack([jax.random.fold_in(key, seed) for seed in range(first.num_seeds)])
    data = np.asarray(jax.random.key_data(keys))
    sizes = env.observation_size, np.shape(env.action_low)[0], more
    starts = [_networks(config, np.random.default_rng(own), sizes) for config in configs for own in data]
    params, optimiser, normaliser, privileged = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *starts)
    members = len(starts)
    copies = _blank(Copies(*shapes), (members, first.num_envs))
    keys = keys if len(configs) == 1 else jnp.tile(keys, len(configs))
    return TrainState(params, optimiser, normaliser, privileged, copies, jnp.zeros(members, jnp.int32), keys)


def swept_numbers(sweep: Sweep, num_seeds: int) -> dict[str, np.ndarray]:
    """Return setting -> its value for each place on the leading axis, float32."""
    return {n: np.repeat(np.array([point[n] for point in sweep.grid], np.float32), num_seeds) for n in sweep.values}


def _networks(
    config: PPOConfig, rng: np.random.Generator, sizes: tuple[int, int, int | None]
) -> tuple[dict[str, Any], optax.OptState, Normaliser, Normaliser | None]:
    """Return networks, optimiser and normalisers; ``sizes``: of observation, action and privileged observation."""
    size, actions, more = sizes
    params = {
        "actor": init_mlp(rng, (size, *config.hidden, actions), 0.01),
        "log_std": np.full(actions, config.log_std_init, np.float32),
        "value": init_mlp(rng, (size + (more or 0), *config.hidden, 1), 1.0),
    }
    optimiser = _blank(jax.eval_shape(make_optimiser(config).init, params), ())
    if config.schedule == "adaptive":
        optimiser = set_rate(optimiser, np.float32(config.learning_rate))
    return params, optimiser, _normaliser(size), None if more is None else _normaliser(more)


def _length(shape: tuple[int, ...]) -> int:
    if len(shape) != 1:
        raise UsageError(f"what the environment's `privileged` returns must be a vector, it has shape {shape}")
    return shape[0]


def _normaliser(size: int) -> Any:
    """Return statistics of nothing, in numpy."""
    blank: Any = (np.asarray(np.float32(0)), np.zeros(size, np.float32), np.ones(size, np.float32))
    return Normaliser(*blank)


T = TypeVar("T")


def _blank(shapes: T, leading: tuple[int, ...]) -> T:
    """Return zeros of given shapes and dtypes, with leading axes; in numpy, as jnp.zeros compiles for each shape."""

    def leaf(struct: jax.ShapeDtypeStruct) -> jax.Array | np.ndarray:
        is_key = jnp.issubdtype(struct.dtype, jax.dtypes.prng_key)
        return (jnp if is_key else np).zeros((*leading, *struct.shape), struct.dtype)

    return jax.tree.map(leaf, shapes)
