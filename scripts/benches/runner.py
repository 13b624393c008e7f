"""A policy on the robot: a single step of it, and the loop of twelve joints of an emulated Go2 over DDS."""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np

from benches.rows import Report, Row, markdown, missed, row
from pipelines.go2.plant import LYING
from sim2real.emulation.process import EmbeddedRobot
from sim2real.graph.node import BaseNode
from sim2real.hardware.device import Device
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig
from sim2real.policy import ActionTerm, ObservationTerm, PolicyContract, PolicyRunner
from sim2real.policy.bundle import make_runner
from sim2real.robots.agent import DirectAgent
from sim2real.robots.loop import control_nodes
from sim2real.robots.messages import Goals, JointReading
from sim2real.robots.nodes import PolicyNode, ServoActuator, ServoSensor
from sim2real.robots.walking.drive import LegCommand
from sim2real.runtime.asynchronous import AsyncGraph
from sim2real.runtime.clock import realtime

QUICK = {"steps": 200, "seconds": 0.5, "rate": 50.0}
JOINTS, LIMIT_V = 12, 2.0


def policy(observations: int, actions: int, rate_hz: float, hidden: tuple[int, ...] = (64, 64)) -> PolicyRunner:
    """Return a policy of random weights.

    Args:
        rate_hz: Its rate [Hz].
    """
    rng, sizes = np.random.default_rng(0), (observations, *hidden, actions)
    bounds = {"low": np.full(actions, -LIMIT_V), "high": np.full(actions, LIMIT_V), "log_std": np.zeros(actions)}
    weights = {"mean": np.zeros(observations), "std": np.ones(observations), **bounds}
    for i, (a, b) in enumerate(itertools.pairwise(sizes)):
        weights |= {f"layers.{i}.kernel": rng.normal(size=(a, b)) / np.sqrt(a), f"layers.{i}.bias": np.zeros(b)}
    terms = (ObservationTerm("seen", ("1",) * observations),)
    contract = PolicyContract(
        terms, tuple(ActionTerm(f"u{i}", "V", -LIMIT_V, LIMIT_V) for i in range(actions)), rate_hz
    )
    return make_runner(weights, contract)


def a_step(steps: int) -> list[Row]:
    """Measure single steps of a policy, with the checks of observations and actions."""
    runner, rng = policy(32, 8, 50.0), np.random.default_rng(1)
    observations = rng.normal(size=(steps, 32)).astype(np.float32)
    runner.reset()
    took_us = np.empty(steps)
    with realtime():
        for i, observation in enumerate(observations):
            begin = time.perf_counter_ns()
            runner(observation)
            took_us[i] = 1e-3 * (time.perf_counter_ns() - begin)
    p50, p99 = np.quantile(took_us, [0.5, 0.99])
    what = "runner/numpy/32-64-64-8"
    return [row(f"{what}/p50_us", round(p50, 1), "us", goal="< 50"), row(f"{what}/p99_us", round(p99, 1), "us")]


def _see(reading: JointReading) -> Any:
    return np.concatenate([reading.position, reading.velocity]).astype(np.float32)


def _damped(torque: Any) -> LegCommand:
    rest = np.zeros(JOINTS)
    return LegCommand(np.array(LYING), rest, rest, np.full(JOINTS, 3.0), torque)


def nodes_of(rig: Rig, rate_hz: float) -> dict[str, BaseNode]:
    """Return sensor, policy and actuator of twelve joints."""
    rest = JointReading(np.zeros(JOINTS), np.zeros(JOINTS))
    agent = DirectAgent("agent", rate_hz, _see, (2 * JOINTS, JOINTS), 1, Goals, delay=0.0005)
    return control_nodes(
        ServoSensor(
            "sensor", rate_hz, rig, lambda r: JointReading(r.position_rad, r.velocity_rad_s), rest, delay=0.001
        ),
        PolicyNode(agent, policy(5 * JOINTS, JOINTS, rate_hz)),
        ServoActuator("actuator", rate_hz, rig, "goal", _damped, delay=0.0005),
    )


