"""Training by PPO: the compiled program from one evaluation to the next, and the loop on the host that calls it.

One program does rollouts, updates and the evaluation of all seeds. So there is one compilation, the device never waits
for the host within a call, and only a few numbers are transferred.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax

from sim2real.errors import Sim2RealError, UsageError
from sim2real.runtime.compiled.graph import data_of, with_data
from sim2real.training.config import PPOConfig as PPOConfig
from sim2real.training.environment.protocol import (
    TrainingEnvironment,
    check_environment,
    choose,
    get_privileged,
    get_width,
    metric_names,
)
from sim2real.training.networks.architectures import Factory, make_network, name_of
from sim2real.training.networks.policy import Policy
from sim2real.training.ppo.checkpoint import Checkpoint, TrainingIdentity, load_checkpoint, save_checkpoint
from sim2real.training.ppo.checkpoint import Progress as Progress
from sim2real.training.ppo.losses import ActorCritic
from sim2real.training.ppo.rollout import (
    Copies,
    PolicyEvaluation,
    add_rows,
    averages,
    collect,
    evaluate,
    new_evaluation,
)
from sim2real.training.ppo.update import Normaliser, TrainState, keys, make_optimiser, make_policy, set_rate, update
from sim2real.training.scale.devices import Shardings, gather, place, replicate, shardings_of
from sim2real.training.scale.processes import agree, leads, require_one_clock
from sim2real.training.sweep import Sweep as Sweep
from sim2real.training.sweep import with_numbers
from sim2real.types import Array, PyTree

T = TypeVar("T")
GPU_OPTIONS = {"xla_gpu_autotune_level": 0, "xla_gpu_enable_triton_gemm": False}
"""Compiler options: do not try several kernels for each small matrix product of the networks. The pendulum compiles on
an H200 in 4.9 s instead of 9.0 s; a step takes 1.4 times as long, which costs 0.7 s for 3 M steps.
"""
FINITE = {
    "finite_observation": ("the observation", "reset or step"),
    "finite_privileged": ("the privileged observation", "privileged"),
}
"""Figure with the mask of finite entries -> name of the array, and the environment's method that makes it."""
_Numbers = dict[str, Array]
"""Swept setting -> its value for each member, shape ``(M,)``."""
_Figures = dict[str, jax.Array]
_Program = Callable[[TrainState, _Numbers, PyTree], tuple[TrainState, Policy, _Figures]]


@dataclass(frozen=True)
class TrainResult:
    """The result of a training.

    Attributes:
        policies: The policies at the end; leaves have a leading seed axis.
        best: The policy with the highest success rate over all seeds and evaluations; of equals, the highest return.
        best_seed: Seed of ``best``; in a sweep, its place on the seed axis.
        members: Swept settings of each place on the seed axis, with all seeds of the first settings first; empty
            without a sweep.
        history: Name -> shape ``(evaluations, num_seeds)``: the values of ``Progress``; shorter than
            ``config.evaluations`` if training ended earlier: at the target, or after ``config.minutes``.
        env_steps: Shape ``(evaluations,)``: number of rows per seed at each evaluation, of one policy step at most.
        elapsed_s: Shape ``(evaluations,)``: time that training took so far [s].
        observations: Shape ``(N, O)``: the last observations of the best policy's simulations.
        env_steps_per_s: Rows of all seeds per second of ``train_s``, without those of evaluations.
        compile_s: Time to trace and compile [s].
        train_s: Time to train and evaluate [s]; of a resumed training, since it was resumed.
    """

    policies: Policy
    best: Policy
    best_seed: int
    members: list[dict[str, float]]
    history: dict[str, np.ndarray]
    env_steps: np.ndarray
    elapsed_s: np.ndarray
    observations: np.ndarray
    env_steps_per_s: float
    compile_s: float
    train_s: float


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
) -> TrainResult:
    """Train ``num_seeds`` policies, with each of the settings of a sweep.

    Args:
        key: From ``jax.random.key`` or ``PRNGKey``; seed i depends on it and on i alone.
        on_progress: Called after every evaluation, also for those before a resumption; an exception in it ends the
            training.
        checkpoint: File to which the whole training is written after each evaluation. Several processes must all name
            it; the first one writes it.
        resume: A checkpoint to continue from. The result equals that of an uninterrupted training, bit for bit on one
            machine.
        actor: Makes the actor, a module of flax.linen or a ``Network``, with the given number of outputs; default: the
            network that ``config`` names.

    Raises:
        UsageError: The environment breaks its protocol, several processes have a time budget, no evaluation episode
            ended within ``eval_steps``, or ``resume`` is a checkpoint of another training.
        Sim2RealError: An observation, a reward or a loss is not finite, or the checkpoint cannot be read.
    """
    start = time.perf_counter()
    require_one_clock(config)
    key = key if jnp.issubdtype(key.dtype, jax.dtypes.prng_key) else jax.random.wrap_key_data(key)
    session = _Session.of(env, config, key, sweep or Sweep({}), (actor, critic))

    # Start from the initial state, or continue from a checkpoint of the same training.
    training = Checkpoint(session.state, None, None, [])
    identity = None
    if checkpoint or resume or session.layout:
        identity = TrainingIdentity.of(config, key, session.lowered, session.sweep, session.data)
        agree({**identity.entries(), "saves": checkpoint is not None, "resumes": resume is not None})
    if resume and identity:
        training = _load(resume, identity, session)
    first, earlier_s = len(training.log), training.log[-1].elapsed_s if training.log else 0.0

    # Compile, and report the evaluations of an earlier process.
    program = compile_lowered(session.lowered)
    compiled = time.perf_counter()
    report = on_progress or (lambda _: None)
    for progress in training.log:
        report(progress)

    # Collect, update, evaluate; then save and report.
    while not _is_over(config, training.log):
        training = _advance(program, session, training, earlier_s - start)
        if checkpoint and identity:
            _save(checkpoint, identity, training, session.layout)
        report(replace(training.log[-1], best=training.best))
    return _result(session, training, first, compiled - start, time.perf_counter() - compiled)


