"""The compiled graph against the same robot written by hand, and against bare physics, in one run.

The robot is the seed's pendulum: sensor, agent, actuator and world, a policy that draws random actions and keeps four
past observations and actions, two Runge-Kutta substeps of 10 ms, 4 s, delays as in the seed's notebook.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from benches.rows import Report, Row, compare, row, values
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.delays import StaticDist
from sim2real.graph.node import BaseNode
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.robots.nodes import SimActuator, SimSensor
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import load_module
from sim2real.types import Array, Key, PyTree
from sim2real.worlds.joint import JointWorld

MODEL = load_module("pendulum", "model")
DURATION_S, EPISODES = 4.0, 32
CASES = {
    "plain": ((50.0, 50.0, 0.01), (1,)),
    "hiccups": ((50.0, 50.0, 0.01), (1,)),
    "30_over_100_hz": ((30.0, 100.0, 0.005), (3, 3, 4)),
}
"""Kinds of timelines: rates of agent and world [Hz], the world's substep [s]; world ticks after each policy step."""
QUICK = {"copies": [2], "repeats": 1, "cases": ["hiccups"]}


class _Normal:
    """The fields of ``distrax.Normal`` that the graph reads, as a GPU machine may have no distrax."""

    def __init__(self, loc: float, scale: float) -> None:
        self.loc, self.scale = loc, scale

    def sample(self, seed: Key, sample_shape: tuple[int, ...]) -> PyTree:
        return self.loc + self.scale * jax.random.normal(seed, sample_shape)


_Normal.__name__ = "Normal"


class RandomAgent(MODEL.Agent):
    """The seed's agent without a policy: random actions, but observations and histories are kept."""

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Draw an action."""
        rng, key = jax.random.split(step_state.rng)
        action = jax.random.uniform(key, (1,), minval=-2.0, maxval=2.0)
        return self.act(step_state.replace(rng=rng), action)


class CostWorld(JointWorld):
    """The seed's world, Runge-Kutta with Coulomb friction by sign: it adds up the cost beside the physics."""

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the nominal parameters."""
        del rng, graph_state
        return MODEL.nominal_params()

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Start at the parameters' state, at no cost."""
        start = ((graph_state or GraphState()).params.get(self.name) or self.init_params(rng)).start
        return MODEL.Measurement(th=start[0], thdot=start[1]), jnp.float32(0.0)

    def command(self, step_state: StepState) -> PyTree:
        """Return the voltage during this tick [V]."""
        return step_state.inputs["actuator"][-1].data.action[0]

    def derivative(self, params: PyTree, state: PyTree, command: Array) -> PyTree:
        """Return velocity [rad/s] and acceleration [rad/s^2]."""
        p, th, thdot = params, state.th, state.thdot
        motor = p.K / p.R * (command - p.K * thdot)
        gravity = p.mass * MODEL.GRAVITY * p.length * jnp.sin(th)
        return MODEL.Measurement(th=thdot, thdot=(motor + gravity - p.b * thdot - p.c * jnp.sign(thdot)) / p.J)

    def integrate(self, params: PyTree, state: PyTree, command: PyTree) -> PyTree:
        """Return the state one tick later, by the classical Runge-Kutta method of order four."""

        def substep(x: PyTree, h: float) -> PyTree:
            moved = lambda k, t: jax.tree.map(lambda a, b: a + t * b, x, k)  # noqa: E731
            k1 = self.derivative(params, x, command)
            k2 = self.derivative(params, moved(k1, h / 2), command)
            k3 = self.derivative(params, moved(k2, h / 2), command)
            k4 = self.derivative(params, moved(k3, h), command)
            slope = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
            after = moved(slope, h)
            return after.replace(thdot=jnp.clip(after.thdot, -params.max_speed, params.max_speed))

        return self.over_substeps(substep, state)

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the initial angle and velocity."""
        return self.init_state(rng, graph_state)[0]

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Integrate, and add the cost."""
        x, cost = step_state.state
        moved, output = super().step(step_state.replace(state=x))
        u = self.command(step_state)
        return moved.replace(state=(moved.state, cost + task_cost(moved.state, u))), output


