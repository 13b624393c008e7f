"""The Go2's graph with delays, randomised parameters and reward on Warp, against as many bare ``mjx.step``."""

from __future__ import annotations

import time
from typing import Any

from benches.rows import Row, medians, row
from benches.walking.training import PIPELINE
from sim2real.types import Array, PyTree

ROOMS = (16, 96)
"""Contacts and rows of constraints that Warp has room for in a copy, as in training."""


def first_step() -> float:
    """Return the time until a copy's graph makes its first step in a new process: import, trace, compile, build [s]."""
    begin = time.perf_counter()
    import jax

    env, keys = _environment(), jax.random.split(jax.random.key(0), 8)
    state, _ = jax.jit(jax.vmap(env.reset))(keys)
    jax.block_until_ready(jax.jit(jax.vmap(env.step))(state, _stand(8), keys))
    return time.perf_counter() - begin


def over_bare(copies: int, repeats: int, steps: int) -> list[Row]:
    """Return the time of policy steps in the graph over that of bare physics steps of a robot that stands.

    Args:
        steps: Policy steps of a rollout.
    """
    import jax

    programs, ticks = _programs(copies, steps)
    calls, compile_s = {}, {}
    for name, (program, starts) in programs.items():
        begin = time.perf_counter()
        compiled = jax.jit(program).lower(starts).compile()
        compile_s[name] = time.perf_counter() - begin
        calls[name] = lambda compiled=compiled, starts=starts: jax.block_until_ready(compiled(starts))
    seconds = medians(calls, repeats)
    rate = {name: copies * ticks * steps / s for name, s in seconds.items()}
    name = f"walk_train/{copies}"
    about = f"bare mjx.step of Warp, standing too; median of {repeats} rollouts of {steps} policy steps"
    return [
        row(f"{name}/graph_over_bare", round(seconds["graph"] / seconds["bare"], 3), "1", about, "<= 1.1"),
        row(f"{name}/graph_steps_per_s", round(rate["graph"]), "1/s", f"physics steps; {rate['bare']:.4g} bare"),
        row(f"{name}/graph_compile_s", round(compile_s["graph"], 1), "s", f"{compile_s['bare']:.1f} bare"),
    ]


def _environment() -> Any:
    """Return the environment of ``sim2real train go2`` without pushes: the robot stands as the bare one does."""
    from dataclasses import replace

    from sim2real.stages.pipeline.pipeline import load_pipeline
    from sim2real.stages.train.training_setup import prepare

    pipeline = load_pipeline(PIPELINE)
    config = replace(pipeline.train, vary=replace(pipeline.train.vary, push=0.0))
    return prepare(pipeline, config).env


def _stand(copies: int) -> Array:
    import jax.numpy as jnp

    return jnp.zeros((copies, 12))


def _programs(copies: int, steps: int) -> tuple[dict[str, tuple[Any, PyTree]], int]:
    """Return name -> (program of all copies, their starts), and the physics steps of a policy step."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    env = _environment()
    world = env.graph.nodes["world"]
    keys = jax.random.split(jax.random.key(0), copies)
    states, _ = jax.jit(jax.vmap(env.reset))(keys)
    data = states.graph.state["world"].data
    world_model, ticks, (contacts, rows) = world.environment.mjx_model, env.graph.wiring.ticks, ROOMS
    blank = mjx.make_data(world.environment.model, impl="warp", naconmax=copies * contacts, njmax=rows)

    def bare(starts: PyTree) -> Any:
        def one(start: PyTree) -> Any:
            moved = blank.replace(qpos=start[0], qvel=start[1], ctrl=start[2])
            return jax.lax.scan(lambda d, _: (mjx.step(world_model, d), None), moved, length=ticks * steps)[0].qpos

        return jax.vmap(one)(starts)

    def graph(starts: PyTree) -> Any:
        def one(state: PyTree, key: Any) -> Any:
            def policy_step(now: PyTree, _: None) -> Any:
                state, total = now
                step = env.step(state, jnp.zeros(12), key)
                return (step.state, total + step.reward + step.observation.sum()), None

            (state, total), _ = jax.lax.scan(policy_step, (state, jnp.float32(0.0)), length=steps)
            return state.graph.state["world"].data.qpos, total

        return jax.vmap(one)(*starts)

    return {"bare": (bare, (data.qpos, data.qvel, data.ctrl)), "graph": (graph, (states, keys))}, ticks
