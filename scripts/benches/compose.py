"""A composed task on MuJoCo Warp, alone and in a graph with delays, against bare ``mjx.step``."""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from mujoco import mjx

from benches.rows import Report, Row, medians, row, values
from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import MJCFFeature
from sim2real.composer.physics.mjx.warp.warp import overflowed
from sim2real.errors import Sim2RealError
from sim2real.graph import Base, BaseNode
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.types import Array, Key, PyTree

LEGS = {"fl": (1, 1), "fr": (1, -1), "hl": (-1, 1), "hr": (-1, -1)}
TIMESTEP, SUBSTEPS = 0.004, 5
CONTACTS, ROWS = 24, 96
"""Room for contacts, times the number of copies, which share it, and for rows of constraints in each copy."""
EPISODES = 32


def quadruped() -> Any:
    """Return a body on four legs with three position servos each."""
    root = mjcf.RootElement(model="quadruped")
    root.worldbody.add("geom", name="torso", type="box", size=[0.2, 0.1, 0.05], mass=6)
    root.worldbody.add("site", name="torso")
    for name, (front, left) in LEGS.items():
        hip = root.worldbody.add("body", name=f"{name}_hip", pos=[0.2 * front, 0.1 * left, 0])
        thigh = hip.add("body", name=f"{name}_thigh", pos=[0, 0.05 * left, 0])
        shin = thigh.add("body", name=f"{name}_shin", pos=[0, 0, -0.2])
        for part, body, axis, end in (
            ("hip", hip, [1, 0, 0], [0, 0.05 * left, 0]),
            ("thigh", thigh, [0, 1, 0], [0, 0, -0.2]),
            ("shin", shin, [0, 1, 0], [0, 0, -0.2]),
        ):
            joint = body.add("joint", name=f"{name}_{part}", type="hinge", axis=axis, damping=1, armature=0.01)
            body.add("geom", name=f"{name}_{part}", type="capsule", fromto=[0, 0, 0, *end], size=[0.02], mass=0.5)
            root.actuator.add("position", name=f"{name}_{part}", joint=joint, kp=100)
    return composer.ModelWrapperEntity(root)


def walk() -> Any:
    """Return a task with five observables, two of them late, a random start, a reward and a termination."""

    class Walk(composer.Task):
        """Keep the body up."""

        def __init__(self) -> None:
            robot = quadruped()
            arena = composer.Arena()
            arena.mjcf_model.worldbody.add("geom", type="plane", size=[50, 50, 0.1])
            option = arena.mjcf_model.option
            option.cone, option.iterations, option.ls_iterations = "pyramidal", 10, 20
            self._root_entity, self.robot = arena, robot
            arena.add_free_entity(robot).pos = [0, 0, 0.42]
            model = robot.mjcf_model
            self.joints, self.torso = model.find_all("joint", exclude_attachments=True), model.find("site", "torso")
            gyro = model.sensor.add("gyro", site=self.torso)
            late = {"delay": 3, "buffer_size": 2}
            add = robot.observables.add_observable
            add("angles", MJCFFeature("qpos", self.joints, **late))
            add("speeds", MJCFFeature("qvel", self.joints))
            add("gyro", MJCFFeature("sensordata", gyro, **late))
            add("axes", MJCFFeature("xmat", self.torso))
            self.set_timesteps(SUBSTEPS * TIMESTEP, TIMESTEP)

        def initialize_episode(self, physics: Any, random_state: PyTree) -> None:
            physics.bind(self.joints).qpos = random_state.uniform(-0.1, 0.1, len(self.joints))

        def get_reward(self, physics: Any) -> Any:
            return physics.bind(self.torso).xpos[2] + physics.bind(self.torso).xmat[8]

        def should_terminate_episode(self, physics: Any) -> Any:
            return physics.bind(self.torso).xpos[2] < 0.1

    return Walk()


def wave(t: Array, angles: Array) -> Any:
    """Return set points of the servos at a time [s] and at joint angles ``(12,)`` [rad]."""
    return 0.15 * jnp.sin(9.0 * t + jnp.arange(12.0)) - 0.1 * angles


def make_graph(task: Any, options: dict[str, Any], seconds: float) -> Any:
    """Return the task as the world of a graph, with an agent whose messages are late by chance."""

    @struct.dataclass
    class Angles(Base):
        action: Any

    class Agent(BaseNode):
        """Waves the legs, with feedback of their angles."""

        def init_output(self, rng: Key | None = None, graph_state: PyTree = None) -> Any:
            return Angles(jnp.zeros(12))

        def step(self, step_state: PyTree) -> Any:
            angles = step_state.inputs["world"][-1].data.values["quadruped/angles"]
            return step_state, Angles(wave(step_state.ts, angles[-1]))

    world = composer.ComposedWorld("world", task, **options)
    agent = Agent("actuator", rate=world.rate, delay_dist=0.003)
    agent.connect(world, skip=True, delay_dist=0.004)
    world.connect(agent, skip=True, delay_dist=0.005)
    nodes = {"actuator": agent, "world": world}
    return CompiledGraph(nodes, "actuator", draw(nodes, seconds, EPISODES, 0))