def task_cost(x: PyTree, u: Array) -> PyTree:
    """Return the seed's cost of a state under a voltage."""
    th = x.th - 2 * jnp.pi * jnp.floor((x.th + jnp.pi) / (2 * jnp.pi))
    return th**2 + 0.1 * (x.thdot / (1 + 10 * jnp.abs(th))) ** 2 + 0.01 * u**2


def nodes(agent_hz: float = 50.0, world_hz: float = 50.0, substep_s: float = 0.01) -> dict[str, BaseNode]:
    """Return the seed's graph with the delays of its notebook."""
    dist = lambda loc, scale: StaticDist(_Normal(loc, scale))  # noqa: E731
    world = CostWorld("world", world_hz, substep_s=substep_s)
    sensor = SimSensor("sensor", agent_hz, world, delay_dist=dist(0.0075, 0.003))
    agent = RandomAgent("agent", agent_hz, delay_dist=dist(0.01, 0.003))
    actuator = SimActuator("actuator", agent_hz, 1, MODEL.Command, delay_dist=dist(0.0075, 0.003))
    agent.connect(sensor, blocking=True, window=3, delay_dist=dist(0.002, 0.002))
    actuator.connect(agent, blocking=True, delay_dist=dist(0.002, 0.002))
    world.connect(actuator, skip=True, delay_dist=dist(0.01, 0.002))
    sensor.connect(world, delay_dist=dist(0.01, 0.002))
    return {n.name: n for n in (sensor, agent, actuator, world)}


def timelines(graph_nodes: dict[str, BaseNode], hiccup: bool = False) -> Timeline:
    """Draw the bench's timelines; with ``hiccup`` the agent takes 50 ms longer about every 500 steps."""
    if hiccup:
        agent = graph_nodes["agent"]
        agent.delay_dist = _WithHiccups(agent.delay_dist)
    return draw(graph_nodes, DURATION_S, EPISODES, 0)


class _WithHiccups(StaticDist):
    def __init__(self, base: PyTree) -> None:
        super().__init__(base.dist)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        return super().sample(rng, shape) + np.where(rng.random(shape) < 1 / 500, 0.05, 0.0)


def params() -> PyTree:
    """Return the seed's parameters."""
    return MODEL.nominal_params().replace(max_speed=40.0)


def graph_program(graph: CompiledGraph) -> Callable[[PyTree], PyTree]:
    """Return the rollout of one copy, on a random timeline."""

    def run(key: Key) -> PyTree:
        k_init, k_eps, k_th = jax.random.split(key, 3)
        start = jnp.stack([jax.random.uniform(k_th, (), minval=-3.14, maxval=3.14), jnp.float32(0.0)])
        eps = jax.random.randint(k_eps, (), 0, graph.episodes)
        gs, _ = graph.rollout(graph.init(k_init, {"world": params().replace(start=start)}, eps=eps))
        return gs.state["world"][1] + gs.state["agent"].past.sum()

    return run


def hand_program(rows: int, ticks: tuple[int, ...], world: CostWorld, unroll: int = 1) -> Callable[[PyTree], PyTree]:
    """Return the same robot without a graph: shift registers, one step of delay each way."""
    p = params()
    shift = lambda ring, new: jnp.concatenate([new[None], ring[:-1]])  # noqa: E731

    def run(key: Key) -> PyTree:
        def policy_step(carry: PyTree, count: int) -> PyTree:
            x, cost, rng, commands, sensed, observations, actions = carry
            rng, k = jax.random.split(rng)
            action = jax.random.uniform(k, (1,), minval=-2.0, maxval=2.0)
            features = jnp.stack([jnp.cos(sensed[0, 0]), jnp.sin(sensed[0, 0]), sensed[0, 1] / 10.0])
            commands, observations, actions = (
                shift(commands, action),
                shift(observations, features),
                shift(actions, action),
            )
            for _ in range(count):
                x, cost = tick(world, p, x, cost, commands[1, 0])
            sensed = shift(sensed, jnp.stack([x.th, x.thdot]))
            return x, cost, rng, commands, sensed, observations, actions

        def row(carry: PyTree, _: None) -> tuple[PyTree, None]:
            for count in ticks:
                carry = policy_step(carry, count)
            return carry, None

        th = jax.random.uniform(key, (), minval=-3.14, maxval=3.14)
        x = MODEL.Measurement(th=th, thdot=jnp.float32(0.0))
        zeros = jnp.zeros
        carry = (x, jnp.float32(0.0), key, zeros((2, 1)), zeros((3, 2)), zeros((4, 3)), zeros((4, 1)))
        carry, _ = jax.lax.scan(row, carry, length=rows, unroll=unroll)
        return carry[1] + carry[5].sum() + carry[6].sum()

    return run


