"""Trainings of the Go2 by the command line, each in a process of its own."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sim2real.errors import Sim2RealError, UsageError

PIPELINE = "go2"
_OWN_MEMORY = "XLA_PYTHON_CLIENT_PREALLOCATE"


@dataclass(frozen=True)
class Trained:
    """A finished training.

    Attributes:
        folder: Folder of the stage, with the bundle.
        command_s: Time from the start of the command to its end [s].
    """

    folder: Path
    command_s: float
    compile_s: float
    train_s: float
    steps: int
    learnt_steps_per_s: float


def require_gpu(bench: str) -> str:
    """Return the name of the GPU; raise a ``UsageError`` without one.

    JAX takes little of its memory in this process: the trainings have processes of their own.
    """
    os.environ.setdefault(_OWN_MEMORY, "false")
    import jax

    if jax.default_backend() != "gpu":
        raise UsageError(
            f"{bench} trains on MuJoCo Warp, which needs a GPU, and JAX has none here",
            hint="`bench.py walk` judges a policy without a GPU",
        )
    return jax.devices()[0].device_kind


def add_training_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a bench that trains and judges policies."""
    # Updates after 12 rows: with 24, 60 M steps ended at an error of 0.42 m/s; with 12 at 0.09 m/s, in the same time.
    usual = "--ppo.num-envs=8192 --ppo.rollout-steps=12 --ppo.minibatches=8 --ppo.evaluations=1"
    parser.add_argument("--flags", default=usual, help="flags of `sim2real train go2`, in one word")
    parser.add_argument("--twins", type=int, default=50, help="hidden twins that judge a policy")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of an episode of a twin [s]")
    parser.add_argument("--push", type=float, default=0.5, help="size of a push every 5 s [m/s]")


def train(steps: int, flags: Sequence[str], runs: Path, environment: Mapping[str, str]) -> Trained:
    """Run ``sim2real train go2`` with flags; return its bundle and its times.

    Args:
        steps: Steps in all copies together.
        runs: A new folder of runs.
        environment: Variables of the process beside those of this one.
    """
    from sim2real.artifacts.bundle import Bundle

    inherited = {name: value for name, value in os.environ.items() if name != _OWN_MEMORY}
    command = [sys.executable, "-m", "sim2real.cli", "train", PIPELINE, "--runs", str(runs)]
    command += [f"--ppo.total-steps={steps}", *flags]
    begin = time.perf_counter()
    done = subprocess.run(command, env={**inherited, **environment}, capture_output=True, text=True)
    took_s = time.perf_counter() - begin
    if done.returncode:
        text = done.stderr[-3000:]
        raise Sim2RealError(f"`sim2real train {PIPELINE}` ended with exit code {done.returncode}:\n{text}")
    (folder,) = runs.glob(f"{PIPELINE}/*/train")
    history = Bundle.load(folder).history
    assert history is not None
    times = history.compile_s, history.train_s, history.env_steps_per_s
    compile_s, train_s, steps_per_s = (float(t or 0.0) for t in times)
    steps_done = int(history.steps[-1])
    return Trained(folder, took_s, compile_s, train_s, steps_done, steps_per_s)
