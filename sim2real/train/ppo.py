"""Proximal policy optimisation (PPO) of several seeds in one compiled program.

The program does everything from one evaluation to the next, for all seeds: rollouts, updates and the evaluation. The
host calls it ``evaluations`` times. So there is one compilation, nothing waits for the host in between, and only a few
numbers are transferred.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.train.config import PPOConfig as PPOConfig
from sim2real.train.devices import placements
from sim2real.train.networks import Policy, init_mlp
from sim2real.train.protocol import TrainingEnvironment, check_environment
from sim2real.train.rollout import Copies, evaluate
from sim2real.train.update import Normaliser, TrainState, keys, make_optimiser, make_policy, update

if TYPE_CHECKING:
    import optax


@dataclasses.dataclass(frozen=True)
class Progress:
    """Progress of the training at an evaluation.

    Attributes:
        evaluation: Number of this evaluation, from 1.
        evaluations: Number of evaluations in all.
        env_steps: Number of rows so far, per seed.
        elapsed_s: Time since ``train`` was called, compilation included [s].
        values: Name -> shape ``(num_seeds,)``: ``return``, the environment's metrics, losses.
    """

    evaluation: int
    evaluations: int
    env_steps: int
    elapsed_s: float
    values: dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """The result of a training.

    Attributes:
        policies: The policies at the end; leaves have a leading seed axis.
        best: The policy with the highest success rate over all seeds and evaluations; of equals, the highest return.
        best_seed: Its seed.
        history: Name -> shape ``(evaluations, num_seeds)``: the values of ``Progress``.
        env_steps: Shape ``(evaluations,)``: number of rows per seed at each evaluation.
        elapsed_s: Shape ``(evaluations,)``: time since ``train`` was called [s].
        env_steps_per_s: Rows of all seeds per second of ``train_s``, those of evaluations not counted.
        compile_s: Time to trace and compile [s].
        train_s: Time to train and evaluate [s].
    """

    policies: Policy
    best: Policy
    best_seed: int
    history: dict[str, np.ndarray]
    env_steps: np.ndarray
    elapsed_s: np.ndarray
    env_steps_per_s: float
    compile_s: float
    train_s: float


def train(
    env: TrainingEnvironment, config: PPOConfig, key: jax.Array, on_progress: Callable[[Progress], None] | None = None
) -> TrainResult:
    """Train ``num_seeds`` policies.

    Args:
        env: One copy of the environment.
        config: Settings.
        key: Source of all randomness, from ``jax.random.key`` or ``PRNGKey``; seed i depends on it and on i alone.
        on_progress: Called after every evaluation; an exception that it raises ends the training.

    Raises:
        UsageError: The environment breaks its protocol, or no evaluation episode ended within ``eval_steps``.
        Sim2RealError: An observation, a reward or a loss is not finite.
    """
    start = time.perf_counter()
    check_environment(env)
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    state = _init(env, config, key if typed else jax.random.wrap_key_data(key))
    where = placements(state, config)
    state = state if where is None else jax.device_put(state, where)
    one = jax.vmap(lambda state: _epoch(env, config, state))
    epoch = jax.jit(one, donate_argnums=0, out_shardings=where and (where, None, None)).lower(state).compile()
    compiled = time.perf_counter()
    log: list[Progress] = []
    snapshots: list[Policy] = []
    for evaluation in range(1, config.evaluations + 1):
        state, policies, values = epoch(state)
        values = jax.device_get(values)
        env_steps = evaluation * config.updates_per_evaluation * config.steps_per_update
        _check_values(values, env_steps, config)
        del values["finite_observation"]
        log.append(Progress(evaluation, config.evaluations, env_steps, time.perf_counter() - start, values))
        snapshots.append(jax.device_get(policies))
        if on_progress is not None:
            on_progress(log[-1])
    train_s = time.perf_counter() - compiled
    history = {name: np.stack([progress.values[name] for progress in log]) for name in log[0].values}
    best_evaluation, best_seed = _best(history)
    return TrainResult(
        policies=jax.tree.map(jnp.asarray, snapshots[-1]),
        best=jax.tree.map(jnp.asarray, snapshots[best_evaluation][best_seed]),
        best_seed=best_seed,
        history=history,
        env_steps=np.array([progress.env_steps for progress in log]),
        elapsed_s=np.array([progress.elapsed_s for progress in log]),
        env_steps_per_s=config.num_seeds * config.updates * config.steps_per_update / train_s,
        compile_s=compiled - start,
        train_s=train_s,
    )


def _epoch(
    env: TrainingEnvironment, config: PPOConfig, state: TrainState
) -> tuple[TrainState, Policy, dict[str, jax.Array]]:
    """Train one seed up to its next evaluation, and evaluate it."""
    state, stats = jax.lax.scan(
        lambda state, _: update(env, config, state), state, length=config.updates_per_evaluation
    )
    policy = make_policy(env, state.params, state.normaliser)
    finite = stats.pop("finite_observation").all(0)
    values = {name: leaf.mean(0) for name, leaf in stats.items()} | {"finite_observation": finite}
    return state, policy, values | evaluate(env, config, policy, keys(state)[2])


def _init(env: TrainingEnvironment, config: PPOConfig, key: jax.Array) -> TrainState:
    """Return the states before the first update, with a leading seed axis; compiles nothing.

    The environments' states are zeros; the first rollout resets them.
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


def _best(history: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return the index of the best evaluation and seed: by success, then by return, then the latest."""
    returns = history["return"]
    success = history.get("success", np.zeros_like(returns))
    evaluations, seeds = returns.shape
    cells = [(evaluation, seed) for evaluation in range(evaluations) for seed in range(seeds)]
    return max(cells, key=lambda cell: (success[cell], returns[cell], cell[0]))


def _check_values(values: dict[str, np.ndarray], env_steps: int, config: PPOConfig) -> None:
    """Raise if a value is not finite or no episode ended; causes are checked before their consequences."""
    for seed in range(config.num_seeds):
        when = f"(seed {seed}, within {env_steps} rows)"
        entries = np.flatnonzero(~values["finite_observation"][seed])
        if entries.size:
            raise Sim2RealError(
                f"entries {entries.tolist()} of the observation are not finite {when}",
                hint="the environment's reset or step makes them: check what these entries divide by or integrate",
            )
        if not np.isfinite(values["reward"][seed]):
            raise Sim2RealError(
                f"the reward is not finite {when}", hint="check what the environment's reward divides by"
            )
        lost = sorted(name for name in ("loss", "kl", "entropy") if not np.isfinite(values[name][seed]))
        if lost:
            raise Sim2RealError(
                f"the training's {' and '.join(lost)} is not finite {when}, observations and rewards are",
                hint=f"lower learning_rate (now {config.learning_rate}) or reward_scale (now {config.reward_scale})",
            )
        if values["finished"][seed] == 0:
            raise UsageError(
                f"no evaluation episode ended within eval_steps={config.eval_steps} rows",
                hint="raise eval_steps above the longest episode, or let the environment truncate",
            )
        bad = sorted(name for name, value in values.items() if not np.isfinite(value[seed]).all())
        if bad:
            raise Sim2RealError(f"metrics {', '.join(bad)} of finished episodes are not finite {when}")
