"""The state before the first update."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.training.config import PPOConfig
from sim2real.training.environment.protocol import TrainingEnvironment, get_privileged
from sim2real.training.networks.architectures import Factory, make_network, name_of
from sim2real.training.networks.normaliser import Normaliser
from sim2real.training.networks.sequences import ActorCritic
from sim2real.training.ppo.optimiser import make_optimiser, set_rate
from sim2real.training.ppo.rollout import Copies
from sim2real.training.ppo.update import TrainState
from sim2real.training.sweep import Sweep
from sim2real.types import Array, PyTree

if TYPE_CHECKING:
    import optax

T = TypeVar("T")


def make_initial_state(
    env: TrainingEnvironment, configs: Sequence[PPOConfig], key: jax.Array, networks: ActorCritic
) -> TrainState:
    """Return the states before the first update, with a leading axis; compiles nothing.

    Args:
        configs: Settings that differ only in numbers. The leading axis has all seeds of the first, then those of the
            next.
        key: Seed i depends on it and on i alone.
    """
    first = configs[0]
    keys = jnp.stack([jax.random.fold_in(key, seed) for seed in range(first.num_seeds)])
    key_data = np.asarray(jax.random.key_data(keys))

    # Networks, optimiser and normalisers of each place on the leading axis.
    sizes = env.observation_size, np.shape(env.action_low)[0], privileged_size(env, first)
    rngs = ((config, np.random.default_rng(data)) for config in configs for data in key_data)
    learners = [_new_learner(config, networks, rng, sizes) for config, rng in rngs]
    params, optimiser, normaliser, privileged = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *learners)

    # The environments' states are zeros; the first rollout resets them.
    shapes = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0)))
    members = len(learners)
    count = members, first.num_envs
    carries = (net.initial_carry() for net in (networks.actor, networks.critic))
    copies = Copies(*_blank(shapes, count), *(_repeated(carry, count) for carry in carries))
    keys = keys if len(configs) == 1 else jnp.tile(keys, len(configs))
    # The share of a curriculum that follows success.
    follows = env.curriculum is not None and env.follow > 0.0
    reached = jnp.full(members, env.curriculum[0], jnp.float32) if env.curriculum is not None and follows else None
    return TrainState(params, optimiser, normaliser, privileged, copies, jnp.zeros(members, jnp.int32), keys, reached)


def swept_numbers(sweep: Sweep, num_seeds: int) -> dict[str, Array]:
    """Return setting -> its value for each place on the seed axis, float32."""
    return {n: np.repeat(np.array([point[n] for point in sweep.grid], np.float32), num_seeds) for n in sweep.values}


def make_networks(
    env: TrainingEnvironment, config: PPOConfig, actor: Factory | None = None, critic: Factory | None = None
) -> ActorCritic:
    """Return the networks of a training.

    Args:
        actor: Default: ``config.network``.
        critic: Default: ``config.critic``, or the actor's network.

    Raises:
        UsageError: There is no such network, or it does not fit.
    """
    kind = actor or config.network
    critic_kind = critic or config.critic or kind
    size, actions = env.observation_size, np.shape(env.action_low)[0]
    critic_size = size + (privileged_size(env, config) or 0)
    return ActorCritic(
        actor=make_network(kind, config.hidden, size, actions),
        critic=make_network(critic_kind, config.hidden, critic_size, 1, exported=False),
        name=name_of(kind),
    )


def privileged_size(env: TrainingEnvironment, config: PPOConfig) -> int | None:
    """Return the number of the value function's further inputs; None if ``config`` has none."""
    privileged = get_privileged(env, config)
    if privileged is None:
        return None
    state = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0)))[0]
    shape = jax.eval_shape(privileged, state).shape
    if len(shape) != 1:
        raise UsageError(f"the environment's `privileged` must return a vector, it has shape {shape}")
    return shape[0]


def _repeated(carry: T, count: tuple[int, ...]) -> T:
    """Return a copy of a carry for each copy of the environment."""
    return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (*count, *np.shape(leaf))), carry)


def _new_learner(
    config: PPOConfig, networks: ActorCritic, rng: np.random.Generator, sizes: tuple[int, int, int | None]
) -> tuple[dict[str, PyTree], optax.OptState, Normaliser, Normaliser | None]:
    """Return networks, optimiser and normalisers; ``sizes``: of observation, action and privileged observation."""
    size, actions, privileged = sizes
    params = {
        "actor": networks.actor.init(rng, size, 0.01),
        "log_std": np.full(actions, config.log_std_init, np.float32),
        "value": networks.critic.init(rng, size + (privileged or 0), 1.0),
    }
    optimiser = _blank(jax.eval_shape(make_optimiser(config).init, params), ())
    if config.schedule == "adaptive":
        optimiser = set_rate(optimiser, np.float32(config.learning_rate))
    return params, optimiser, _new_normaliser(size), None if privileged is None else _new_normaliser(privileged)


def _new_normaliser(size: int) -> Normaliser:
    """Return the statistics before the first observation, in numpy."""
    return Normaliser(np.asarray(np.float32(0)), np.zeros(size, np.float32), np.ones(size, np.float32))


def _blank(shapes: T, leading: tuple[int, ...]) -> T:
    """Return zeros of given shapes and dtypes, with leading axes; in numpy, as jnp.zeros compiles for each shape."""

    def leaf(struct: jax.ShapeDtypeStruct) -> jax.Array | np.ndarray:
        is_key = jnp.issubdtype(struct.dtype, jax.dtypes.prng_key)
        return (jnp if is_key else np).zeros((*leading, *struct.shape), struct.dtype)

    return jax.tree.map(leaf, shapes)