def programs(copies: int, length: int) -> tuple[dict[str, tuple[Any, Any]], int]:
    """Return name -> (program of one copy, starts of all copies), and the number of control steps."""
    options = {"impl": "warp", "nconmax": CONTACTS, "njmax": ROWS}
    environment = composer.MjxEnvironment(walk(), time_limit=1e3, **options)
    graph = make_graph(walk(), options, length * SUBSTEPS * TIMESTEP)
    ticks, joints = graph.rows * graph.wiring.ticks, slice(7, None)
    times = jnp.arange(ticks) * SUBSTEPS * TIMESTEP
    model = environment.mjx_model
    blank = mjx.make_data(environment.model, impl="warp", naconmax=copies * CONTACTS, njmax=ROWS)

    def bare(start: PyTree) -> Any:
        def step(data: PyTree, t: Array) -> Any:
            data = data.replace(ctrl=wave(t, data.qpos[joints]))
            return jax.lax.scan(lambda d, _: (mjx.step(model, d), None), data, length=SUBSTEPS)[0], None

        return left(jax.lax.scan(step, blank.replace(qpos=start[0], qvel=start[1]), times)[0])

    def env(start: PyTree) -> Any:
        def step(state: PyTree, t: Array) -> Any:
            state = environment.step(state, wave(t, state.data.qpos[joints]))
            return state, (state.reward, sum(x.sum() for x in state.observation.values()), state.done)

        state, outcome = jax.lax.scan(step, start, times)
        return left(state.data), outcome

    def in_graph(key: Key) -> Any:
        eps = jax.random.randint(key, (), 0, graph.episodes)
        return left(graph.rollout(graph.init(key, eps=eps))[0].state["world"].data)

    keys = jax.random.split(jax.random.key(0), copies)
    starts = jax.jit(jax.vmap(environment.reset))(keys)
    states = {"bare": (bare, (starts.data.qpos, starts.data.qvel)), "env": (env, starts), "graph": (in_graph, keys)}
    return states, ticks


def left(data: PyTree) -> Any:
    """Return positions, whether contacts or constraints had no room, and the number of rows of constraints."""
    return data.qpos, overflowed(data), data._impl.nefc


def compared(copies: int, repeats: int, length: int) -> list[Row]:
    """Return the rows of one number of copies."""
    begin = time.perf_counter()
    states, ticks = programs(copies, length)
    first_s, calls, compile_s, rows = time.perf_counter() - begin, {}, {}, {}
    for name, (program, starts) in states.items():
        begin = time.perf_counter()
        compiled = jax.jit(jax.vmap(program)).lower(starts).compile()
        compile_s[name] = time.perf_counter() - begin
        calls[name] = lambda compiled=compiled, starts=starts: jax.block_until_ready(compiled(starts))
        _, overflow, rows[name] = jax.tree_util.tree_leaves(calls[name]())[:3]
        compile_s[name] = time.perf_counter() - begin
        if np.any(overflow):
            raise RuntimeError(f"{name}: contacts or constraints of {np.sum(overflow)} copies had no room")
    seconds = medians(calls, repeats)
    rate = {n: copies * ticks * SUBSTEPS / s for n, s in seconds.items()}
    constraints = ", ".join(f"{np.mean(r):.1f}" for r in rows.values())
    print(copies, seconds, compile_s, f"rows of constraints: {constraints}", file=sys.stderr)
    about = f"bare mjx.step of Warp under the same control, {copies} copies"
    name = f"compose/{jax.default_backend()}/warp/{copies}"
    lines = [row(f"{name}/bare_steps_per_s", round(rate["bare"]), "1/s", "physics steps, mjx.step alone")]
    for key in ("env", "graph"):
        over = round(seconds[key] / seconds["bare"], 3)
        lines.append(row(f"{name}/{key}_over_bare", over, "1", about, "<= 1.1"))
        lines.append(row(f"{name}/{key}_steps_per_s", round(rate[key]), "1/s", f"{rate['bare']:.3g} bare"))
        compile_about = f"and a first rollout; {compile_s['bare']:.1f} bare"
        lines.append(row(f"{name}/{key}_compile_s", round(compile_s[key], 1), "s", compile_about))
    return [*lines, row(f"{name}/first_reset_s", round(first_s, 1), "s", "environment, graph, first reset")]


def table(report: Report) -> str:
    """Return the times of tasks on MuJoCo Warp over those of bare steps."""
    v = values(report, "compose/gpu/warp/")
    copies = list(dict.fromkeys(int(name.partition("/")[0]) for name in v))

    def span(name: str) -> str:
        each = [v[f"{n}/{name}"] for n in copies]
        return f"{min(each):.3f} to {max(each):.3f}"

    compiled = [v[f"{n}/{kind}_compile_s"] for n in copies for kind in ("env", "graph")]
    kernels_s = max(v[f"{n}/first_reset_s"] for n in copies)
    return (
        f"With {copies[0]:,} to {copies[-1]:,} copies a task with late observables takes {span('env_over_bare')} times "
        f"as long as its physics alone, and in a graph with delays {span('graph_over_bare')} times. `mjx.step` alone "
        f"makes {v[f'{copies[-1]}/bare_steps_per_s'] / 1e6:.1f} million steps a second at the most copies. A program "
        f"takes {min(compiled):.0f} to {max(compiled):.0f} s to compile; Warp's kernels take {kernels_s:.0f} s "
        "more, once for a machine.\n"
    )


QUICK = {"repeats": 1, "copies": [2], "steps": 2}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--copies", type=int, nargs="+", help="default: 8 on the CPU, three sizes on a GPU")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--steps", type=int, default=100, help="control steps in a rollout")


def run(options: argparse.Namespace) -> Report:
    """Measure on the device that JAX finds."""
    if importlib.util.find_spec("warp") is None:
        raise Sim2RealError("MuJoCo Warp is not installed", hint='pip install ".[warp]"')
    sizes = options.copies or ((8,) if jax.default_backend() == "cpu" else (4096, 8192, 32768))
    return {"rows": [r for copies in sizes for r in compared(copies, options.repeats, options.steps)]}
