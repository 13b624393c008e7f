"""A robot of position-controlled servos, for the stages: its model, task and numbers are a subclass's."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import SafetyStop
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.node import BaseNode
from sim2real.hardware.config import GateLimits
from sim2real.hardware.device import Device, Reading
from sim2real.hardware.emulation import Emulation
from sim2real.hardware.gate import GateConfig
from sim2real.hardware.registry import load_device
from sim2real.identify.parameters import Parameter
from sim2real.robots import standard
from sim2real.robots.agent import AgentParams, GoalAgent
from sim2real.robots.datasheet import DataSheet
from sim2real.robots.devices import SimActuator, SimSensor
from sim2real.robots.hardware import Embedded, Excitation, ServoActuator, ServoSensor, ServoSession
from sim2real.robots.identifiable import IdentifiableServos
from sim2real.robots.loop import DelayParams, control_nodes, delay_bounds, in_a_loop, simulated_loop
from sim2real.robots.messages import Goals, JointReading
from sim2real.robots.parts import GoalTask
from sim2real.robots.simulated import ServoWorld
from sim2real.robots.training import ServoTask

EXPECTED_DELAY_S = {"sensor": 0.004, "agent": 0.003, "actuator": 0.002}
"""Computation delay that phases allow for: a bus transaction, and a policy with its thread's wake-up [s]."""

_AT_HOME_RAD, _HOME_RAD_S, _HOLD_S = 0.1, 1.0, 0.5


@dataclass(frozen=True)
class Servos:
    """The servos on the bus, in the order of the joints.

    Attributes:
        joints: Names.
        ids: Numbers on the bus.
        low: Lowest goals [rad].
        high: Highest goals [rad].
        sheet: What their data sheet says, and how they are set up.
        speed: The fastest that a policy moves goals [rad/s].
        rest: Where the joints hang without torque [rad]; default: 0.
        rest_tolerance: How far from there an episode may start [rad].
        baud_rate: Of the bus.
        device: Name of the device that they are; see `sim2real.hardware.registry`.
    """

    joints: tuple[str, ...]
    ids: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    sheet: DataSheet
    speed: float = 1.5
    rest: tuple[float, ...] = ()
    rest_tolerance: float = 0.4
    baud_rate: int = 1_000_000
    device: str = "dynamixel"

    @property
    def at_rest(self) -> np.ndarray:
        """Where the joints hang without torque, ``(joints,)`` [rad]."""
        return np.asarray(self.rest or np.zeros(len(self.joints)), np.float64)


