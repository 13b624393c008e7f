"""The pendulum's parts for the stages: its graphs in simulation, what to identify, and its task."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import SafetyStop
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode
from sim2real.identify.model import Channel
from sim2real.identify.parameters import ParameterTable
from sim2real.robots.devices import SimSensor
from sim2real.robots.loop import DelayParams, control_nodes, delay_bounds, in_a_loop, recorded_loop, simulated_loop
from sim2real.stages.config import GateLimits

from . import hardware, parameters
from .model import HISTORY, Agent, AgentParams, Command, DelayedWorld, SimActuator
from .task import LIMIT_V, SwingUp, upright

RATE_HZ = 50.0
SUPERVISOR = "agent"
COMMAND = ("actuator", "action")
UNITS = {"th": "rad", "thdot": "rad/s", "action": "V", "voltage": "V", "command": "V"}
JOINTS = {
    "sensor": {"hinge": {"position": "th", "velocity": "thdot"}},
}
OBSERVATION = [
    ("cos(th), sin(th), thdot / 10", ("1", "1", "rad/s"), 1),
    ("past cos(th), sin(th), thdot / 10", ("1", "1", "rad/s"), HISTORY),
    ("past voltage", ("V",), HISTORY),
]
ACTION = [("voltage", "V")]
ACTION_BOUNDS = [(-LIMIT_V, LIMIT_V)]
WORLD_HZ = 100.0
_PUSHES, _PUSH_V, _PUSH_S = 5, 1.5, 0.3
DELAY_SPREAD_S = 0.002
"""By how much delays vary between episodes of training, either way [s]."""
EXPECTED_DELAY_S = {"sensor": 0.002, "agent": 0.002, "actuator": 0.002}
"""Computation delay that phases allow for: a bus transaction, and a policy with its thread's wake-up [s]."""


class IdentifiablePendulum:
    """What the identify stage needs to know: see ``sim2real.identify.model.IdentifiableModel``."""

    sensor = "sensor"
    ahead_s = 1 / WORLD_HZ
    channels = (Channel("th", "thdot", position_sigma=0.002, velocity_sigma=0.05),)

    def __init__(self, max_delay_s: float = 0.06) -> None:
        self.parameters: ParameterTable = parameters.table(max_delay_s)
        self.given: Mapping[str, Any] = {"actuator": Command(action="action")}

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, actuator and world, with delays of up to ``max_delay_s`` [s] between them."""
        world = DelayedWorld("world", WORLD_HZ)
        sensor, actuator = SimSensor("sensor", RATE_HZ, world), SimActuator("actuator", RATE_HZ)
        return recorded_loop(sensor, actuator, world, max_delay_s, self.ahead_s)

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters for values and an initial state ``(th, thdot)``."""
        late = DelayParams(values["sensor_delay"] + self.ahead_s)
        return {**parameters.node_params(values, start), "sensor": late}


def connect(port: str, limits: GateLimits, truth_path: Path, seed: int) -> hardware.Session:
    """Open the robot on a port, or the embedded one, with torque off."""
    return hardware.Session(port, limits, truth_path, seed)


def recording_nodes(session: hardware.Session, signal: np.ndarray) -> dict[str, BaseNode]:
    """Return the graph on hardware that plays a signal, one voltage a step ``(N,)`` [V]."""
    agent = hardware.Excitation("agent", RATE_HZ, signal, delay=EXPECTED_DELAY_S["agent"])
    return _on_hardware(session, agent)


def prepare(session: hardware.Session, settle_s: float) -> None:
    """Bring the pendulum to rest hanging down: friction can hold it upright, and then it is pushed over.

    Raises:
        SafetyStop: It does not hang after five pushes, or what the gate stopped.
        HardwareLost: It does not come to rest within ``settle_s`` [s].
    """
    rig = session.rig
    for _ in range(_PUSHES):
        angle = rig.wait_until_still(settle_s).position_rad[0] - hardware.UPRIGHT_RAD
        if np.cos(angle) < -0.95:
            return
        rig.start()
        try:
            for _ in range(round(_PUSH_S * RATE_HZ)):
                rig.command(np.array([_PUSH_V]), 0.0, time.monotonic())
                time.sleep(1 / RATE_HZ)
        finally:
            rig.stop()
    raise SafetyStop(
        f"the pendulum does not hang down after {_PUSHES} pushes of {_PUSH_V} V", hint="free it, or check its encoder"
    )


