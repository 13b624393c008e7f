"""A walking policy on one GPU: learnt steps a second, and the time to a policy.

Warp's kernels are built beforehand, with a row of their own; the compilation cache of a training is empty.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benches.rows import Report, Row, missed, row
from benches.walk import Trial, judged
from sim2real.errors import Sim2RealError, UsageError
from sim2real.runtime.compilation_cache import OFF, VARIABLE

QUICK = {"steps": [4000], "twins": 1, "seconds": 0.2}
KERNELS = "WARP_CACHE_PATH"
PIPELINE = "go2"
_OWN_MEMORY = "XLA_PYTHON_CLIENT_PREALLOCATE"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    add_training_flags(parser)
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[60_000_000], help="steps of each training, from few to many"
    )
    parser.add_argument("--kernels", type=Path, help="folder of Warp's kernels; default: a new one")


def run(options: argparse.Namespace) -> Report:
    """Build kernels, then train until a policy follows its commands without a fall."""
    require_gpu("walk-train")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        os.environ[KERNELS] = str(options.kernels or Path(scratch) / "kernels")
        os.environ[VARIABLE] = OFF
        cold_s, warm_s = alone(first_step), alone(first_step)
        about = f"a first step of the graph takes {cold_s:.1f} s with them, {warm_s:.1f} s without"
        rows += shown([row("walk_train/kernels_s", round(cold_s - warm_s, 1), "s", about)])
        for steps in options.steps:
            of_policy, walks = trained(options, steps, Path(scratch))
            rows += shown(of_policy)
            if walks:
                break
    return {"rows": rows}


def shown(rows: list[Row]) -> list[Row]:
    """Print rows at once, because a bench of minutes on a lent GPU may be cut short; return them."""
    for line in rows:
        print(*(line[key] for key in ("name", "value", "unit", "yardstick")), file=sys.stderr, flush=True)
    return rows


def alone(work: Callable[..., Any], *arguments: object) -> Any:
    """Return the result of a call in a new process, which leaves the GPU's memory with its end."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def trained(options: argparse.Namespace, steps: int, scratch: Path) -> tuple[list[Row], bool]:
    """Train with an empty compilation cache and judge the policy; return the rows, and whether it reaches the goals."""
    new = {VARIABLE: str(scratch / f"programs_{steps}")}
    done = train(steps, shlex.split(options.flags), scratch / f"runs_{steps}", new)
    name, calm = f"walk_train/{steps / 1e6:g}_M", Trial(PIPELINE, done.folder / "bundle", options.seconds)
    rows = [
        row(f"{name}/command_s", round(done.command_s, 1), "s", "from the command to the policy's bundle", "<= 120"),
        row(f"{name}/compile_s", round(done.compile_s, 1), "s", "of it: trace and compile, the cache empty"),
        row(f"{name}/train_s", round(done.train_s, 1), "s", "of it: training and evaluations"),
        row(f"{name}/steps", done.steps, "1", options.flags),
        row(f"{name}/learnt_steps_per_s", round(done.learnt_steps_per_s), "1/s", "one seed", ">= 1e6"),
    ]
    judge = judged({"calm": calm, "pushed": replace(calm, push_m_s=options.push)}, options.twins, name)
    return rows + judge, not any(missed(r) for r in judge if r["name"].startswith(f"{name}/calm/"))


def table(report: Report) -> str:
    """Return the figures of a walking policy's training on one GPU beside their goals."""
    of = {r["name"].removeprefix("walk_train/").split("/", 1)[-1]: r for r in report["rows"]}

    def figure(name: str) -> str:
        unit = f" {of[name]['unit']}".removesuffix(" 1")
        return f"{of[name]['value']:,}{unit}" + f" (goal {of[name]['goal']}, missed)" * missed(of[name])

    return (
        f"{of['steps']['value'] / 1e6:.0f} million steps take {figure('command_s')} on one GPU from starting `train` "
        f"to the saved policy, {figure('compile_s')} of them compilation: {figure('learnt_steps_per_s')}. Once on a "
        f"machine, Warp's kernels take {figure('kernels_s')} more. The policy falls on {figure('calm/falls')} "
        f"twins; its errors are {figure('calm/error_m_s')} and {figure('calm/error_rad_s')}. With pushes it falls on "
        f"{figure('pushed/falls')}.\n"
    )


def first_step() -> float:
    """Return the time until a copy's graph makes its first step in a new process: import, trace, compile, build [s]."""
    begin = time.perf_counter()
    import jax
    import jax.numpy as jnp

    from sim2real.stages.load import load_robot
    from sim2real.stages.train.setup import prepare

    pipeline = load_robot(PIPELINE)
    env, keys = prepare(pipeline, pipeline.defaults.train).env, jax.random.split(jax.random.key(0), 8)
    state, _ = jax.jit(jax.vmap(env.reset))(keys)
    jax.block_until_ready(jax.jit(jax.vmap(env.step))(state, jnp.zeros((8, 12)), keys))
    return time.perf_counter() - begin


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