class _Session(NamedTuple):
    """One call of ``train``.

    Attributes:
        state: The state before the first update, on its devices; the program overwrites its memory.
        numbers: The swept settings.
        data: The environment's data: a training after another recording finds its program in the cache.
        layout: Placement of the arrays on devices; None: one device.
    """

    config: PPOConfig
    sweep: Sweep
    state: TrainState
    numbers: _Numbers
    data: PyTree
    layout: Shardings | None
    lowered: jax.stages.Lowered

    @staticmethod
    def of(
        env: TrainingEnvironment,
        config: PPOConfig,
        key: jax.Array,
        sweep: Sweep,
        makers: tuple[Factory | None, Factory | None],
    ) -> _Session:
        """Check the environment, make the networks and the first state, and trace the program."""
        # Check the environment, and make networks and the first state.
        check_environment(env)
        check_target(env, config)
        networks = make_networks(env, config, *makers)
        state = make_initial_state(env, sweep.configs(config), key, networks)

        # The settings of a sweep share an axis with the seeds: all are independent, and are divided among devices.
        members = with_numbers(config, {"num_seeds": config.num_seeds * len(sweep.grid)})
        layout = shardings_of(state, members)
        state = place(state, layout)
        numbers, data = swept_numbers(sweep, config.num_seeds), replicate(data_of(env), layout)

        def of_member(state: TrainState, numbers: _Numbers, data: PyTree) -> tuple[TrainState, Policy, _Figures]:
            return _train_until_evaluation(with_data(env, data), with_numbers(members, numbers), networks, state)

        # Trace one program for all members.
        where = layout and (layout.state, layout.whole, layout.whole)
        with small_random_numbers():
            program = jax.jit(jax.vmap(of_member, in_axes=(0, 0, None)), donate_argnums=0, out_shardings=where)
            lowered = program.lower(state, numbers, data)
        return _Session(config, sweep, state, numbers, data, layout, lowered)


