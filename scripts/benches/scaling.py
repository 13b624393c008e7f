"""Speed of several devices of a host over that of one, with the same work on each: training, and identification."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from benches.rows import Report, row, values
from benches.train import environment
from sim2real.errors import UsageError
from sim2real.identify.config import FitConfig
from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.search.search import search
from sim2real.log.reader import read_log
from sim2real.stages.pipeline.pipeline import load_pipeline
from sim2real.train.config import PPOConfig
from sim2real.train.ppo.trainer import TrainResult, train

EVALUATIONS = 6
"""Number of evaluations; the speed is the median over the stretches between them, without the first."""
GOAL = 0.9
"""Share of the ideal speed, which is proportional to the number of devices."""
LOG = Path(__file__).resolve().parents[2] / "datasets" / "pendulum" / "multisine.mcap"
SEGMENTS, SEGMENT_S = 16, 1.0
"""Number and length of the segments on which each candidate is simulated."""
GENERATIONS = 60
QUICK = {
    **{"envs": 8, "updates": 1, "timelines": 2, "episode_s": 0.5, "minibatches": 2},
    **{"candidates": 4, "generations": 20, "segments": 1},
}


Measure = Callable[[int], tuple[float, float, int]]
"""``devices -> speed [1/s], time to compile [s], size``."""


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--devices", type=int, help="devices to compare with one; default: all of this host")
    parser.add_argument("--envs", type=int, help="copies on each device; default: 8192, on a CPU 64")
    parser.add_argument("--updates", type=int, help="updates between two evaluations; default: 40, on a CPU 4")
    parser.add_argument("--minibatches", type=int, default=4, help="they must divide --envs")
    parser.add_argument("--timelines", type=int, default=32, help="timelines that episodes are drawn from")
    parser.add_argument("--episode-s", type=float, default=5.0, help="length of an episode [s]")
    parser.add_argument("--candidates", type=int, help="candidates on each device; default: 4096, on a CPU 16")
    parser.add_argument(
        "--generations", type=int, default=GENERATIONS, help="most generations of a search, 20 at least"
    )
    parser.add_argument(
        "--segments", type=int, default=SEGMENTS, help="segments of 1 s on which each candidate is simulated"
    )
    parser.add_argument("--parts", nargs="+", choices=["train", "identify"], default=["train", "identify"])
    parser.add_argument("--name", help="name of the device in the rows; default: cpu or gpu")


def run(options: argparse.Namespace) -> Report:
    """Measure on one device, then on several."""
    several = options.devices or jax.local_device_count()
    measure = {"train": train_on(options), "identify": identify_on(options)}
    name = f"scaling/{options.name or jax.default_backend()}"
    rows = []
    for part, unit in (("train", "env_steps_per_s"), ("identify", "candidates_per_s")):
        if part not in options.parts:
            continue
        speeds = {}
        for devices in sorted({1, several}):
            speeds[devices], compile_s, size = measure[part](devices)
            base = f"{name}/{part}/{devices}_devices"
            rows += [
                row(f"{base}/size", size, "copies" if part == "train" else "candidates"),
                row(f"{base}/{unit}", round(speeds[devices]), "1/s"),
                row(f"{base}/compile_s", round(compile_s, 1), "s"),
            ]
        if several > 1:
            ratio = round(speeds[several] / speeds[1], 2)
            goal = f">= {GOAL * several:g}" if part == "train" else ""
            rows.append(row(f"{name}/{part}/{several}_over_1", ratio, "times the speed", "one device", goal))
    return {"rows": rows}


def train_on(options: argparse.Namespace) -> Measure:
    """Return the measurement of PPO on the pendulum."""
    small = jax.default_backend() == "cpu"
    envs = options.envs or (64 if small else 8192)
    updates = options.updates or (4 if small else 40)

    def measure(devices: int) -> tuple[float, float, int]:
        env = environment(options.timelines, options.episode_s)
        config = PPOConfig(
            num_envs=devices * envs,
            minibatches=options.minibatches,
            total_steps=EVALUATIONS * updates * devices * envs * PPOConfig.rollout_steps,
            evaluations=EVALUATIONS,
            eval_steps=env.length + 1,
            devices=devices,
        )
        result = train(env, config, jax.random.key(0))
        return speed(result), result.compile_s, config.num_envs

    return measure


def identify_on(options: argparse.Namespace) -> Measure:
    """Return the measurement of the search for the pendulum's parameters in a log."""
    small = jax.default_backend() == "cpu"
    candidates = options.candidates or (16 if small else 4096)
    if options.generations < 20:
        raise UsageError(f"--generations must be 20 at least, got {options.generations}: the first ten are not counted")

    def measure(devices: int) -> tuple[float, float, int]:
        size = devices * candidates
        config = FitConfig(engine="compiled", devices=devices, population=size, generations=options.generations)
        robot, episode = load_pipeline("pendulum").load(), read_log(LOG)
        spans = [Span(0, 1.0 + SEGMENT_S * i) for i in range(options.segments)]
        problem = Problem(robot.identifiable(config.max_delay_s), [episode], spans, SEGMENT_S, config)
        done, compiling = [0.0], [0.0, 0.0]
        begin = time.perf_counter()

        def on_generations(count: int, best: float, z: np.ndarray) -> None:
            done.append(time.perf_counter() - begin)

        def on_compile(on: bool) -> None:
            compiling[0 if on else 1] = time.perf_counter()

        losses, start = problem.residuals.losses, problem.table.start()
        search(losses, start, config, problem.data, on_generations=on_generations, on_compile=on_compile)
        took = np.diff(done[1:])  # without the first ten generations
        return 10 * size / float(np.median(took)), compiling[1] - compiling[0], size

    return measure


def speed(result: TrainResult) -> float:
    """Return training rows a second, with the time of evaluations, without the first stretch."""
    return float(np.median(np.diff(result.env_steps) / np.diff(result.elapsed_s)))


def table(report: Report) -> str:
    """Return the speed of a training on all devices of a host against one."""
    v = {name.rpartition("train/")[2]: value for name, value in values(report).items()}
    count = next(name.removesuffix("_over_1") for name in v if name.endswith("_over_1"))
    cards = f"{count} {report['flags']['name'].upper()}s"
    return (
        f"{cards} of one host make {v[f'{count}_over_1']:.2f} times the steps of one, "
        f"{v[f'{count}_devices/env_steps_per_s'] / 1e6:.1f} million policy steps per second\nof a single policy.\n"
    )