def tick(world: CostWorld, p: PyTree, x: PyTree, cost: PyTree, u: Array) -> tuple[PyTree, PyTree]:
    """Integrate one tick of the world under a voltage, and add the cost."""
    x = world.integrate(p, x, u)
    return x, cost + task_cost(x, u)


def case(device: str, kind: str, copies: int, repeats: int) -> list[Row]:
    """Measure one kind of timelines at one number of copies."""
    rates, ticks = CASES[kind]
    graph_nodes = nodes(*rates)
    graph = CompiledGraph(graph_nodes, "agent", timelines(graph_nodes, kind == "hiccups"))
    world = graph_nodes["world"]
    total = graph.rows * graph.wiring.ticks
    loops = total // sum(ticks)
    rows_per_pass = 1 if jax.default_backend() == "cpu" else 2  # as in the graph's loop
    programs = {
        "hand": hand_program(loops, ticks, world),
        # Several policy steps in a row are unrolled as they are; twice of it took XLA 8 times as long on an H200.
        "unrolled": hand_program(loops, ticks, world, rows_per_pass if len(ticks) == 1 else 1),
        "graph": graph_program(graph),
    }
    seconds, compile_s = compare(programs, jax.random.split(jax.random.key(0), copies), repeats)
    # The programs may differ by a tick or two in length: compared per tick.
    per_tick = {n: s / (total if n == "graph" else loops * sum(ticks)) for n, s in seconds.items()}
    report = graph.report()
    print(kind, copies, {n: f"{1e3 * s:.2f} ms" for n, s in seconds.items()}, report, file=sys.stderr)
    over = {b: per_tick["graph"] / per_tick[b] for b in ("hand", "unrolled")}
    label = f"{device}/{copies}" if kind == "plain" else f"{device}/{kind}/{copies}"
    goal = "<= 1.2" if kind == "plain" else "<= 1.15 times the plain timelines"
    return [
        row(f"{label}/over_hand", round(over["hand"], 3), "1", "hand-written", goal),
        row(f"{label}/over_hand_unrolled", round(over["unrolled"], 3), "1", "hand-written, loop unrolled as ours"),
        row(f"{label}/compile_s", round(compile_s["graph"], 2), "s", f"{compile_s['hand']:.2f} by hand", "< 5"),
    ]


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--copies", type=int, nargs="+", help="default: 1024 on the CPU, 20000 and 100000 on a GPU")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--name", help="name of the device in the rows; default: cpu or gpu")
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES), help="kinds of timelines")


def run(options: argparse.Namespace) -> Report:
    """Measure on the device that JAX finds."""
    device = f"graph/{options.name or jax.default_backend()}"
    copies = options.copies or ([1024] if jax.default_backend() == "cpu" else [20_000, 100_000])
    cases = [(device, kind, count, options.repeats) for count in copies for kind in options.cases]
    return {"rows": [r for arguments in cases for r in case(*arguments)]}


def table(report: Report) -> str:
    """Return how long the compiled pendulum takes against a simulation written by hand."""

    def between(what: str, uneven: bool) -> str:
        rows = values(report).items()
        several = [v for n, v in rows if n.endswith(f"/{what}") and ("30_over_100_hz" in n) == uneven]
        return f"{min(several):.2f} to {max(several):.2f}"

    return (
        f"The compiled pendulum takes {between('over_hand', False)} times as long on an "
        f"{report['flags']['name'].upper()} as a simulation written by hand,\n"
        f"{between('over_hand_unrolled', False)} times as long if that simulation has an unrolled loop too, and\n"
        f"{between('over_hand', True)} times as long if rates do not divide.\n"
    )
