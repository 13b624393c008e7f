"""An arm of six hinges on MJX in a graph, against the same number of bare ``mjx.step`` in the same motion."""

from __future__ import annotations

import sys
from typing import Any

import jax
import jax.numpy as jnp

from benches.graph.shared import EPISODES, MODEL, unroll_of
from benches.rows import Row, compare, row
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.graph.schedule import draw
from sim2real.runtime.compilation.compiled import CompiledGraph
from sim2real.types import Array, Key, PyTree


def arm(links: int) -> tuple[Any, dict[str, BaseNode]]:
    """Return an arm of hinges with friction loss on MJX, and its graph: a policy at 50 Hz over a world at 100 Hz."""
    import mujoco

    from sim2real.worlds.mjx import MjxWorld

    link = (
        '<body pos="0 0 {z}"><joint name="j{i}" axis="{axis}" damping=".05" frictionloss=".02" armature=".01"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 .2" size=".02" mass=".2" contype="0" conaffinity="0"/>'
    )
    bodies = "".join(link.format(z=0.2 * (i > 0), i=i, axis="0 1 0" if i % 2 else "1 0 0") for i in range(links))
    motors = "".join(f'<position joint="j{i}" kp="2"/>' for i in range(links))
    text = (
        '<mujoco><option timestep="0.01" iterations="4" ls_iterations="4"/><worldbody>'
        f"{bodies}{'</body>' * links}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
    world = MjxWorld("world", 100.0, mujoco.MjModel.from_xml_string(text))
    agent = ArmAgent("actuator", 50.0, delay_dist=0.002)
    agent.links = links
    agent.connect(world, skip=True, delay_dist=0.01)
    world.connect(agent, skip=True, delay_dist=0.012)
    return world, {"actuator": agent, "world": world}


class ArmAgent(BaseNode):
    """Waves the joints of the arm."""

    links = 6

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the joints at zero."""
        del rng, graph_state
        return MODEL.Command(action=jnp.zeros(self.links))

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Return the next set points, and lean on what the joints do."""
        return step_state, MODEL.Command(action=wave(step_state.ts, step_state.inputs["world"][-1].data.qpos))


def wave(t: Array, q: Array) -> PyTree:
    """Return the arm's set points at a time [s] and at joint angles ``(N,)`` [rad]."""
    return 0.3 * jnp.sin(3.0 * t + jnp.arange(float(len(q)))) - 0.1 * q


def mjx_case(device: str, copies: int, repeats: int, links: int) -> list[Row]:
    """Measure the arm's graph against the same number of bare ``mjx.step``."""
    from mujoco import mjx

    world, graph_nodes = arm(links)
    graph = CompiledGraph(graph_nodes, "actuator", draw(graph_nodes, 1.0, EPISODES, 0))
    ticks = graph.rows * graph.wiring.ticks

    def start(key: Key) -> PyTree:
        # Every copy from a place of its own: XLA would compute equal copies only once.
        params = world.init_params()
        return params.replace(qpos=params.qpos + jax.random.uniform(key, (links,), minval=-0.1, maxval=0.1))

    def in_graph(key: Key) -> PyTree:
        eps = jax.random.randint(key, (), 0, graph.episodes)
        return graph.rollout(graph.init(key, {"world": start(key)}, eps=eps))[0].state["world"].qpos.sum()

    def bare(key: Key) -> PyTree:
        params = start(key)
        data = world.init_state(key, GraphState(params={"world": params}))

        def step(d: PyTree, t: Array) -> tuple[PyTree, None]:
            # The same motion as in the graph: the solver's iterations depend on what the arm does.
            return mjx.step(params.model, d.replace(ctrl=wave(t, d.qpos))), None

        moved, _ = jax.lax.scan(step, data, jnp.arange(ticks) / world.rate, unroll=unroll_of(graph.wiring.ticks))
        return moved.qpos.sum()

    seconds, compile_s = compare(
        {"bare": bare, "graph": in_graph}, jax.random.split(jax.random.key(0), copies), repeats
    )
    name = f"{device}/mjx_arm/{copies}"
    print(name, seconds, graph.report(), file=sys.stderr)
    rate = copies * ticks / seconds["graph"]
    bare_rate = copies * ticks / seconds["bare"]
    over = round(seconds["graph"] / seconds["bare"], 3)
    return [
        row(f"{name}/over_bare", over, "1", "bare mjx.step in the same motion", "<= 1.1"),
        row(f"{name}/ticks_per_s", round(rate), "1/s", f"{bare_rate:.3g} bare"),
        row(f"{name}/compile_s", round(compile_s["graph"], 1), "s", f"{compile_s['bare']:.1f} bare"),
    ]