def _train_until_evaluation(
    env: TrainingEnvironment, config: PPOConfig, networks: ActorCritic, state: TrainState
) -> tuple[TrainState, Policy, _Figures]:
    """Train one seed until its next evaluation, and evaluate it; ``sim2real.training.ppo`` shows it as two loops.

    Training and evaluation are iterations of one scan: the environment's step, most of the program, is compiled once
    instead of twice: on a CPU the pendulum has 28 % less to compile, the arm 36 %.
    """
    # Jit, so that the function is traced once for both its uses.
    update_once = jax.jit(partial(update, env, config, networks))
    count, apart = config.updates_per_evaluation, config.eval_envs is not None and config.eval_envs < config.num_envs

    def iteration(
        now: tuple[TrainState, Copies, PolicyEvaluation], i: jax.Array
    ) -> tuple[tuple[TrainState, Copies, PolicyEvaluation], _Figures]:
        state, evaluated_copies, evaluation = now
        evaluating = i >= count

        # Collect rows with the current policy, by the training's copies or by the copies of the evaluation.
        key_rollout, _, key_evaluation = keys(state)
        key = choose(evaluating, jax.random.fold_in(key_evaluation, i), key_rollout)
        number = jnp.where(evaluating, i - count, state.update)
        policy = make_policy(env, config, networks, state.params, state.normaliser)
        copies = choose(evaluating, evaluated_copies, state.copies)
        copies, rows = collect(env, config, policy, copies, number, key, evaluating, state.reached)

        # Update the networks, or add the rows to the evaluation.
        def learn() -> tuple[TrainState, PolicyEvaluation, _Figures]:
            state_after, figures = update_once(state, copies, rows)
            return state_after, evaluation, figures

        def judge() -> tuple[TrainState, PolicyEvaluation, _Figures]:
            blank = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
            return state, add_rows(evaluation, rows, config), blank

        shapes = jax.eval_shape(learn)[2]
        state, evaluation, figures = jax.lax.cond(evaluating, judge, learn)
        return (state, choose(evaluating, copies, evaluated_copies), evaluation), figures

    start = (state, state.copies, new_evaluation(env, config))
    rollouts = 0 if apart else config.rollouts_per_evaluation
    (state, _, evaluation), stats = jax.lax.scan(iteration, start, jnp.arange(count + rollouts))

    # Average the figures over the updates; an entry counts as finite if it was finite in each of them.
    stats = jax.tree.map(lambda leaf: leaf[:count], stats)
    finite = {name: stats.pop(name).all(0) for name in FINITE if name in stats}
    values = {name: leaf.mean(0) for name, leaf in stats.items()} | finite
    width = get_width(env, config, state.update - 1, state.reached)
    values |= {} if width is None else {"width": width}
    policy = make_policy(env, config, networks, state.params, state.normaliser)
    if apart:
        # A smaller number of copies plays the evaluation in a separate loop.
        few = with_numbers(config, {"num_envs": cast(int, config.eval_envs)})
        return state, policy, values | evaluate(env, few, policy, keys(state)[2])
    return state, policy, values | averages(evaluation)


def _advance(program: _Program, session: _Session, training: Checkpoint, offset_s: float) -> Checkpoint:
    """Return the training after its next evaluation.

    Args:
        offset_s: Added to the clock, it gives the time that training took so far [s].
    """
    config = session.config
    state, policies, values = program(training.state, session.numbers, session.data)
    policies, values = jax.device_get((policies, values))

    # Raise if a figure is not finite, before anything is saved.
    count = len(training.log) + 1
    env_steps = count * config.updates_per_evaluation * config.steps_per_update
    check_values(values, env_steps, config, session.sweep.names(config.num_seeds))

    # Keep the policy of this evaluation's best seed if no earlier evaluation was better.
    values = {name: value for name, value in values.items() if name not in FINITE}
    log = [*training.log, Progress(count, config.evaluations, env_steps, time.perf_counter() + offset_s, values)]
    evaluation, seed = find_best(history_of(log))
    return Checkpoint(state, policies, policies[seed] if evaluation == count - 1 else training.best, log)


def _load(path: Path, identity: TrainingIdentity, session: _Session) -> Checkpoint:
    saved = load_checkpoint(path, identity, session.state, session.lowered.out_info[1])
    return saved._replace(state=place(saved.state, session.layout))


def _save(path: Path, identity: TrainingIdentity, training: Checkpoint, layout: Shardings | None) -> None:
    """Write a checkpoint; all processes gather the state, and the first one writes."""
    gathered = training._replace(state=gather(training.state, layout))
    if leads():
        save_checkpoint(path, identity, gathered)