class ServoRobot(ABC):
    """Fulfils ``sim2real.stages.robot.Robot``; ``ROBOT = MyRobot()`` in ``pipelines/NAME/robot.py`` is a robot.

    Attributes:
        servos: The servos.
        aim: What an episode is about: names and units of its entries.
        features: What the policy sees of the present: names and units; see ``observe``.
        history: Past steps that the policy sees.
        position_sigma_rad: Deviation of a measured position.
        velocity_sigma_rad_s: Deviation of a measured velocity.
        delay_spread_s: By how much delays vary between episodes of training, either way [s].
    """

    RATE_HZ = 50.0
    SUPERVISOR = "agent"
    COMMAND = ("actuator", "goal")

    servos: Servos
    aim: tuple[tuple[str, str], ...] = ()
    features: tuple[tuple[str, tuple[str, ...]], ...] | None = None
    history: int = 3
    position_sigma_rad: float = 0.002
    velocity_sigma_rad_s: float = 0.05
    delay_spread_s: float = 0.002

    # -- what a robot says about itself

    @property
    def embedded(self) -> Embedded | None:
        """The robot inside the computer, for the port ``embedded``; see ``twin``."""
        return None

    @abstractmethod
    def make_task(self) -> GoalTask:
        """Return a new task; its control step is the world's tick."""

    @abstractmethod
    def draw_aim(self, key: jax.Array) -> jax.Array:
        """Return the aim of an episode, ``(k,)``."""

    @abstractmethod
    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return how well an episode went, ``success`` in [0, 1] among it.

        Args:
            t_s: Times ``(N,)`` [s].
            states: ``position[i]``, ``velocity[i]`` ``(N,)`` [rad, rad/s]; ``command[i]`` and ``aim[i]``, once a step.
                A robot of one joint, or an aim of one entry, has no ``[i]``.
        """

    @abstractmethod
    def success(self, state: Any) -> jax.Array:
        """Return whether a state of the composed world is one that the task wants, bool."""

    def aim_fields(self, task: Any) -> Mapping[str, tuple[Any, str]]:
        """Return where an aim stands in the model: name -> (elements, attribute)."""
        del task
        return {}

    def place_aim(self, aim: Any) -> dict[str, Any]:
        """Return the arrays of ``aim_fields`` for an aim ``(k,)``."""
        del aim
        return {}

    def dynamics(self) -> list[Parameter]:
        """Return the parameters of the model that may be identified, at their data sheet's values."""
        return standard.parameters(self.servos.sheet, self.servos.joints)

    def fields(self, task: GoalTask) -> Mapping[str, tuple[Any, str]]:
        """Return what of the model differs from copy to copy: name -> (elements, attribute)."""
        return {**standard.fields(task.robot), **self.aim_fields(task)}

    def place(self, values: Mapping[str, Any], aim: Any) -> dict[str, Any]:
        """Return the arrays of ``fields`` for parameters by name and an aim ``(k,)``."""
        s = self.servos
        own = standard.place(values, s.sheet, s.joints, self.task.physics_timestep)
        return {**own, **self.place_aim(aim)}

    def twin(self, emulator: Emulation, **factors: float) -> Embedded:
        """Return a robot inside the computer that is made of this one's model.

        Args:
            emulator: Latencies and losses; the servos' model is the data sheet's.
            **factors: By what it differs from the model: ``gain``, ``damping``, ``armature``, ``friction``.
        """
        s, task = self.servos, self.task
        arguments = {
            "mjcf": task.root_entity.mjcf_model.root_model.to_xml_string(),
            "joints": {name: j.full_identifier for name, j in zip(s.joints, task.joints, strict=True)},
            "servo_ids": s.ids,
            "p_gain": s.sheet.p_gain,
            "factors": factors,
        }
        emulator = replace(emulator, model_number=s.sheet.model_number)
        return Embedded("sim2real.hardware.twin:TwinPlant", emulator, arguments)

    def reward(self, state: Any, action: jax.Array) -> jax.Array:
        """Return the reward of a policy step: the task's, less a little for speed of the goals."""
        return state.reward - 0.01 * jnp.mean((action / self.servos.speed) ** 2)

    def observe(self, reading: JointReading, goal: Any, aim: Any) -> jax.Array:
        """Return what the policy sees of the present, in the order of ``features``."""
        return jnp.concatenate([reading.position, reading.velocity, goal, aim])

    # -- what the stages ask

    @property
    def UNITS(self) -> dict[str, str]:
        """Field of a message -> its unit."""
        of_aim = {f"aim[{i}]": unit for i, (_, unit) in enumerate(self.aim)}
        return {"position": "rad", "velocity": "rad/s", "goal": "rad", **of_aim}

    @property
    def JOINTS(self) -> dict[str, Any]:
        """For the log: which fields are which joint's."""
        rows = enumerate(self.servos.joints)
        return {"sensor": {j: {"position": f"position[{i}]", "velocity": f"velocity[{i}]"} for i, j in rows}}

    @property
    def OBSERVATION(self) -> list[tuple[str, tuple[str, ...], int]]:
        """Terms of the policy's observation."""
        n = len(self.servos.joints)
        default = (
            ("position", ("rad",) * n),
            ("velocity", ("rad/s",) * n),
            ("goal", ("rad",) * n),
            ("aim", tuple(unit for _, unit in self.aim)),
        )
        past = ("past position, velocity, goal", ("rad",) * n + ("rad/s",) * n + ("rad",) * n, self.history)
        present = [(name, units, 1) for name, units in self.features or default if units]
        return [*present, past] if self.history else present

    @property
    def ACTION(self) -> list[tuple[str, str]]:
        """Names and units of the policy's actions."""
        return [(f"speed of {joint}'s goal", "rad/s") for joint in self.servos.joints]

    @property
    def ACTION_BOUNDS(self) -> list[tuple[float, float]]:
        """Fastest the goals may go, either way [rad/s]."""
        return [(-self.servos.speed, self.servos.speed)] * len(self.servos.joints)

    @cached_property
    def task(self) -> GoalTask:
        """The composed task of this robot's world."""
        return self.make_task()

    @property
    def tick_s(self) -> float:
        """The world's period [s]."""
        return float(self.task.control_timestep)

    def make_world(self, resumed: bool = False) -> ServoWorld:
        """Return the world's node; ``resumed``: episodes begin in the middle of a recording."""
        return ServoWorld("world", self.task, self.fields(self.task), resumed)

    def node_params(
        self, values: Mapping[str, Any], position: Any, velocity: Any, aim: Any, policy: Any = None
    ) -> dict[str, Any]:
        """Return the parameters of all nodes.

        Args:
            values: Parameters of dynamics and delays by name.
            position: Of the joints at the start ``(joints,)`` [rad]; goals start there too.
            velocity: Of the joints ``(joints,)`` [rad/s].
            aim: What the episode is about ``(k,)``.
            policy: The policy.
        """
        start, speed = jnp.asarray(position, jnp.float32), jnp.asarray(velocity, jnp.float32)
        params = self._world_params.replace(values=self.place(values, aim), qpos=start, qvel=speed)
        return {
            "world": params,
            "sensor": DelayParams(delay=values.get("sensor_delay")),
            "actuator": DelayParams(delay=values.get("actuator_delay")),
            "agent": AgentParams(policy=policy, aim=aim, start=start),
        }

    def connect(self, port: str, limits: GateLimits, truth_path: Path, seed: int) -> ServoSession:
        """Open the robot on a port, or the embedded one, with torque off."""
        s = self.servos
        low, high = np.maximum(s.low, -limits.limit), np.minimum(s.high, limits.limit)
        gate = GateConfig(
            (tuple(low), tuple(high)),
            limits.slew_per_s,
            limits.command_timeout_s,
            limits.max_speed_rad_s,
            stale="hold",
            joints=s.joints,
            stuck_effort=limits.stuck_effort,
        )
        make, silence_s = load_device(s.device), limits.servo_watchdog_s

        def device(port: str) -> Device:
            return make(port, s.ids, s.sheet.drive, baud_rate=s.baud_rate, silence_s=silence_s)

        return ServoSession(port, device, gate, self.embedded, truth_path, seed)

    def prepare(self, session: ServoSession, settle_s: float) -> None:
        """Bring the robot to where it rests, slowly; torque is off before and afterwards.

        Raises:
            HardwareLost: It does not come to rest within ``settle_s`` [s] a try.
            SafetyStop: It rests somewhere else, or what the gate stopped.
        """
        position = session.rig.wait_until_still(settle_s).position_rad
        if np.max(np.abs(position - self.servos.at_rest)) > _AT_HOME_RAD:
            self._bring_home(session, position)  # a joint without weight stays where it was left
            position = session.rig.wait_until_still(settle_s).position_rad
        off = np.abs(position - self.servos.at_rest)
        worst = int(np.argmax(off))
        if off[worst] > self.servos.rest_tolerance:
            raise SafetyStop(
                f"joint {self.servos.joints[worst]!r} rests at {position[worst]:.2f} rad, "
                f"not within {self.servos.rest_tolerance:g} rad of {self.servos.at_rest[worst]:g} rad",
                hint="free it, or check the zero of its encoder",
            )

    def recording_nodes(self, session: ServoSession, signal: np.ndarray) -> dict[str, BaseNode]:
        """Return the graph on hardware that plays goals, one row a step ``(N, joints)`` [rad].

        A joint that stands elsewhere comes to its signal slowly, at 1 rad/s, instead of in a leap.
        """
        signal = np.asarray(signal, np.float64).reshape(-1, len(self.servos.joints))
        away = session.rig.measure().position_rad - signal[0]
        gone = np.arange(len(signal))[:, None] * _HOME_RAD_S / self.RATE_HZ
        signal = signal + np.sign(away) * np.maximum(np.abs(away) - gone, 0.0)
        agent = Excitation("agent", self.RATE_HZ, signal, Goals, delay=EXPECTED_DELAY_S["agent"])
        return self._on_hardware(session, agent)

    def deployment_nodes(
        self, session: ServoSession, policy: Any, trial: int = 0
    ) -> tuple[dict[str, BaseNode], dict[str, Any]]:
        """Return the graph on hardware that runs a policy from where the robot is, and the agent's parameters."""
        start = jnp.asarray(session.rig.measure().position_rad, jnp.float32)
        params = AgentParams(policy=policy, aim=self.draw_aim(jax.random.key(trial)), start=start)
        return self._on_hardware(session, self._agent(delay=EXPECTED_DELAY_S["agent"])), {"agent": params}

    def identifiable(self, max_delay_s: float) -> IdentifiableServos:
        """Return the model to identify, with delays of up to ``max_delay_s`` [s]."""
        return IdentifiableServos(self, max_delay_s)

    def training(
        self,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        computation: Mapping[str, DelayDistribution],
        delays: bool,
    ) -> tuple[dict[str, BaseNode], ServoTask]:
        """Return the loop in simulation and the task; see ``sim2real.stages.robot.Robot``."""
        world = self.make_world()
        values = in_a_loop(values, self.tick_s, self.delay_spread_s)
        bounds = delay_bounds(values, self.tick_s, self.delay_spread_s, world.lead_s) if delays else None

        def options(name: str) -> dict[str, Any]:
            return {"delay": EXPECTED_DELAY_S[name] if delays else 0.0, "delay_dist": computation.get(name)}

        agent = self._agent(**options("agent"))
        sensor = SimSensor("sensor", self.RATE_HZ, world, **options("sensor"))
        actuator = SimActuator("actuator", self.RATE_HZ, len(self.servos.joints), **options("actuator"))
        nodes = simulated_loop(sensor, agent, actuator, world, bounds)
        return nodes, ServoTask(self, agent, values, draws, self.delay_spread_s if delays else 0.0)

    def simulation_params(self, values: Mapping[str, float], policy: Any, trial: int = 0) -> dict[str, Any]:
        """Return node parameters of the loop in simulation, from rest, with a policy and a trial's aim."""
        rest = self.servos.at_rest
        values = in_a_loop(values, self.tick_s, self.delay_spread_s)
        return self.node_params(values, rest, np.zeros_like(rest), self.draw_aim(jax.random.key(trial)), policy)

    def identified_mjcf(self, values: Mapping[str, Any]) -> str:
        """Return the robot's model with what was found, as MJCF."""
        s, task = self.servos, self.task
        text = task.root_entity.mjcf_model.root_model.to_xml_string()
        return standard.identified_mjcf(text, task.robot, values, s.sheet, s.joints)

    def nominal(self) -> dict[str, float]:
        """Return the data sheet's values, without delays."""
        return {p.name: p.nominal for p in self.dynamics()}

    def _bring_home(self, session: ServoSession, position: np.ndarray) -> None:
        rig, way = session.rig, self.servos.at_rest - position
        steps = int(np.ceil(np.max(np.abs(way)) / _HOME_RAD_S * self.RATE_HZ))
        rig.start()
        try:
            for step in range(1, steps + round(_HOLD_S * self.RATE_HZ)):
                rig.measure()
                rig.command(position + min(1.0, step / steps) * way, 0.0, time.monotonic())
                time.sleep(1 / self.RATE_HZ)
        except BaseException:
            rig.stop_quietly()  # the reason must not be lost to what else fails
            raise
        rig.stop()

    @cached_property
    def _world_params(self) -> Any:
        return self.make_world().init_params()

    def _agent(self, **options: Any) -> GoalAgent:
        s = self.servos
        return GoalAgent("agent", self.RATE_HZ, s.low, s.high, self.observe, self.history, len(self.aim), **options)

    def _on_hardware(self, session: ServoSession, agent: BaseNode) -> dict[str, BaseNode]:
        def read(reading: Reading) -> JointReading:
            return JointReading(reading.position_rad, reading.velocity_rad_s)

        n, rate = len(self.servos.joints), self.RATE_HZ
        rest = JointReading(self.servos.at_rest, np.zeros(n))
        sensor = ServoSensor("sensor", rate, session.rig, read, rest, delay=EXPECTED_DELAY_S["sensor"])
        actuator = ServoActuator("actuator", rate, session.rig, "goal", Goals, delay=EXPECTED_DELAY_S["actuator"])
        return control_nodes(sensor, agent, actuator)
