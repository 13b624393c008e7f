"""Proximal policy optimisation (PPO) of several seeds in one compiled program.

The program does everything from one evaluation to the next, for all seeds: rollouts, updates and the evaluation. The
host calls it ``evaluations`` times. So there is one compilation, nothing waits for the host in between, and only a few
numbers are transferred.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.train.checks import check_values
from sim2real.train.config import PPOConfig as PPOConfig
from sim2real.train.networks import Policy
from sim2real.train.protocol import TrainingEnvironment, check_environment, metric_names
from sim2real.train.rollout import evaluate
from sim2real.train.start import make_start
from sim2real.train.update import TrainState, keys, make_policy, update


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
        history: Name -> shape ``(evaluations, num_seeds)``: the values of ``Progress``; fewer evaluations than were
            asked for where the target was reached.
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
    if config.target is not None and "success" not in (names := metric_names(env)):
        raise UsageError(
            f"target={config.target} is a share of success, and the environment's metrics have none: {sorted(names)}",
            hint="add 'success' to the metrics of its steps",
        )
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    state = make_start(env, config, key if typed else jax.random.wrap_key_data(key))
    epoch = jax.jit(jax.vmap(lambda state: _epoch(env, config, state)), donate_argnums=0).lower(state).compile()
    compiled = time.perf_counter()
    log: list[Progress] = []
    snapshots: list[Policy] = []
    for evaluation in range(1, config.evaluations + 1):
        state, policies, values = epoch(state)
        values = jax.device_get(values)
        env_steps = evaluation * config.updates_per_evaluation * config.steps_per_update
        check_values(values, env_steps, config)
        del values["finite_observation"]
        log.append(Progress(evaluation, config.evaluations, env_steps, time.perf_counter() - start, values))
        snapshots.append(jax.device_get(policies))
        if on_progress is not None:
            on_progress(log[-1])
        if config.target is not None and values["success"].max() >= config.target:
            break
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
        env_steps_per_s=config.num_seeds * log[-1].env_steps / train_s,
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


def _best(history: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return the index of the best evaluation and seed: by success, then by return, then the latest."""
    returns = history["return"]
    success = history.get("success", np.zeros_like(returns))
    evaluations, seeds = returns.shape
    cells = [(evaluation, seed) for evaluation in range(evaluations) for seed in range(seeds)]
    return max(cells, key=lambda cell: (success[cell], returns[cell], cell[0]))
