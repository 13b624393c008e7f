"""The state before the first update."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.train.config import PPOConfig
from sim2real.train.networks import init_mlp
from sim2real.train.optimiser import make_optimiser, set_rate
from sim2real.train.protocol import TrainingEnvironment
from sim2real.train.rollout import Copies
from sim2real.train.update import Normaliser, TrainState

if TYPE_CHECKING:
    import optax


def make_start(env: TrainingEnvironment, config: PPOConfig, key: jax.Array) -> TrainState:
    """Return the states before the first update, with a leading seed axis; compiles nothing.

    The environments' states are zeros; the first rollout resets them.

    Args:
        env: The environment.
        config: Settings.
        key: Source of all randomness; seed i depends on it and on i alone.
    """
    count, size, actions = config.num_envs, env.observation_size, np.shape(env.action_low)[0]
    keys = jnp.stack([jax.random.fold_in(key, seed) for seed in range(config.num_seeds)])

    def one(key_data: np.ndarray) -> tuple[dict[str, Any], optax.OptState, tuple[np.float32, np.ndarray, np.ndarray]]:
        rng = np.random.default_rng(key_data)
        params = {
            "actor": init_mlp(rng, (size, *config.hidden, actions), 0.01),
            "log_std": np.full(actions, config.log_std_init, np.float32),
            "value": init_mlp(rng, (size, *config.hidden, 1), 1.0),
        }
        optimiser = _blank(jax.eval_shape(make_optimiser(config).init, params), ())
        if config.schedule == "adaptive":
            optimiser = set_rate(optimiser, np.float32(config.learning_rate))
        return params, optimiser, (np.float32(0), np.zeros(size, np.float32), np.ones(size, np.float32))

    seeds = [one(data) for data in np.asarray(jax.random.key_data(keys))]
    params, optimiser, normaliser = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *seeds)
    copies = Copies(*jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0))))
    updates = jnp.zeros(config.num_seeds, jnp.int32)
    return TrainState(
        params, optimiser, Normaliser(*normaliser), _blank(copies, (config.num_seeds, count)), updates, keys
    )


T = TypeVar("T")


def _blank(shapes: T, leading: tuple[int, ...]) -> T:
    """Return zeros of given shapes and dtypes, with leading axes; in numpy, as jnp.zeros compiles for each shape."""

    def leaf(struct: jax.ShapeDtypeStruct) -> jax.Array | np.ndarray:
        is_key = jnp.issubdtype(struct.dtype, jax.dtypes.prng_key)
        return (jnp if is_key else np).zeros((*leading, *struct.shape), struct.dtype)

    return jax.tree.map(leaf, shapes)
