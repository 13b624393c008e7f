"""Robots of a control loop as the last release described them, for one release: parts call a subclass's methods."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.hardware.joint import Joint
from sim2real.identify.parameters import Parameter
from sim2real.robots.contract import Robot, RobotAgent, RobotDrive, RobotModel, RobotSensor, RobotTask, Session
from sim2real.robots.control_loop.hardware import Embedded, ServoSession
from sim2real.robots.control_loop.loop import Draw, in_a_loop
from sim2real.robots.control_loop.messages import EpisodeStart
from sim2real.robots.probe import Probe
from sim2real.robots.roles import Roles
from sim2real.train.environment.tasks import Rewards
from sim2real.types import Array, Key, PyTree, Scalar

if TYPE_CHECKING:
    from sim2real.hardware.device import Reading
    from sim2real.robots.gate_limits import GateLimits


@dataclass(frozen=True)
class _Params:
    """A start that is already the parameters of all nodes, or of the agent alone."""

    params: PyTree
    trial: int = 0


class LoopRobot(Robot):
    """A robot whose parts call the methods of a subclass.

    Write a ``Robot`` with five parts instead, as docs/tutorial_device.md does: this class goes with the next release.
    """

    mounting: tuple[Joint, ...] = ()
    embedded: Embedded | None = None
    encoder_zero_rad: float = 0.0
    probe: Probe | None = None
    limits: Mapping[str, float] = {}
    expected_delay_s: tuple[float, float, float] = (0.002, 0.002, 0.002)
    lead_s: float = 0.0

    def __init_subclass__(cls, **options: object) -> None:
        """Warn of the next release."""
        super().__init_subclass__(**options)
        warnings.warn(
            f"{cls.__name__} inherits from LoopRobot, which goes with the next release: write a "
            "sim2real.robots.contract.Robot with five parts, as in docs/tutorial_device.md",
            FutureWarning,
            stacklevel=2,
        )

    def __init__(self) -> None:
        self.sensor, self.drive, self.agent = _Sensor(self), _Drive(self), _Agent(self)
        self.model, self.task = _Model(self), _Task(self)

    def judged(self, graph_state: GraphState) -> PyTree:
        """Return the state that ``reward`` and ``success`` evaluate: the world's."""
        return graph_state.state[self.roles.world]

    def terminated(self, state: PyTree) -> jax.Array:
        """Return whether the episode ends, bool."""
        del state
        return jnp.bool_(False)

    def true_state(self, state: PyTree) -> PyTree:
        """Return the part of the world's state that a value function may observe."""
        return state

    def displaced(self, params: Mapping[str, PyTree], position: Array, velocity: Array) -> dict[str, PyTree]:
        """Return an episode's parameters with another start: ``start`` of the world's parameters is changed."""
        world = params[self.roles.world]
        moved = jnp.asarray(world.start) + jnp.concatenate([jnp.asarray(position), jnp.asarray(velocity)])
        return {**params, self.roles.world: world.replace(start=moved)}

    def around(self, signal: np.ndarray) -> np.ndarray:
        """Return the commands of an excitation."""
        return signal

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> ServoSession:
        """Open the robot, with torque off."""
        robot: Any = self
        embedded = self.embedded and self.embedded.mounted(self.mounting, self.encoder_zero_rad)
        silence_s, gate = limits.servo_watchdog_s, robot.gate(limits)
        return ServoSession(
            port, lambda p: robot.make_device(p, silence_s), gate, embedded, truth_path, seed, self.mounting
        )

    def simulation_params(
        self, values: Mapping[str, float], policy: PyTree, trial: int = 0, measured: np.ndarray | None = None
    ) -> dict[str, PyTree]:
        """Return the nodes' parameters for an episode in simulation that starts at rest."""
        del measured
        robot: Any = self
        return robot.rest_params(in_a_loop(values, self.model.tick_s, self.delay_spread_s), policy, trial)

    def node_parameters(self, values: Mapping[str, Scalar], start: PyTree, policy: PyTree = None) -> dict[str, PyTree]:
        """Return the parameters of all nodes."""
        if isinstance(start, _Params):
            return dict(start.params)
        robot: Any = self
        resumed = robot.resumed_params(values, jnp.concatenate([start.position, start.velocity]))
        return {self.roles.supervisor: policy, **resumed}


class _Sensor(RobotSensor):
    def __init__(self, robot: Any) -> None:
        self._robot, self.channels, self.joints = robot, robot.channels, robot.joints
        self.units, self.at_rest = robot.units, robot.at_rest

    def read(self, reading: Reading) -> PyTree:
        return self._robot.read(reading)


class _Drive(RobotDrive):
    units: Mapping[str, str] = {}

    def __init__(self, robot: Any) -> None:
        self._robot, self.rate_hz, self.command, self.message = robot, robot.rate_hz, robot.command, robot.message
        self.expected_delay_s, self.probe, self.embedded = robot.expected_delay_s, robot.probe, robot.embedded

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> ServoSession:
        return self._robot.connect(port, limits, truth_path, seed)

    def prepare(self, session: Session, settle_s: float) -> None:
        self._robot.prepare(session, settle_s)

    def around(self, signal: np.ndarray) -> np.ndarray:
        return self._robot.around(signal)

    def measured_start(self, session: Session, start: PyTree) -> PyTree:
        return _Params(self._robot.agent_params(session, None, start.trial))


class _Agent(RobotAgent):
    def __init__(self, robot: Any) -> None:
        self._robot, self.observation, self.action = robot, robot.observation, robot.action
        self.limits, self.tilt_rad = robot.limits, getattr(robot, "tilt_rad", None)

    def make(self, rate_hz: float, **options: Unpack[NodeOptions]) -> BaseNode:
        del rate_hz
        return self._robot.make_agent(**options)

    def params(self, start: PyTree, policy: PyTree) -> PyTree:
        del policy
        return start.params


class _Model(RobotModel):
    def __init__(self, robot: Any) -> None:
        self._robot, self.tick_s, self.lead_s = robot, robot.tick_s, robot.lead_s
        causes = type(robot).causes
        self.causes = {} if isinstance(causes, property) else causes

    def dynamics(self) -> list[Parameter]:
        return self._robot.dynamics()

    def make_world(self, resumed: bool = False) -> BaseNode:
        return self._robot.make_world(resumed)

    def params(self, values: Mapping[str, Scalar], start: EpisodeStart) -> PyTree:
        return self._robot.node_parameters(values, start)[self._robot.roles.world]

    def true_state(self, state: PyTree) -> PyTree:
        return self._robot.true_state(state)


class _Task(RobotTask):
    def __init__(self, robot: Any) -> None:
        self._robot = robot

    def random(self, key: Key, draw: Draw) -> tuple[dict[str, PyTree], Any]:
        return {}, _Params(self._robot.random_params(key, draw))

    def at_rest(self, trial: int) -> PyTree:
        return _Params(None, trial)

    def moved(self, start: PyTree, position: Array, velocity: Array) -> PyTree:
        return _Params(self._robot.displaced(start.params, position, velocity))

    def judged(self, graph_state: GraphState, roles: Roles) -> PyTree:
        del roles
        return self._robot.judged(graph_state)

    def reward(self, state: PyTree, action: jax.Array) -> Rewards:
        return self._robot.reward(state, action)

    def success(self, state: PyTree) -> jax.Array:
        return self._robot.success(state)

    def terminated(self, state: PyTree) -> jax.Array:
        return self._robot.terminated(state)

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        return self._robot.score(t_s, states)