def deployment_nodes(
    session: hardware.Session, policy: Any, trial: int = 0
) -> tuple[dict[str, BaseNode], dict[str, Any]]:
    """Return the graph on hardware that runs a policy, and the agent's parameters; every trial is the same."""
    del trial
    agent = Agent("agent", RATE_HZ, delay=EXPECTED_DELAY_S["agent"])
    return _on_hardware(session, agent), {"agent": AgentParams(policy=policy)}


def identifiable(max_delay_s: float) -> IdentifiablePendulum:
    """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""
    return IdentifiablePendulum(max_delay_s)


def training(
    values: Mapping[str, float],
    draws: Mapping[str, np.ndarray],
    computation: Mapping[str, DelayDistribution],
    delays: bool,
) -> tuple[dict[str, BaseNode], SwingUp]:
    """Return the loop in simulation and the task.

    Args:
        values: Parameters by name.
        draws: Dynamics that episodes take instead, ``(K,)`` each, drawn together.
        computation: Computation delays by node.
        delays: Whether there are delays; without them every message arrives at once.
    """

    def options(name: str) -> dict[str, Any]:
        return {"delay": EXPECTED_DELAY_S[name] if delays else 0.0, "delay_dist": computation.get(name)}

    values = in_a_loop(values, 1 / WORLD_HZ, DELAY_SPREAD_S)
    world = DelayedWorld("world", WORLD_HZ)
    sensor = SimSensor("sensor", RATE_HZ, world, **options("sensor"))
    agent = Agent("agent", RATE_HZ, **options("agent"))
    actuator = SimActuator("actuator", RATE_HZ, **options("actuator"))
    bounds = delay_bounds(values, 1 / WORLD_HZ, DELAY_SPREAD_S) if delays else None
    nodes = simulated_loop(sensor, agent, actuator, world, bounds)
    return nodes, SwingUp(agent, values, draws, DELAY_SPREAD_S if delays else 0.0)


def simulation_params(values: Mapping[str, float], policy: Any, trial: int = 0) -> dict[str, Any]:
    """Return node parameters of the loop in simulation, hanging at rest, with a policy; every trial is the same."""
    del trial
    values = in_a_loop(values, 1 / WORLD_HZ, DELAY_SPREAD_S)
    return {**parameters.node_params(values, [np.pi, 0.0]), "agent": AgentParams(policy=policy)}


def nominal() -> dict[str, float]:
    """Return the data sheet's values, without delays."""
    return {p.name: p.nominal for p in parameters.table(0.06) if p.kind == "dynamics"}


def score(t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return how well the pendulum was swung up and held.

    ``success`` is the share of the second half in which it was upright, ``first_upright_s`` when it first came up [s];
    the deviations are of the second half.
    """
    good = np.asarray(upright(states["th"], states["thdot"]))
    last = t_s >= t_s[-1] - (t_s[-1] - t_s[0]) / 2
    up = np.flatnonzero(np.cos(states["th"]) > 0.95)
    off = np.arctan2(np.sin(states["th"]), np.cos(states["th"]))[last]
    half = len(states["command"]) // 2
    return {
        "success": float(good[last].mean()),
        "first_upright_s": float(t_s[up[0]] - t_s[0]) if up.size else float("nan"),
        "angle_rms_rad": float(np.sqrt(np.mean(off**2))),
        "speed_rms_rad_s": float(np.sqrt(np.mean(states["thdot"][last] ** 2))),
        "command_rms_v": float(np.sqrt(np.mean(states["command"][half:] ** 2))),
    }


def _on_hardware(session: hardware.Session, agent: BaseNode) -> dict[str, BaseNode]:
    sensor = hardware.ServoSensor("sensor", RATE_HZ, session.rig, delay=EXPECTED_DELAY_S["sensor"])
    actuator = hardware.ServoActuator("actuator", RATE_HZ, session.rig, delay=EXPECTED_DELAY_S["actuator"])
    return control_nodes(sensor, agent, actuator)
