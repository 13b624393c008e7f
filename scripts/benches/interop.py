"""Our PPO against brax's on the pendulum with its delays: time to the same return, from the same environment.

brax's gets it through ``sim2real.interop``. Both have the same network and budget, and the settings of PPO that they
share are ours. Returns are those of evaluations without exploration noise.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benches.figures import row
from benches.train import environment
from sim2real.interop import brax_env
from sim2real.interop.environment import RobotEnvironment
from sim2real.stages.pipeline.pipeline import load_pipeline
from sim2real.stages.train.training_setup import contract_of
from sim2real.train.config import PPOConfig
from sim2real.train.ppo.trainer import train

QUICK = {"steps": 256, "envs": 8, "evaluations": 2, "timelines": 2, "episode_s": 0.5, "hidden": [4], "minibatches": 2}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--steps", type=int, default=1_500_000, help="policy steps of each")
    parser.add_argument("--envs", type=int, default=256, help="copies")
    parser.add_argument("--evaluations", type=int, default=12, help="evaluations, spread over the steps")
    parser.add_argument("--minibatches", type=int, default=PPOConfig.minibatches, help="they must divide --envs")
    parser.add_argument("--hidden", type=int, nargs="+", default=[64, 64], help="widths of the hidden layers")
    parser.add_argument("--timelines", type=int, default=32, help="timelines that episodes are drawn from")
    parser.add_argument("--episode-s", type=float, default=5.0, help="length of an episode [s]")
    parser.add_argument("--level", type=float, help="return that counts; default: the lower of both at their best")
    parser.add_argument("--seed", type=int, default=0, help="seed of both")
    parser.add_argument("--name", help="name of the device in the rows; default: cpu or gpu")


Curve = list[tuple[float, float]]
"""Of each evaluation: seconds since the start, and return."""


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Train both on the device that JAX finds, one after the other."""
    env = environment(options.timelines, options.episode_s)
    config = PPOConfig(
        num_envs=options.envs,
        total_steps=options.steps,
        minibatches=options.minibatches,
        evaluations=options.evaluations,
        eval_steps=env.length + 1,
        hidden=tuple(options.hidden),
    )
    curves = {"ours": ours(env, config, options.seed), "brax": brax(env, config, options.seed)}
    name = f"interop/{options.name or jax.default_backend()}/pendulum"
    return {"rows": rows(name, curves, options.level), "curves": curves}


def ours(env: Any, config: PPOConfig, seed: int) -> Curve:
    """Train ours."""
    result = train(env, config, jax.random.key(seed))
    return [(float(t), float(r)) for t, r in zip(result.elapsed_s, result.history["return"][:, 0], strict=True)]


def brax(env: Any, config: PPOConfig, seed: int) -> Curve:
    """Train brax's."""
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    if not hasattr(jax, "device_put_replicated"):
        # brax 0.14.2 asks for it, and JAX 0.10 has it no more.
        setattr(  # noqa: B010 - the type checker knows that it is gone
            jax, "device_put_replicated", lambda t, d: jax.tree.map(lambda x: jnp.stack([x] * len(d)), t)
        )
    robot = load_pipeline("pendulum").load()
    adapted = brax_env(RobotEnvironment(env, contract_of(robot, env.task, {})))
    curve: Curve = []
    begin = time.perf_counter()

    def evaluated(_: int, metrics: Any) -> None:
        curve.append((time.perf_counter() - begin, float(metrics["eval/episode_return"])))

    ppo.train(
        environment=adapted,
        num_timesteps=config.total_steps,
        episode_length=adapted.max_episode_length,
        num_envs=config.num_envs,
        num_eval_envs=config.num_envs,
        num_evals=config.evaluations + 1,  # the first one is before the training
        deterministic_eval=True,
        unroll_length=config.rollout_steps,
        batch_size=config.num_envs // config.minibatches,
        num_minibatches=config.minibatches,
        num_updates_per_batch=config.epochs,
        learning_rate=config.learning_rate,
        entropy_cost=config.entropy_coef,
        discounting=config.gamma,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip,
        vf_loss_coefficient=config.value_coef,
        max_grad_norm=config.max_grad_norm,
        reward_scaling=config.reward_scale,
        normalize_observations=True,
        network_factory=functools.partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=config.hidden,
            value_hidden_layer_sizes=config.hidden,
            activation=jnp.tanh,
        ),
        seed=seed,
        progress_fn=evaluated,
    )
    return curve[1:]


def rows(name: str, curves: dict[str, Curve], level: float | None) -> list[dict[str, Any]]:
    """Return when each reached the level: from the start, and without the compilation.

    What a stretch between evaluations takes without compiling is the median of the stretches after the first.
    """
    best = {who: max(r for _, r in curve) for who, curve in curves.items()}
    level = min(best.values()) if level is None else level
    found = [row(f"{name}/level", round(level, 1), "return")]
    times: dict[str, Sequence[float | None]] = {}
    for who, curve in curves.items():
        at = next((i for i, (_, r) in enumerate(curve) if r >= level), None)
        stretch = float(np.median(np.diff([t for t, _ in curve])))
        times[who] = (None, None) if at is None else (curve[at][0], (at + 1) * stretch)
        found.append(row(f"{name}/{who}/best_return", round(best[who], 1), "return"))
    for i, what in enumerate(("time_to_level_s", "time_to_level_without_compiling_s")):
        mine, theirs = times["ours"][i], times["brax"][i]
        for who, t in (("ours", mine), ("brax", theirs)):
            found.append(row(f"{name}/{who}/{what}", None if t is None else round(t, 2), "s"))
        ratio = round(mine / theirs, 3) if mine and theirs else None
        found.append(row(f"{name}/{what.removesuffix('_s')}_over_brax", ratio, "1", "brax's PPO", "at most 0.5"))
    return found
