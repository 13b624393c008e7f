"""PPO on the pendulum with its delays, fully inside one program: how fast it steps, and how soon it succeeds."""

from __future__ import annotations

import argparse
from typing import Any

import jax
import numpy as np

from sim2real.graph.delays import EmpiricalDist
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled import CompiledGraph
from sim2real.stages.pipeline import load_pipeline
from sim2real.train.config import PPOConfig
from sim2real.train.env import GraphEnvironment
from sim2real.train.ppo import train

TIMELINES, EPISODE_S = 32, 5.0


def environment() -> GraphEnvironment:
    """Return the pendulum as the embedded robot is, on timelines with the jitter of a quiet machine."""
    robot = load_pipeline("pendulum").load()
    truth = load_pipeline("pendulum").load("plant").PendulumPlant().truth()
    values = {**truth, "sensor_delay": 0.02, "actuator_delay": 0.025}
    jitter = np.random.default_rng(0).gamma(4.0, 2e-4, 2000)
    computation = {n: EmpiricalDist(jitter) for n in ("sensor", "agent", "actuator")}
    nodes, task = robot.training(values, dict.fromkeys(truth, 0.02), computation, True)
    graph = CompiledGraph(nodes, robot.SUPERVISOR, draw(nodes, EPISODE_S, TIMELINES, 0))
    return GraphEnvironment(graph, task)


def main(arguments: list[str]) -> dict[str, Any]:
    """Train on the device that JAX finds."""
    parser = argparse.ArgumentParser(prog="bench.py train")
    parser.add_argument("--seeds", type=int, default=1, help="policies in parallel")
    parser.add_argument("--envs", type=int, default=256, help="copies for each")
    parser.add_argument("--steps", type=int, default=1_000_000, help="policy steps for each")
    parser.add_argument("--name", help="name of the device in the rows")
    options = parser.parse_args(arguments)
    env = environment()
    config = PPOConfig(
        num_seeds=options.seeds,
        num_envs=options.envs,
        total_steps=options.steps,
        evaluations=20,
        eval_steps=env.length + 1,
    )
    result = train(env, config, jax.random.key(0))
    name = f"train/{options.name or jax.default_backend()}/pendulum/{options.seeds}_seeds"
    success = np.asarray(result.history["success"])
    rows = [
        {"name": f"{name}/env_steps_per_s", "value": round(result.env_steps_per_s), "unit": "1/s"},
        {"name": f"{name}/compile_s", "value": round(result.compile_s, 1), "unit": "s"},
        {"name": f"{name}/train_s", "value": round(result.train_s, 1), "unit": "s"},
        {"name": f"{name}/final_success", "value": np.round(success[-1], 3).tolist(), "unit": "share of 2nd half"},
    ]
    for level in (0.85, 0.95):
        for who, reached in (("best", success.max(axis=1)), ("all", success.min(axis=1))):
            at = np.flatnonzero(reached >= level)
            seconds = round(float(result.elapsed_s[at[0]]), 1) if at.size else None
            rows.append(
                {"name": f"{name}/time_to_{level}_{who}_s", "value": seconds, "unit": "s", "goal": "compile incl."}
            )
    return {"rows": rows, "device": str(jax.devices()[0]), "jax": jax.__version__}
