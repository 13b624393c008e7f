"""MuJoCo Playground's walking Go1 with brax's PPO beside our Go2, both on MuJoCo Warp of one GPU, in one run.

Both train with their own settings: Playground's are those of `brax_ppo_config`. Each error is that of the policy in its
own simulation: commands, noise and robots differ, and Playground's has no delay. Steps a second compare the trainers.
Needs `pip install playground==0.2.0`, which brings brax.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from benches.rows import Report, Row, row, values
from benches.walk import Trial, judged
from benches.walking.train import KERNELS, PIPELINE, add_training_flags, alone, first_step, require_gpu, shown, train
from sim2real.errors import UsageError
from sim2real.runtime.compilation_cache import VARIABLE

QUICK = {"steps": 4000, "twins": 1, "seconds": 0.2, "judged": 8}
ROBOT = "Go1JoystickFlatTerrain"


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    add_training_flags(parser)
    parser.add_argument("--steps", type=int, default=60_000_000, help="steps of each training")
    parser.add_argument("--judged", type=int, default=256, help="copies that judge Playground's policy")


def run(options: argparse.Namespace) -> Report:
    """Train both, with kernels built beforehand and an empty compilation cache."""
    device = require_gpu("walk-rival")
    if find_spec("mujoco_playground") is None:
        raise UsageError("MuJoCo Playground is not installed", hint="pip install playground==0.2.0")
    with tempfile.TemporaryDirectory() as scratch:
        os.environ.setdefault(KERNELS, str(Path(scratch) / "kernels"))
        alone(first_step_of_rival)  # builds Playground's kernels
        played = alone(rival, options.steps, options.judged, options.seconds)
        runs = Path(scratch) / "runs"
        alone(first_step)  # builds ours
        done = train(options.steps, shlex.split(options.flags), runs, {VARIABLE: str(Path(scratch) / "programs")})
        ours, last = done.learnt_steps_per_s, played[-1]
        # Compilation is in the first part of the training: rates are of the others.
        learnt = (last["steps"] - played[1]["steps"]) / max(last["train_s"] - played[1]["train_s"], 1e-9)
        rows: list[Row] = shown(
            [
                row("walk_rival/ours/learnt_steps_per_s", round(ours), "1/s", f"one seed, {device}"),
                row("walk_rival/ours/command_s", round(done.command_s, 1), "s", f"{done.steps} steps, to the bundle"),
                row("walk_rival/playground/learnt_steps_per_s", round(learnt), "1/s", "without its first third"),
                row("walk_rival/learnt_ratio", round(ours / learnt, 2), "1", "ours over Playground's", ">= 1"),
                *(of_rival(part) for part in played[1:]),
            ]
        )
        calm = Trial(PIPELINE, done.folder / "bundle", options.seconds)
        rows += shown(judged({"calm": calm}, options.twins, "walk_rival/ours", goals=False))
    return {"rows": rows, "playground": played}


def of_rival(part: dict[str, Any]) -> Row:
    """Return Playground's row of the errors after some steps."""
    about = f"{part['error_rad_s']:.3f} rad/s, {part['fell']} of {part['of']} fell, after {part['wall_s']:.0f} s"
    return row(
        f"walk_rival/playground/{part['steps'] / 1e6:.0f}_M/error_m_s", round(part["error_m_s"], 4), "m/s", about
    )


def rival(steps: int, copies: int, seconds: float) -> list[dict[str, Any]]:
    """Train Playground's Go1 with brax's PPO; return steps, times and errors of its policy on the way."""
    begin = time.perf_counter()
    import functools

    import jax
    import jax.numpy as jnp

    if not hasattr(jax, "device_put_replicated"):  # brax 0.14.2 calls what jax 0.11 does not have any more
        jax.device_put_replicated = lambda tree, devices: jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo.train import train as learn
    from mujoco_playground import wrapper
    from mujoco_playground.config import locomotion_params

    env = without_meshes()
    settings = dict(locomotion_params.brax_ppo_config(ROBOT)) | {"num_timesteps": steps}
    settings |= {"run_evals": False, "num_evals": 4}
    if steps < 1_000_000:
        settings |= {"num_envs": 64, "num_minibatches": 2, "batch_size": 32, "num_resets_per_eval": 0}
    net = functools.partial(networks.make_ppo_networks, **settings.pop("network_factory"))
    parts: list[dict[str, Any]] = []
    judging_s = 0.0

    def judge(step: int, make_policy: Any, params: Any) -> None:
        nonlocal judging_s
        jax.block_until_ready(params)
        now = time.perf_counter()
        scores = walked(env, make_policy(params, deterministic=True), copies, round(seconds / env.dt))
        parts.append({"steps": step, "wall_s": now - begin, "train_s": now - begin - judging_s, **scores})
        print(f"Playground: {parts[-1]}", file=sys.stderr, flush=True)
        judging_s += time.perf_counter() - now

    learn(
        environment=env,
        wrap_env_fn=wrapper.wrap_for_brax_training,
        network_factory=net,
        policy_params_fn=judge,
        **settings,
    )
    return parts