def _result(session: _Session, training: Checkpoint, first: int, compile_s: float, train_s: float) -> TrainResult:
    """Return the result; ``first`` is the number of evaluations that an earlier process made."""
    # Figures of all evaluations, and the speed of this process.
    log, history = training.log, history_of(training.log)
    members = [point for point in session.sweep.grid for _ in range(session.config.num_seeds)]
    trained = log[-1].env_steps - (log[first - 1].env_steps if first else 0)
    observations = np.asarray(gather(training.state.copies.observation, session.layout))
    best_seed = find_best(history)[1]
    return TrainResult(
        policies=jax.device_put(training.policies),
        best=jax.device_put(training.best),
        best_seed=best_seed,
        members=members,
        history=history,
        env_steps=np.array([progress.env_steps for progress in log]),
        elapsed_s=np.array([progress.elapsed_s for progress in log]),
        observations=observations[best_seed],
        env_steps_per_s=len(members) * trained / train_s,
        compile_s=compile_s,
        train_s=train_s,
    )


def _is_over(config: PPOConfig, log: list[Progress]) -> bool:
    """Return whether all evaluations were made, the time is over, or the best seed has reached the target."""
    reached = bool(log) and config.target is not None and log[-1].values["success"].max() >= config.target
    late = bool(log) and config.minutes is not None and log[-1].elapsed_s >= 60.0 * config.minutes
    return reached or late or len(log) == config.evaluations


def check_values(values: dict[str, np.ndarray], env_steps: int, config: PPOConfig, names: list[str]) -> None:
    """Raise if a value is not finite or no episode ended.

    Args:
        values: Name -> shape ``(num_seeds,)``; values in ``FINITE`` have a second axis, with the entries.
        names: Name of each place on the seed axis, such as ``seed 0``.
    """
    # Check causes before their consequences: observations, rewards, then losses.
    for seed, name in enumerate(names):
        when = f"({name}, within {env_steps} rows)"
        for part, (array, method) in FINITE.items():
            entries = np.flatnonzero(~values[part][seed]) if part in values else np.empty(0)
            if entries.size:
                raise Sim2RealError(
                    f"entries {entries.tolist()} of {array} are not finite {when}",
                    hint=f"the environment's {method} makes them: check their divisions and integrations",
                )
        if not np.isfinite(values["reward"][seed]):
            raise Sim2RealError(
                f"the reward is not finite {when}", hint="check what the environment's reward divides by"
            )
        diverged = sorted(name for name in ("loss", "kl", "entropy") if not np.isfinite(values[name][seed]))
        if diverged:
            raise Sim2RealError(
                f"the training's {' and '.join(diverged)} is not finite {when}, observations and rewards are",
                hint=f"lower learning_rate (now {config.learning_rate}) or reward_scale (now {config.reward_scale})",
            )
        if values["finished"][seed] == 0:
            raise UsageError(
                f"no evaluation episode ended within eval_steps={config.eval_steps} rows",
                hint="raise eval_steps above the longest episode, or let the environment truncate",
            )
        # Check metrics of episodes last: the causes above may explain them.
        metrics = sorted(name for name, value in values.items() if not np.isfinite(value[seed]).all())
        if metrics:
            raise Sim2RealError(f"metrics {', '.join(metrics)} of finished episodes are not finite {when}")


def check_target(env: TrainingEnvironment, config: PPOConfig) -> None:
    """Raise a ``UsageError`` if the configuration has a target and the environment reports no success."""
    if config.target is not None and "success" not in (names := metric_names(env)):
        raise UsageError(
            f"target={config.target} is a share of success, and the environment's metrics have none: {sorted(names)}",
            hint="add 'success' to the metrics of its steps",
        )


@contextmanager
def small_random_numbers() -> Iterator[None]:
    """Make JAX draw random numbers by one kernel instead of 200 operations; the numbers are the same."""
    name = "jax_threefry_gpu_kernel_lowering"
    before = jax.config.values[name]
    jax.config.update(name, True)
    try:
        yield
    finally:
        jax.config.update(name, before)


def compile_lowered(lowered: jax.stages.Lowered) -> jax.stages.Compiled:
    """Return the compiled program."""
    return lowered.compile(compiler_options=dict(GPU_OPTIONS) if jax.default_backend() == "gpu" else None)


def history_of(log: list[Progress]) -> dict[str, np.ndarray]:
    """Return name -> values, shape ``(evaluations, num_seeds)``."""
    return {name: np.stack([progress.values[name] for progress in log]) for name in log[0].values}


