"""PPO on the pendulum with its delays inside one program: steps a second, and time until success.

``scaling`` is the speed on all devices of a host over that on one, with the same work on each.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import jax
import numpy as np

from benches.rows import Report, Row, row, values
from sim2real.graph.delays import EmpiricalDist
from sim2real.graph.schedule import draw
from sim2real.robots.loop import AGENT
from sim2real.robots.training import training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import load_module, load_robot
from sim2real.training.config import PPOConfig
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.ppo.trainer import TrainResult, train

SPREAD, SPREAD_S, DRAWS = 0.02, 0.002, 1024
"""Standard deviation of each parameter as a share, largest deviation of the delay [s], number of draws."""
EVALUATIONS, GOAL = 6, 0.9
"""Of ``scaling``: evaluations, the speed is the median over the stretches between them, without the first; share of the
ideal speed, which is proportional to the number of devices."""
QUICK = {"steps": 256, "envs": 8, "timelines": 2, "episode_s": 0.5, "evaluations": 2, "minibatches": 2}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--seeds", type=int, default=1, help="policies in parallel")
    parser.add_argument("--envs", type=int, default=256, help="copies for each, or on each device")
    parser.add_argument(
        "--steps", type=int, default=1_000_000, help="policy steps for each; of scaling, on each device"
    )
    parser.add_argument("--evaluations", type=int, default=20, help="evaluations, spread over the steps; scaling has 6")
    parser.add_argument("--minibatches", type=int, default=PPOConfig.minibatches, help="they must divide --envs")
    parser.add_argument("--timelines", type=int, default=32, help="timelines that episodes are drawn from")
    parser.add_argument("--episode-s", type=float, default=5.0, help="length of an episode [s]")
    parser.add_argument(
        "--devices", type=int, help="of scaling: devices to compare with one; default: all of this host"
    )
    parser.add_argument("--name", help="name of the device in the rows; default: cpu or gpu")


def environment(timelines: int, episode_s: float) -> GraphEnvironment:
    """Return the pendulum as the embedded robot is, on timelines with the jitter of a quiet machine."""
    robot = load_robot("pendulum")
    truth = load_module("pendulum", "plant").PendulumPlant().truth()
    values = {**truth, "sensor_delay": 0.02, "actuator_delay": 0.025}
    rng = np.random.default_rng(0)
    draws = {name: value * (1 + SPREAD * rng.standard_normal(DRAWS)) for name, value in truth.items()}
    draws["sensor_delay"] = np.full(DRAWS, values["sensor_delay"])
    draws["actuator_delay"] = values["actuator_delay"] + rng.uniform(-SPREAD_S, SPREAD_S, DRAWS)
    jitter = rng.gamma(4.0, 2e-4, 2000)
    computation = {n: EmpiricalDist(jitter) for n in ("sensor", "agent", "actuator")}
    nodes, task = training_loop(robot, values, draws, computation, True)
    graph = CompiledGraph(nodes, AGENT, draw(nodes, episode_s, timelines, 0))
    return GraphEnvironment(graph, task)


def run(options: argparse.Namespace) -> Report:
    """Train on the device that JAX finds, or on one and on several."""
    name = options.name or jax.default_backend()
    if options.bench == "scaling":
        return {"rows": scaling_rows(options, f"scaling/{name}/train")}
    result = trained(options, PPOConfig(num_seeds=options.seeds, evaluations=options.evaluations))
    return {"rows": rows(result, f"train/{name}/pendulum/{options.seeds}_seeds")}


def trained(options: argparse.Namespace, config: PPOConfig, devices: int = 1) -> TrainResult:
    """Train with the flags' sizes on each device."""
    env = environment(options.timelines, options.episode_s)
    sizes = {"num_envs": devices * options.envs, "total_steps": devices * options.steps}
    config = replace(config, **sizes, minibatches=options.minibatches, eval_steps=env.length + 1)
    return train(env, config, jax.random.key(0))


def scaling_rows(options: argparse.Namespace, base: str) -> list[Row]:
    """Return the speed of PPO on one device, then on several."""
    several = options.devices or jax.local_device_count()
    lines, speeds = [], {}
    for devices in sorted({1, several}):
        result = trained(options, PPOConfig(evaluations=EVALUATIONS, devices=devices), devices)
        speeds[devices] = float(np.median(np.diff(result.env_steps) / np.diff(result.elapsed_s)))
        lines += [
            row(f"{base}/{devices}_devices/size", devices * options.envs, "copies"),
            row(f"{base}/{devices}_devices/env_steps_per_s", round(speeds[devices]), "1/s"),
            row(f"{base}/{devices}_devices/compile_s", round(result.compile_s, 1), "s"),
        ]
    if several > 1:
        ratio = round(speeds[several] / speeds[1], 2)
        goal = f">= {GOAL * several:g}"
        lines.append(row(f"{base}/{several}_over_1", ratio, "times the speed", "one device", goal))
    return lines


def rows(result: TrainResult, name: str) -> list[Row]:
    """Return speed, success at the end, and the time at which the worst seed succeeded."""
    success = np.asarray(result.history["success"])
    lines = [
        row(f"{name}/env_steps_per_s", round(result.env_steps_per_s), "1/s"),
        row(f"{name}/compile_s", round(result.compile_s, 1), "s"),
        row(f"{name}/train_s", round(result.train_s, 1), "s"),
        row(f"{name}/final_success", np.round(success[-1], 3).tolist(), "share of 2nd half"),
    ]
    at = np.flatnonzero(success.min(axis=1) >= 0.85)
    seconds = round(float(result.elapsed_s[at[0]]), 1) if at.size else None
    return [*lines, row(f"{name}/time_to_0.85_all_s", seconds, "s", "with compilation")]


def table(report: Report) -> str:
    """Return how long a training takes on an accelerator."""
    v = values(report)
    base = next(name for name in v if name.endswith("compile_s")).rpartition("/")[0]
    return (
        f"{report['flags']['seeds']} seeds of the pendulum, trained side by side on one "
        f"{report['machine']['devices'][0]}, are all above 85 % after\n"
        f"{v[f'{base}/time_to_0.85_all_s']:.1f} s, {v[f'{base}/compile_s']:.1f} s of them compilation.\n"
    )


def scaling(report: Report) -> str:
    """Return the speed of a training on all devices of a host against one."""
    v = {name.rpartition("train/")[2]: value for name, value in values(report).items()}
    count = next(name.removesuffix("_over_1") for name in v if name.endswith("_over_1"))
    cards = f"{count} {report['flags']['name'].upper()}s"
    return (
        f"{cards} of one host make {v[f'{count}_over_1']:.2f} times the steps of one, "
        f"{v[f'{count}_devices/env_steps_per_s'] / 1e6:.1f} million policy steps per second\nof a single policy.\n"
    )