def first_step_of_rival() -> None:
    """Make a step of Playground's environment."""
    import jax
    import jax.numpy as jnp

    env, keys = without_meshes(), jax.random.split(jax.random.PRNGKey(0), 8)
    state = jax.jit(jax.vmap(env.reset))(keys)
    jax.block_until_ready(jax.jit(jax.vmap(env.step))(state, jnp.zeros((8, env.action_size))))


def without_meshes() -> Any:
    """Return Playground's environment without its meshes: they are only drawn, and lie in another repository."""
    from mujoco_playground import registry
    from mujoco_playground._src import mjx_env
    from mujoco_playground._src.locomotion.go1 import base

    read = base.get_assets
    mesh = re.compile(rb'<mesh [^>]*/>|<geom [^>]*mesh="[^"]*"[^>]*/>')
    base.get_assets = lambda: {
        name: mesh.sub(b"", text).replace(b'<geom type="mesh"', b"<geom") if name.endswith(".xml") else text
        for name, text in read().items()
    }
    mjx_env.ensure_menagerie_exists = lambda: None
    env: Any = registry.load(ROBOT)
    # Its solver stops at a limit on purpose; kernels would print a line for each such step.
    env._mjx_model = env._mjx_model.tree_replace({"opt._impl.warn_overflow": 0})
    return env


def walked(env: Any, policy: Any, copies: int, steps: int) -> dict[str, Any]:
    """Return how many copies fell, and the mean errors of the others from their commands."""
    import jax
    import jax.numpy as jnp

    def step(carry: Any, _: Any) -> Any:
        state, key = carry
        key, own = jax.random.split(key)
        state = jax.vmap(env.step)(state, policy(state.obs, own)[0])
        velocity, aim = jax.vmap(env.get_local_linvel)(state.data), state.info["command"]
        off = jnp.linalg.norm(velocity[:, :2] - aim[:, :2], axis=1)
        return (state, key), (off, jnp.abs(jax.vmap(env.get_gyro)(state.data)[:, 2] - aim[:, 2]), state.done)

    @jax.jit
    def play(key: Any) -> Any:
        start = jax.vmap(env.reset)(jax.random.split(key, copies))
        return jax.lax.scan(step, (start, key), length=steps)[1]

    off, turned, done = play(jax.random.PRNGKey(1))
    stayed = ~jnp.any(done > 0, axis=0)
    mean = lambda values: float(jnp.sum(values.mean(0) * stayed) / jnp.maximum(stayed.sum(), 1))  # noqa: E731
    fell = int(copies - stayed.sum())
    return {"fell": fell, "of": copies, "error_m_s": mean(off), "error_rad_s": mean(turned)}


def table(report: Report) -> str:
    """Return a paragraph about MuJoCo Playground's training beside ours."""
    v, last, flags = values(report, "walk_rival/"), report["playground"][-1], report["flags"]
    return (
        f"MuJoCo Playground trains its Go1 with brax's PPO, in the same run and with its own settings, at "
        f"{v['playground/learnt_steps_per_s'] / 1e6:.2f} M learnt steps a second; ours learnt "
        f"{v['ours/learnt_steps_per_s'] / 1e6:.2f} M. After {last['steps'] / 1e6:.0f} M steps and "
        f"{last['wall_s']:.0f} s its error was {last['error_m_s']:.3f} m/s, and {last['fell']} of {last['of']} "
        f"copies fell in {flags['seconds']:g} s. After {flags['steps'] / 1e6:.0f} M steps and "
        f"{v['ours/command_s']:.0f} s ours was {v['ours/calm/error_m_s']:.3f} m/s, and {v['ours/calm/falls']} of "
        f"{flags['twins']} twins fell. Each error is of the policy's own simulation: the robots, commands and "
        "noise differ, and Playground's robot has no delay.\n"
    )