@contextmanager
def legs() -> Iterator[Rig]:
    """Yield a rig of an emulated Go2 that lies, over DDS."""
    from sim2real.emulation.legs import UnitreeEmulation
    from sim2real.hardware.unitree.device import UnitreeLegs

    with EmbeddedRobot("pipelines.go2.plant:Go2Body", UnitreeEmulation()) as robot:
        device = UnitreeLegs(robot.port, silence_s=1.0, max_silence_s=1.0)
        low, high = device.reach()
        gate = GateConfig((low.tolist(), high.tolist()), stale=device.commanded.stale)
        with Rig(device, gate) as rig:
            yield rig


def loop(what: str, rig: Rig, nodes: dict[str, BaseNode], rate_hz: float, seconds: float, spin_s: float) -> list[Row]:
    """Measure the lateness of the nodes of twelve joints on the wall clock, beside the emulator."""
    with realtime():
        graph = AsyncGraph(nodes, nodes["agent"], spin_s=spin_s)
        with graph:
            graph.start(graph.init(jax.random.key(0)))
            begin = time.process_time()
            graph.run_for(seconds)
            cpu = (time.process_time() - begin) / seconds
            statistics = graph.statistics()
        lost, bus_ms = rig.device.counters.lost_replies, 1e-3 * np.array(rig.measuring.transfer_us)
    rows = []
    for name, node in statistics.items():
        late = [round(1e3 * q, 3) for q in node.lateness_s]
        rows.append(row(f"{what}/{name}/lateness_ms", late, "ms", "p50, p99, max", "p99 < 1"))
        rows.append(row(f"{what}/{name}/overruns", node.overruns, f"of {node.steps}"))
    took = np.quantile(bus_ms, [0.5, 0.99]).round(3).tolist()
    rows.append(row(f"{what}/reading_ms", took, "ms", "p50, p99; the period is 1 / rate", f"< {1e3 / rate_hz:g}"))
    rows.append(row(f"{what}/cpu", round(cpu, 3), "cores"))
    return [*rows, row(f"{what}/lost_replies", lost, "")]


def a_cycle(device: Device, cycles: int) -> Row:
    """Measure the processor time of one reading and one command of a device whose torque is off."""
    device.enable()
    rest = device.rest()
    begin = time.thread_time()
    for _ in range(cycles):
        device.measure()
        device.command(rest)
    took_us = 1e6 * (time.thread_time() - begin) / cycles
    device.disable()
    return row("runner/go2/measure_and_command_us", round(took_us), "us of the processor", goal="< 500")


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--steps", type=int, default=20_000, help="single steps of the policy")
    parser.add_argument("--rate", type=float, default=500.0, help="rate of sensor, policy and actuator [Hz]")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the loop")
    parser.add_argument(
        "--spin-s", type=float, default=0.0, help="time before a step in which threads poll the clock [s]"
    )


def run(options: argparse.Namespace) -> Report:
    """Measure single steps of the policy, and the loops."""
    flags, rows = (options.rate, options.seconds, options.spin_s), a_step(options.steps)
    with legs() as rig:
        rows.append(a_cycle(rig.device, options.steps // 10))
        rows += loop(f"runner/go2_{options.rate:g}_hz", rig, nodes_of(rig, options.rate), *flags)
    return {"rows": rows}


def table(report: Report) -> str:
    """Return the time of a policy's step, and the lateness of the loops, beside their goals."""
    of = {r["name"].removeprefix("runner/"): r for r in report["rows"]}
    rate = report["flags"]["rate"]
    lines = [("a step of the policy in numpy, median", "numpy/32-64-64-8/p50_us", "us")]
    lines += [("the Go2's `measure` and `command`, processor time", "go2/measure_and_command_us", "us")]
    base, what, nodes = f"go2_{rate:g}_hz", f"the Go2 at {rate:g} Hz", ("sensor", "agent", "actuator")
    lines += [(f"{what}: lateness of {n}, p99", f"{base}/{n}/lateness_ms", "ms") for n in nodes]
    lines.append((f"{what}: wait for a reading, p99", f"{base}/reading_ms", "ms"))
    cells = []
    for about, name, unit in lines:
        value = of[name]["value"][1] if isinstance(of[name]["value"], list) else of[name]["value"]
        cells.append((about, f"{value:g} {unit}", of[name]["goal"] + ", missed" * missed(of[name])))
    return markdown(("", "measured", "goal"), cells)
