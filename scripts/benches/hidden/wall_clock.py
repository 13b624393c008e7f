"""Hidden robots on the wall clock: as emulated servos on a bus, recorded and deployed to by the stages themselves."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benches.hidden.robots import SPEED_NOISE, Hidden

PLANT = f"{Path(__file__).with_name('plant.py')}:HiddenPlant"


def put_on_the_bus(robot: Hidden, pipeline: Any) -> None:
    """Make a hidden robot the pipeline's emulated one, for this process; latencies are uniform, as wide as its own.

    The computer's own pauses are those of this machine: ``hiccups`` are not played.
    """
    pipeline_robot = pipeline.load()
    jitter = math.sqrt(3.0) * robot.jitter
    emulator = replace(
        pipeline_robot.drive.embedded.emulator,
        sensing_latency_s=robot.sensing,
        sensing_jitter_s=min(jitter, robot.sensing),
        actuation_latency_s=robot.acting,
        actuation_jitter_s=min(jitter, robot.acting),
        reply_loss=float(robot.lost),
    )
    names = ("gain", "gravity", "damping", "friction", "play", "noise")
    plant = {n: float(getattr(robot, n)) for n in names} | {
        "speed_noise": float(SPEED_NOISE * robot.noise),
        "seed": robot.seed,
    }
    pipeline_robot.drive.embedded = replace(
        pipeline_robot.drive.embedded, plant=PLANT, emulator=emulator, plant_args=plant
    )


def record(pipeline: Any, folder: Path, seconds: float, volts: float, seed: int) -> Any:
    """Return a recording of the robot on the bus.

    Args:
        volts: Its largest voltage [V].
    """
    import sim2real

    folder.mkdir()
    config = replace(pipeline.record, duration_s=seconds, amplitude=volts, seed=seed)
    return sim2real.record(pipeline, folder, config)


def deploy(pipeline: Any, bundle: Any, folder: Path, seconds: float, trials: int) -> list[tuple[np.ndarray, ...]]:
    """Return times [s], true angles [rad] and speeds [rad/s] of each deployment to the robot on the bus."""
    import sim2real

    folder.mkdir()
    config = replace(pipeline.deploy, duration_s=seconds, episodes=trials, measure_delay=False)
    deployment = sim2real.deploy(pipeline, bundle, folder, config)
    motions = []
    for recording in deployment.recordings:
        t_s, states = recording.true_states()
        motions.append((t_s, states["th"], states["thdot"]))
    return motions
