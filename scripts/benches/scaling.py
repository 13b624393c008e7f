"""How much faster several devices of a host train than one, with as many copies on each, in one run."""

from __future__ import annotations

import argparse
from typing import Any

import jax
import numpy as np

from benches.figures import row
from benches.train import environment
from sim2real.train.config import PPOConfig
from sim2real.train.ppo import TrainResult, train

EVALUATIONS = 6
"""Speed is the median over what lies between them; the first has what happens once."""
GOAL = 0.9
"""Share of as many times the speed as there are devices."""
QUICK = {"envs": 8, "updates": 1, "timelines": 2, "episode_s": 0.5, "minibatches": 2}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--devices", type=int, help="devices to compare with one; default: all of this host")
    parser.add_argument("--envs", type=int, help="copies on each device; default: 8192, on a CPU 64")
    parser.add_argument("--updates", type=int, help="updates between two evaluations; default: 40, on a CPU 4")
    parser.add_argument("--minibatches", type=int, default=4, help="they must divide --envs")
    parser.add_argument("--timelines", type=int, default=32, help="timelines that episodes are drawn from")
    parser.add_argument("--episode-s", type=float, default=5.0, help="length of an episode [s]")
    parser.add_argument("--name", help="name of the device in the rows; default: cpu or gpu")


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Train on one device, then on several."""
    small = jax.default_backend() == "cpu"
    envs = options.envs or (64 if small else 8192)
    updates = options.updates or (4 if small else 40)
    several = options.devices or jax.local_device_count()
    env = environment(options.timelines, options.episode_s)
    name = f"scaling/{options.name or jax.default_backend()}/pendulum"
    rows, speeds = [], {}
    for devices in sorted({1, several}):
        config = PPOConfig(
            num_envs=devices * envs,
            minibatches=options.minibatches,
            total_steps=EVALUATIONS * updates * devices * envs * PPOConfig.rollout_steps,
            evaluations=EVALUATIONS,
            eval_steps=env.length + 1,
            devices=devices,
        )
        result = train(env, config, jax.random.key(0))
        speeds[devices] = speed(result)
        rows += [
            row(f"{name}/{devices}_devices/envs", config.num_envs, "copies"),
            row(f"{name}/{devices}_devices/env_steps_per_s", round(speeds[devices]), "1/s"),
            row(f"{name}/{devices}_devices/compile_s", round(result.compile_s, 1), "s"),
        ]
    if several > 1:
        ratio = round(speeds[several] / speeds[1], 2)
        goal = f"at least {GOAL * several:g}"
        rows.append(row(f"{name}/{several}_over_1", ratio, "times the steps a second", "one device", goal))
    return {"rows": rows}


def speed(result: TrainResult) -> float:
    """Return rows a second, evaluations in their time but not in their number, without what happens once."""
    return float(np.median(np.diff(result.env_steps) / np.diff(result.elapsed_s)))
