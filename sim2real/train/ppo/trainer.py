"""Proximal policy optimisation (PPO) of several seeds in one compiled program.

The program does everything from one evaluation to the next, for all seeds: rollouts, updates and the evaluation. The
host calls it ``evaluations`` times. So there is one compilation, nothing waits for the host in between, and only a few
numbers are transferred.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.runtime.program_arguments import data_of, with_data
from sim2real.train.config import PPOConfig as PPOConfig
from sim2real.train.environment.protocol import TrainingEnvironment, check_environment, get_width, metric_names
from sim2real.train.networks.architectures import Factory
from sim2real.train.networks.policy import Policy
from sim2real.train.networks.sequences import ActorCritic
from sim2real.train.ppo.health import FINITE, check_values
from sim2real.train.ppo.initial_state import make_networks, make_start, swept_numbers
from sim2real.train.ppo.result import Progress as Progress
from sim2real.train.ppo.result import TrainResult as TrainResult
from sim2real.train.ppo.result import best_of, history_of
from sim2real.train.ppo.rollout import Copies, Tested, collect, figures_of, pick, untested, watch
from sim2real.train.ppo.teacher import TeacherEnvironment
from sim2real.train.ppo.update import TrainState, keys, make_policy, update
from sim2real.train.scale.checkpoint import Checkpoint, TrainingIdentity, load_checkpoint, save_checkpoint
from sim2real.train.scale.compilation import compile_lowered, small_random_numbers
from sim2real.train.scale.devices import Shardings, gather, place, shardings_of, whole
from sim2real.train.scale.processes import agree, leads
from sim2real.train.sweep import Sweep as Sweep
from sim2real.train.sweep import with_numbers


def train(
    env: TrainingEnvironment,
    config: PPOConfig,
    key: jax.Array,
    on_progress: Callable[[Progress], None] | None = None,
    checkpoint: Path | None = None,
    resume: Path | None = None,
    sweep: Sweep | None = None,
    actor: Factory | None = None,
    critic: Factory | None = None,
    teacher: Policy | None = None,
) -> TrainResult:
    """Train ``num_seeds`` policies, with each of the settings of a sweep.

    Args:
        key: Source of all randomness, from ``jax.random.key`` or ``PRNGKey``; seed i depends on it and on i alone.
        on_progress: Called after every evaluation, those before a resumption too; an exception that it raises ends the
            training.
        checkpoint: File that holds all of the training after each evaluation; None: none is written. Of several
            processes all have to name one, and the first writes it.
        resume: Such a file to go on from. The result is that of a training that was never interrupted, bit for bit on
            one machine.
        sweep: Settings to try side by side; None: those of ``config``.
        actor: Makes the actor, a module of flax.linen or a ``Network``, with this number of outputs; None: ``config``
            names it.
        teacher: A policy to imitate, in place of learning from rewards; it may see what only simulation knows.

    Raises:
        UsageError: The environment breaks its protocol, no evaluation episode ended within ``eval_steps``, or what is
            to be resumed is another training.
        Sim2RealError: An observation, a reward or a loss is not finite, or the file to resume from cannot be read.
    """
    start = time.perf_counter()
    check_environment(env)
    env = TeacherEnvironment(env) if config.teacher else env
    _check_target(env, config)
    key = key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)
    sweep = sweep or Sweep({})
    networks = make_networks(env, config, actor, critic, teacher)
    state, numbers = make_start(env, sweep.configs(config), key, networks), swept_numbers(sweep, config.num_seeds)
    # Settings that are swept have as little to tell each other as seeds have, and are divided as those are.
    shared = with_numbers(config, {"num_seeds": config.num_seeds * len(sweep.grid)})
    layout = shardings_of(state, shared)
    state = place(state, layout)
    # What follows from recordings is an argument: a training after another recording finds its program in the cache.
    data = whole(data_of(env), layout)
    lowered = _lowered(env, shared, networks, (state, numbers, data), layout)
    now = Checkpoint(state, None, None, [])
    identity = TrainingIdentity.of(config, key, lowered, sweep, data) if checkpoint or resume or layout else None
    if identity:
        agree({**identity.said(), "saves": checkpoint is not None, "resumes": resume is not None})
    if resume and identity:
        now = _resumed(resume, identity, state, lowered, layout)
    first, before_s = len(now.log), now.log[-1].elapsed_s if now.log else 0.0
    names = sweep.names(config.num_seeds)
    epoch = partial(_advance, compile_lowered(lowered), (numbers, data), config, names, before_s - start)
    compiled = time.perf_counter()
    report = on_progress or (lambda _: None)
    for progress in now.log:
        report(progress)
    while not _is_over(config, now.log):
        now = epoch(now)
        if checkpoint and identity:
            _save(checkpoint, identity, now, layout)
        report(now.log[-1])
    members = [point for point in sweep.grid for _ in range(config.num_seeds)]
    train_s, seen = time.perf_counter() - compiled, np.asarray(gather(now.state.copies.observation, layout))
    return _result(members, now, first, seen, compiled - start, train_s)


def _lowered(
    env: TrainingEnvironment,
    config: PPOConfig,
    networks: ActorCritic,
    arguments: tuple[TrainState, dict[str, Any], Any],
    layout: Shardings | None,
) -> Any:
    def one(state: TrainState, numbers: dict[str, Any], data: Any) -> Any:
        return _epoch(with_data(env, data), with_numbers(config, numbers), networks, state)

    where = layout and (layout.state, layout.whole, layout.whole)
    with small_random_numbers():
        program = jax.jit(jax.vmap(one, in_axes=(0, 0, None)), donate_argnums=0, out_shardings=where)
        return program.lower(*arguments)


def _resumed(
    path: Path, identity: TrainingIdentity, state: TrainState, lowered: Any, layout: Shardings | None
) -> Checkpoint:
    saved = load_checkpoint(path, identity, state, lowered.out_info[1])
    return saved._replace(state=place(saved.state, layout))


def _save(path: Path, identity: TrainingIdentity, now: Checkpoint, layout: Shardings | None) -> None:
    """Write a checkpoint; of several processes all hand over what they have, and the first one writes."""
    whole = now._replace(state=gather(now.state, layout))
    if leads():
        save_checkpoint(path, identity, whole)


def _advance(
    program: Callable[..., Any],
    arguments: tuple[dict[str, np.ndarray], Any],
    config: PPOConfig,
    names: list[str],
    offset_s: float,
    now: Checkpoint,
) -> Checkpoint:
    """Return the training after its next evaluation.

    Args:
        program: What ``_epoch`` was compiled to.
        arguments: Its settings that are swept, and the environment's data.
        offset_s: Turns the clock into the time that training took so far.
    """
    state, policies, values = program(now.state, *arguments)
    policies, values = jax.device_get((policies, values))
    count = len(now.log) + 1
    env_steps = count * config.updates_per_evaluation * config.steps_per_update
    check_values(values, env_steps, config, names)
    values = {name: value for name, value in values.items() if name not in FINITE}
    log = [*now.log, Progress(count, config.evaluations, env_steps, time.perf_counter() + offset_s, values)]
    evaluation, seed = best_of(history_of(log))
    return Checkpoint(state, policies, policies[seed] if evaluation == count - 1 else now.best, log)


def _result(
    members: list[dict[str, float]],
    now: Checkpoint,
    first: int,
    seen: np.ndarray,
    compile_s: float,
    train_s: float,
) -> TrainResult:
    """Return the result.

    Args:
        first: Number of evaluations that were made before this process.
        seen: Shape ``(M, N, O)``: observations of all copies of all members.
        compile_s: Time to trace and compile [s].
        train_s: Time since then [s].
    """
    log, history = now.log, history_of(now.log)
    trained = log[-1].env_steps - (log[first - 1].env_steps if first else 0)
    return TrainResult(
        policies=jax.tree.map(jnp.asarray, now.policies),
        best=jax.tree.map(jnp.asarray, now.best),
        best_seed=best_of(history)[1],
        members=members,
        history=history,
        env_steps=np.array([progress.env_steps for progress in log]),
        elapsed_s=np.array([progress.elapsed_s for progress in log]),
        observations=seen[best_of(history)[1]],
        env_steps_per_s=len(members) * trained / train_s,
        compile_s=compile_s,
        train_s=train_s,
    )


def _check_target(env: TrainingEnvironment, config: PPOConfig) -> None:
    if config.target is not None and "success" not in (names := metric_names(env)):
        raise UsageError(
            f"target={config.target} is a share of success, and the environment's metrics have none: {sorted(names)}",
            hint="add 'success' to the metrics of its steps",
        )


def _is_over(config: PPOConfig, log: list[Progress]) -> bool:
    """Return whether all evaluations were made, or the best seed has reached the target."""
    reached = bool(log) and config.target is not None and log[-1].values["success"].max() >= config.target
    return reached or len(log) == config.evaluations


def _epoch(
    env: TrainingEnvironment, config: PPOConfig, networks: ActorCritic, state: TrainState
) -> tuple[TrainState, Policy, dict[str, jax.Array]]:
    """Train one seed up to its next evaluation, and evaluate it.

    Rollouts for training and for the test are turns of one loop: the environment's step, most of the program, is
    compiled once instead of twice (pendulum 28 % less to compile on a CPU, arm 36 %).
    """
    count = config.updates_per_evaluation

    def turn(now: tuple[TrainState, Copies, Tested], i: jax.Array) -> tuple[tuple[TrainState, Copies, Tested], Any]:
        state, actors, tested = now
        testing, (key_play, _, key_test) = i >= count, keys(state)
        key = pick(testing, jax.random.fold_in(key_test, i), key_play)
        number = jnp.where(testing, i - count, state.update)
        policy = make_policy(env, config, networks, state.params, state.normaliser)
        copies = pick(testing, actors, state.copies)
        played, rows = collect(env, config, policy, copies, number, key, networks.teacher, testing)

        def learn() -> tuple[TrainState, Tested, dict[str, jax.Array]]:
            state_after, stats = update(env, config, networks, state, played, rows)
            return state_after, tested, stats

        def test() -> tuple[TrainState, Tested, dict[str, jax.Array]]:
            return state, watch(tested, rows, config), jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), empty)

        empty = jax.eval_shape(learn)[2]
        state, tested, stats = jax.lax.cond(testing, test, learn)
        return (state, pick(testing, played, actors), tested), stats

    start = (state, state.copies, untested(env, config))
    (state, _, tested), stats = jax.lax.scan(turn, start, jnp.arange(count + config.rollouts_per_test))
    stats = jax.tree.map(lambda leaf: leaf[:count], stats)
    finite = {name: stats.pop(name).all(0) for name in FINITE if name in stats}
    values = {name: leaf.mean(0) for name, leaf in stats.items()} | finite
    width = get_width(env, config, state.update - 1)
    values |= {} if width is None else {"width": width}
    policy = make_policy(env, config, networks, state.params, state.normaliser)
    return state, policy, values | figures_of(tested)
