"""The asynchronous runtime: steps a second on the simulated clock, and lateness of threads on the wall clock."""

from __future__ import annotations

import argparse
import time

import jax

from benches.rows import Report, Row, row
from sim2real.graph.node import BaseNode
from sim2real.robots.nodes import SimActuator, SimSensor
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import Clock
from sim2real.stages.load import load_module

WARM_S = 0.5
"""Time on the wall clock before the measurement [s]."""
QUICK = {"seconds": 0.2, "rate": 100.0, "steps": 20}


def loop(rate_hz: float) -> dict[str, BaseNode]:
    """Return the pendulum's four nodes at one rate."""
    model = load_module("pendulum", "model")
    delay = 0.2 / rate_hz
    world = model.PendulumWorld("world", rate_hz)
    sensor = SimSensor("sensor", rate_hz, world, delay_dist=delay)
    agent = model.Agent("agent", rate_hz, delay_dist=delay)
    actuator = SimActuator("actuator", rate_hz, 1, "action", model.Command, delay_dist=delay)
    sensor.connect(world)
    agent.connect(sensor, blocking=True, window=3)
    actuator.connect(agent, blocking=True)
    world.connect(actuator, skip=True)
    return {n.name: n for n in (sensor, agent, actuator, world)}


def simulated(steps: int) -> list[Row]:
    """Measure the simulated clock at its highest speed."""
    nodes = loop(50.0)
    graph = AsyncGraph(nodes, nodes["agent"], clock=Clock.SIMULATED, duration_s=(steps + 50) / 50.0)
    state = graph.init(jax.random.key(0))
    graph.warmup(state)
    with graph:
        state, _ = graph.reset(state)
        begin = time.perf_counter()
        for _ in range(steps):
            state, _ = graph.step(state)
        seconds = time.perf_counter() - begin
    rate = round(steps / seconds)
    return [
        row("graph/simulated/steps_per_s", rate, "supervisor steps/s", "the seed's framework: 115 to 204", ">= 1000")
    ]


def wall_clock(rate_hz: float, seconds: float) -> list[Row]:
    """Measure four jitted nodes on the wall clock."""
    nodes = loop(rate_hz)
    graph = AsyncGraph(nodes, nodes["agent"])
    state = graph.init(jax.random.key(0))
    graph.warmup(state)
    with graph:
        graph.start(state)
        graph.run_for(WARM_S)
        begin = time.process_time()
        graph.run_for(seconds)
        cpu = (time.process_time() - begin) / seconds
    rows = []
    for name, node in graph.statistics().items():
        late = [round(1e3 * q, 3) for q in node.lateness_s]
        what = f"async/{rate_hz:g}_hz/{name}"
        rows.append(row(f"{what}/lateness_ms", late, "ms", "p50, p99, max"))
        rows.append(row(f"{what}/overruns", node.overruns, f"of {node.steps}"))
    rows.append(row(f"async/{rate_hz:g}_hz/cpu", round(cpu, 3), "cores", goal="< 0.5"))
    return rows


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the run on the wall clock")
    parser.add_argument("--rate", type=float, default=200.0, help="rate of every node [Hz]")
    parser.add_argument("--steps", type=int, default=5000, help="supervisor steps on the simulated clock")


def run(options: argparse.Namespace) -> Report:
    """Measure both clocks."""
    return {"rows": [*simulated(options.steps), *wall_clock(options.rate, options.seconds)]}
