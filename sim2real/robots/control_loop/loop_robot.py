"""A robot of servos in the loop of sensor, agent, actuator and world: its nodes and messages are a subclass's."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode
from sim2real.hardware.device import Device, Reading
from sim2real.hardware.joint import Joint
from sim2real.hardware.safety.config import GateLimits
from sim2real.hardware.safety.gate import GateConfig
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter
from sim2real.policy.upright import Runner
from sim2real.robots.contract import Datum, Robot, positive, tuple_of
from sim2real.robots.control_loop.hardware import Embedded, Excitation, ServoActuator, ServoSensor, ServoSession
from sim2real.robots.control_loop.identification_model import IdentifiableLoop
from sim2real.robots.control_loop.loop import control_nodes, delay_bounds, drawn_in_a_loop, in_a_loop, simulated_loop
from sim2real.robots.control_loop.policy_node import PolicyNode, in_numpy
from sim2real.robots.control_loop.simulated_devices import SimActuator, SimSensor
from sim2real.robots.control_loop.training_task import Draw, LoopTask
from sim2real.train.environment.graph_environment import TrainingTask
from sim2real.train.environment.tasks import Rewards


class LoopRobot(Robot):
    """What robots of servos have in common, however they are driven.

    Attributes:
        tick_s: The world's period [s].
        channels: What is measured of each joint.
        at_rest: The sensor's message of a robot at rest.
        mounting: How the joints are mounted, in the order of the motors; empty: as the device measures and commands
            them. All that the robot says and is told of its joints is on their side; see ``Rig``.
        embedded: The robot inside the computer, for the port ``embedded``; None: there is none. Its plant knows joints
            alone: they are mounted as ``mounting`` says.
        encoder_zero_rad: What the embedded robot's encoders read, from count 0, where the device says 0 [rad].
        message: Makes the actuator's message from a command, shape ``(actions,)``.
        expected_delay_s: Computation delays of sensor, supervisor and actuator that phases allow for: a bus
            transaction, and a policy with its thread's wake-up [s].
        delay_spread_s: By how much a delay that is given to the loop in simulation may be off the one it was made for,
            either way [s].
        lead_s: Time that the world adds to the actuator's delay [s]; see ``ServoWorld.init_delays``.
    """

    tick_s: float
    channels: tuple[Channel, ...]
    at_rest: Any
    mounting: tuple[Joint, ...] = ()
    embedded: Embedded | None = None
    encoder_zero_rad: float = 0.0
    message: Callable[[Any], Any]
    expected_delay_s: tuple[float, float, float] = (0.002, 0.002, 0.002)
    delay_spread_s: float = 0.002
    lead_s: float = 0.0

    _DATA: ClassVar[Mapping[str, Datum]] = {
        **Robot._DATA,
        "tick_s": ("a number above 0 [s]", positive),
        "channels": ("a tuple of sim2real.identify.model.Channel", tuple_of(Channel)),
        "at_rest": ("a message of the sensor", lambda value: value is not None),
        "mounting": ("a tuple of sim2real.hardware.joint.Joint", lambda value: value == () or tuple_of(Joint)(value)),
        "message": ("the type of the actuator's message", callable),
    }

    @abstractmethod
    def dynamics(self) -> list[Parameter]:
        """Return the parameters of the model that may be identified, at their data sheet's values."""

    @abstractmethod
    def make_world(self, resumed: bool = False) -> BaseNode:
        """Return the world's node; ``resumed``: episodes begin in the middle of a recording."""

    @abstractmethod
    def make_agent(self, **options: Any) -> BaseNode:
        """Return the policy's node, with options of ``BaseNode``."""

    @abstractmethod
    def random_params(self, key: jax.Array, draw: Draw) -> dict[str, Any]:
        """Return parameters of the nodes for a random episode of training: dynamics, delays, start, what it is about.

        Args:
            draw: Draws dynamics and delays: key -> values by name.
        """

    def displaced(self, params: Mapping[str, Any], position: jax.Array, velocity: jax.Array) -> dict[str, Any]:
        """Return an episode's parameters with another start; default: changes ``start`` of the world's parameters.

        Args:
            params: What ``random_params`` returned.
            position: What is added to the joints' positions ``(joints,)`` [rad].
            velocity: What is added to their velocities ``(joints,)`` [rad/s].

        Raises:
            UsageError: The world's parameters have no such start.
        """
        world = params[self.roles.world]
        start = getattr(world, "start", None)
        if start is None or jnp.shape(start) != (2 * len(position),):
            raise UsageError(
                f"the start of {type(self).__name__} cannot be moved: its world's parameters have no `start` of "
                f"{len(position)} positions, then velocities",
                hint="give the robot a method displaced(params, position, velocity), or leave out --vary.start-*",
            )
        moved = jnp.asarray(start) + jnp.concatenate([position, velocity])
        return {**params, self.roles.world: world.replace(start=moved)}

    def judged(self, graph_state: GraphState) -> Any:
        """Return what ``reward`` and ``success`` are functions of: the world's state."""
        return graph_state.state[self.roles.world]

    @abstractmethod
    def reward(self, state: Any, action: jax.Array) -> Rewards:
        """Return the reward of a policy step, from what ``judged`` returns after it and the action ``(actions,)``.

        A number, or terms by name whose sum it is: training shows what each of them adds up to.
        """

    @abstractmethod
    def success(self, state: Any) -> jax.Array:
        """Return whether what ``judged`` returns is what the task wants, bool."""

    def terminated(self, state: Any) -> jax.Array:
        """Return whether what ``judged`` returns ends the episode, such as a fall, bool; default: nothing does."""
        del state
        return jnp.bool_(False)

    def true_state(self, state: Any) -> Any:
        """Return what of ``judged`` a value function may see in simulation, a pytree of arrays; default: all of it."""
        return state

    @abstractmethod
    def resumed_params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return parameters of world, sensor and actuator for an episode that begins in the middle of a recording.

        Args:
            start: Shape ``(2 * channels,)``: positions, then velocities.
        """

    @abstractmethod
    def rest_params(self, values: Mapping[str, Any], policy: Any, trial: int) -> dict[str, Any]:
        """Return parameters of all nodes for an episode that begins at rest; see ``simulation_params``.

        Args:
            values: Parameters by name, with delays as a loop needs them.
        """

    @abstractmethod
    def agent_params(self, session: ServoSession, policy: Any, trial: int) -> Any:
        """Return the agent's parameters on hardware."""

    @abstractmethod
    def make_device(self, port: str, silence_s: float) -> Device:
        """Return the servos on a port, not opened yet; ``silence_s``: longest silence while torque is on [s]."""

    @abstractmethod
    def gate(self, limits: GateLimits) -> GateConfig:
        """Return the safety gate in front of the servos."""

    @abstractmethod
    def read(self, reading: Reading) -> Any:
        """Return the sensor's message of a reading."""

    # -- what the stages ask

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> ServoSession:
        """Open the robot, with torque off.

        Args:
            port: Device file of the port, or ``embedded``.
            truth_path: File for the embedded robot's true states and latencies.
        """

        def device(port: str) -> Device:
            return self.make_device(port, limits.servo_watchdog_s)

        twin = self.embedded and self.embedded.mounted(self.mounting, self.encoder_zero_rad)
        return ServoSession(port, device, self.gate(limits), twin, truth_path, seed, self.mounting)

    def recording_nodes(self, session: ServoSession, signal: np.ndarray) -> dict[str, BaseNode]:
        """Return the graph on hardware that plays commands, one row a step ``(N, actions)``."""
        rows = np.asarray(signal, np.float64).reshape(-1, len(self.action))
        name, delay_s = self.roles.supervisor, self.expected_delay_s[1]
        return self._on_hardware(session, Excitation(name, self.rate_hz, rows, self.message, delay=delay_s))

    def deployment_nodes(
        self, session: ServoSession, policy: Runner, trial: int = 0
    ) -> tuple[dict[str, BaseNode], dict[str, Any]]:
        """Return the graph on hardware that runs a policy, and the agent's parameters."""
        params = {self.roles.supervisor: in_numpy(self.agent_params(session, None, trial))}
        agent = PolicyNode(self.make_agent(delay=self.expected_delay_s[1]), policy)
        return self._on_hardware(session, agent), params

    def identifiable(self, max_delay_s: float) -> IdentifiableLoop:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""
        return IdentifiableLoop(self, max_delay_s)

    def training(
        self,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        computation: Mapping[str, DelayDistribution],
        delays: bool,
    ) -> tuple[dict[str, BaseNode], TrainingTask]:
        """Return the loop in simulation and the task.

        Args:
            draws: Samples of some parameters, each of shape ``(K,)``.
            computation: Node -> distribution of its computation delay.
        """
        roles, world = self.roles, self.make_world()
        spread_s = self.delay_spread_s
        draws = drawn_in_a_loop(values, draws, self.tick_s, spread_s)
        values = in_a_loop(values, self.tick_s, spread_s)
        bounds = delay_bounds(values, self.tick_s, spread_s, self.lead_s, draws) if delays else None
        names = (roles.sensor, roles.supervisor, roles.actuator)
        on_sensor, on_agent, on_actuator = (
            {"delay": delay_s if delays else 0.0, "delay_dist": computation.get(name)}
            for name, delay_s in zip(names, self.expected_delay_s, strict=True)
        )
        agent, sensor = self.make_agent(**on_agent), SimSensor(roles.sensor, self.rate_hz, world, **on_sensor)
        nodes = simulated_loop(sensor, agent, self.sim_actuator(**on_actuator), world, bounds)
        return nodes, LoopTask(self, agent, values, draws)

    def simulation_params(self, values: Mapping[str, float], policy: Any, trial: int = 0) -> dict[str, Any]:
        """Return node parameters of the loop in simulation, from rest."""
        return self.rest_params(in_a_loop(values, self.tick_s, self.delay_spread_s), policy, trial)

    def nominal(self) -> dict[str, float]:
        """Return the data sheet's values, without delays."""
        return {p.name: p.nominal for p in self.dynamics()}

    def sim_actuator(self, **options: Any) -> SimActuator:
        """Return the bus in simulation, with options of ``BaseNode``."""
        name, agent = self.roles.actuator, self.roles.supervisor
        return SimActuator(name, self.rate_hz, len(self.action), self.command, self.message, agent, **options)

    def _on_hardware(self, session: ServoSession, agent: BaseNode) -> dict[str, BaseNode]:
        rate, rig, (sensing_s, _, acting_s) = self.rate_hz, session.rig, self.expected_delay_s
        sensor = ServoSensor(self.roles.sensor, rate, rig, self.read, self.at_rest, delay=sensing_s)
        name, field = self.roles.actuator, self.command
        actuator = ServoActuator(name, rate, rig, field, self.message, self.roles.supervisor, delay=acting_s)
        return control_nodes(sensor, agent, actuator)