def find_best(history: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return the index of the best evaluation and seed: by success, then by return, then the latest."""
    returns = history["return"]
    success = history.get("success", np.zeros_like(returns))
    evaluations, seeds = returns.shape
    cells = [(evaluation, seed) for evaluation in range(evaluations) for seed in range(seeds)]
    return max(cells, key=lambda cell: (success[cell], returns[cell], cell[0]))


# -- the state before the first update


def make_initial_state(
    env: TrainingEnvironment, configs: Sequence[PPOConfig], key: jax.Array, networks: ActorCritic
) -> TrainState:
    """Return the states before the first update, with a leading axis; in numpy, to compile no small operations.

    Args:
        configs: Settings that differ only in numbers. The leading axis has all seeds of the first settings, then of the
            next.
        key: Seed i depends on it and on i alone.
    """
    first = configs[0]
    seeds = np.arange(first.num_seeds, dtype=np.uint32)
    folded = [jax.random.fold_in(key, seed) for seed in seeds]
    key_data = np.stack([jax.random.key_data(each) for each in folded])

    # Networks, optimiser and normalisers of each place on the leading axis.
    sizes = env.observation_size, np.shape(env.action_low)[0], privileged_size(env, first)
    rngs = ((config, np.random.default_rng(data)) for config in configs for data in key_data)
    learners = [_new_learner(config, networks, rng, sizes) for config, rng in rngs]
    params, optimiser, normaliser, privileged = jax.tree.map(lambda *leaves: np.stack(leaves), *learners)

    # The environments' states are zeros; the first rollout resets them.
    shapes = jax.eval_shape(env.reset, jax.eval_shape(lambda: jax.random.key(0)))
    members = len(learners)
    count = members, first.num_envs
    carries = (net.initial_carry() for net in (networks.actor, networks.critic))
    copies = Copies(*_blank(shapes, count, folded[0]), *(_repeated(carry, count) for carry in carries))
    keys = _keys(np.tile(key_data, (len(configs), 1)), folded[0])
    # The share of a curriculum that follows success.
    follows = env.curriculum is not None and env.follow > 0.0
    shares = np.full(members, env.curriculum[0], np.float32) if env.curriculum is not None and follows else None
    update, reached = jax.device_put((np.zeros(members, np.int32), shares))
    return TrainState(params, optimiser, normaliser, privileged, copies, update, keys, reached)


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
    """Return networks, optimiser and normalisers; ``sizes`` of observation, action and privileged observation."""
    size, actions, privileged = sizes
    params = {
        "actor": networks.actor.init(rng, size, 0.01),
        "log_std": np.full(actions, config.log_std_init, np.float32),
        "value": networks.critic.init(rng, size + (privileged or 0), 1.0),
    }
    optimiser = jax.tree.map(
        lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(make_optimiser(config).init, params)
    )
    if config.schedule == "adaptive":
        optimiser = set_rate(optimiser, np.float32(config.learning_rate))
    return params, optimiser, _new_normaliser(size), None if privileged is None else _new_normaliser(privileged)


def _new_normaliser(size: int) -> Normaliser:
    """Return the statistics before the first observation, in numpy."""
    return Normaliser(np.asarray(np.float32(0)), np.zeros(size, np.float32), np.ones(size, np.float32))


def _blank(shapes: T, leading: tuple[int, ...], key: jax.Array) -> T:
    """Return zeros with given shapes and dtypes, and leading axes, in numpy; keys like ``key`` with data of 0."""

    def leaf(struct: jax.ShapeDtypeStruct) -> Array:
        if struct.dtype == key.dtype:
            data = jax.eval_shape(jax.random.key_data, struct)
            return _keys(np.zeros((*leading, *data.shape), data.dtype), key)
        is_key = jnp.issubdtype(struct.dtype, jax.dtypes.prng_key)
        return (jnp if is_key else np).zeros((*leading, *struct.shape), struct.dtype)

    return jax.tree.map(leaf, shapes)


def _keys(data: np.ndarray, like: jax.Array) -> jax.Array:
    """Return keys made of their data, without a compilation."""
    return jax.random.wrap_key_data(jax.device_put(data), impl=jax.random.key_impl(like))
