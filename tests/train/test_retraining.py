"""A training after another recording of a robot: the numbers change, the program does not. As a script, it trains."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest

from sim2real.artifacts.identification import Noise
from sim2real.graph.delays import EmpiricalDist
from sim2real.graph.schedule import draw
from sim2real.robots.training import training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import load_robot
from sim2real.training.config import PPOConfig
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.ppo.trainer import train


def environment(recording):
    """Return the pendulum's environment after recording 0 or 1, which differ in every number."""
    robot = load_robot("pendulum")
    rng = np.random.default_rng(recording)
    values = {n: v * (1 + 0.02 * recording) for n, v in robot.nominal().items()}
    values |= {"sensor_delay": 0.020 + 0.0007 * recording, "actuator_delay": 0.024 - 0.0003 * recording}
    draws = {n: v * (1 + 0.01 * rng.standard_normal(64)) for n, v in values.items() if "delay" not in n}
    draws["actuator_delay"] = values["actuator_delay"] + rng.uniform(-0.002, 0.002, 64)
    late = rng.gamma(4.0, 3e-4 + 2e-4 * recording, 500)
    nodes, task = training_loop(
        robot, values, draws, {n: EmpiricalDist(late) for n in ("sensor", "agent", "actuator")}, True
    )
    noise = 1e-3 * (1 + recording)
    nodes["sensor"].noise = (Noise("th", "rad", noise, 2 * noise, noise),)
    return GraphEnvironment(CompiledGraph(nodes, "agent", draw(nodes, 1.0, 4, recording), reusable=True), task)


def main():
    """Train after two recordings; print how many programs were compiled, and how many the cache on disk had."""
    events = Counter()
    jax.monitoring.register_event_listener(lambda event, **_: events.update([event.rsplit("/", 1)[-1]]))
    for recording in (0, 1):
        jax.clear_caches()
        events.clear()
        env = environment(recording)
        config = PPOConfig(
            num_envs=4, rollout_steps=4, minibatches=2, epochs=1, total_steps=32, evaluations=2,
            eval_steps=env.length + 1,
        )  # fmt: skip
        train(env, config, jax.random.key(0))
        print(events["cache_misses"], events["cache_hits"])


@pytest.mark.night
def test_a_second_recording_compiles_nothing(tmp_path):
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, str(Path(__file__))]
    done = subprocess.run(command, env={**os.environ, **cache}, capture_output=True, text=True, check=True)
    counts = [[int(n) for n in line.split()] for line in done.stdout.splitlines()]
    assert counts[0][0] > 0
    assert counts[1][0] == 0, counts
    assert counts[1][1] >= counts[0][0]


if __name__ == "__main__":
    main()
