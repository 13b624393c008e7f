"""A robot of position-controlled servos, for the stages: its model, task and numbers are a subclass's."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.arrays import namespace
from sim2real.errors import UsageError
from sim2real.graph.base import Array
from sim2real.graph.node import BaseNode
from sim2real.hardware.device import Device, Reading
from sim2real.hardware.emulation.emulated_bus import BusEmulation
from sim2real.hardware.joint import Joint
from sim2real.hardware.registry import load_device
from sim2real.hardware.safety.config import GateLimits
from sim2real.hardware.safety.gate import GateConfig
from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.control_loop.hardware import Embedded, ServoSession
from sim2real.robots.control_loop.identification_model import IdentifiableLoop
from sim2real.robots.control_loop.loop import DelayParams
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.control_loop.messages import Goals, JointReading
from sim2real.robots.control_loop.training_task import Draw
from sim2real.robots.servo import parameters
from sim2real.robots.servo.agent import AgentParams, GoalAgent
from sim2real.robots.servo.homing import HOME_RAD_S, bring_home
from sim2real.robots.servo.observation import Feature, servo_terms
from sim2real.robots.servo.parts import REFERENCE, GoalTask
from sim2real.robots.servo.payload import PAYLOAD, Hand
from sim2real.robots.servo.servos import Servos
from sim2real.robots.servo.simulated_world import ServoWorld
from sim2real.train.environment.tasks import Rewards

_AFTER_S = 1.0


class ServoRobot(LoopRobot):
    """A robot of position-controlled servos.

    Attributes:
        servos: The servos.
        aim: What an episode is about: names and units of its entries.
        features: What the policy sees of the present: names and units; see ``observe``. A third entry is the largest
            magnitude that its values can have, where that is known.
        history: Past steps that the policy sees.
        hand: Where it holds things, if it does: what is in there is an optional term, ``payload``.
        position_sigma_rad: Deviation of a measured position.
        velocity_sigma_rad_s: Deviation of a measured velocity.
    """

    rate_hz = 50.0
    command = "goal"
    message = Goals
    expected_delay_s = (0.004, 0.003, 0.002)
    encoder_zero_rad = math.pi

    servos: Servos
    aim: tuple[tuple[str, str], ...] = ()
    features: tuple[Feature, ...] | None = None
    history: int = 3
    hand: Hand | None = None
    position_sigma_rad: float = 0.002
    velocity_sigma_rad_s: float = 0.05

    # -- what a robot says about itself

    @abstractmethod
    def make_task(self) -> GoalTask:
        """Return a new task; its control step is the world's tick."""

    @abstractmethod
    def draw_aim(self, key: jax.Array) -> jax.Array:
        """Return the aim of an episode, ``(k,)``."""

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
        own = parameters.parameters(self.servos.sheet, self.servos.joints)
        return [*own, self.hand.parameter()] if self.hand else own

    def watched(self, max_delay_s: float) -> IdentifiableLoop:
        """Return the model with what may change between deployments, what the hand holds among it."""
        model = self.identifiable(max_delay_s)
        if self.hand:
            model.parameters = model.parameters.with_terms([*model.parameters.terms, PAYLOAD])
        return model

    def fields(self, task: GoalTask) -> Mapping[str, tuple[Any, str]]:
        """Return what of the model differs from copy to copy: name -> (elements, attribute)."""
        held = self.hand.fields(task) if self.hand else {}
        return {**parameters.fields(task.robot), **held, **self.aim_fields(task)}

    def place(self, values: Mapping[str, Any], aim: Any) -> dict[str, Any]:
        """Return the arrays of ``fields`` for parameters by name and an aim ``(k,)``."""
        s = self.servos
        own = parameters.place(values, s.sheet, s.joints, self.task.physics_timestep)
        held = self.hand.place(values, self._world_params.values) if self.hand else {}
        return {**own, **held, **self.place_aim(aim)}

    def twin(self, emulator: BusEmulation, **factors: float) -> Embedded:
        """Return a robot inside the computer that is made of this one's model.

        Args:
            emulator: Latencies and losses; the servos' model is the data sheet's.
            **factors: By what it differs from the model: ``gain``, ``damping``, ``armature``, ``friction``.
        """
        s, task = self.servos, self.task
        arguments = {
            "mjcf": task.root_entity.mjcf_model.root_model.to_xml_string(),
            "joints": {name: j.full_identifier for name, j in zip(s.names, task.joints, strict=True)},
            "gears": [joint.gear for joint in s.mounting],
            "servo_ids": s.ids,
            "p_gain": s.sheet.p_gain,
            "factors": factors,
        }
        emulator = replace(emulator, model_number=s.sheet.model_number)
        return Embedded("sim2real.hardware.emulation.twin:TwinPlant", emulator, arguments)

    def reward(self, state: Any, action: jax.Array) -> Rewards:
        """Return the reward of a policy step: the task's, less a little for speed of the goals."""
        return {"task": state.reward, "speed": -0.01 * jnp.mean((action / self.servos.speed) ** 2)}

    def true_state(self, state: Any) -> Any:
        """Return positions and velocities of all that moves in the model, and the servos' setpoints."""
        return state.data.qpos, state.data.qvel, state.variables[REFERENCE]

    def observe(self, reading: JointReading, goal: Any, aim: Any) -> Array:
        """Return what the policy sees of the present, in the order of ``features``.

        In training it gets JAX arrays, on the robot numpy's, for which ``namespace(goal)`` is ``numpy``: where it calls
        ``jax.numpy`` all the same, it is only slower there.

        Args:
            goal: The goals, shape ``(joints,)`` [rad].
            aim: What the episode is about, shape ``(k,)``.
        """
        return namespace(goal).concatenate([reading.position, reading.velocity, goal, aim])

    # -- what the stages ask

    @property
    def mounting(self) -> tuple[Joint, ...]:
        """How the joints are mounted."""
        return self.servos.mounting

    @property
    def units(self) -> dict[str, str]:
        """Field of a message -> its unit."""
        of_aim = {f"aim[{i}]": unit for i, (_, unit) in enumerate(self.aim)}
        return {"position": "rad", "velocity": "rad/s", "goal": "rad", **of_aim}

    @property
    def joints(self) -> dict[str, dict[str, str]]:
        """For the log: which fields are which joint's."""
        rows = enumerate(self.servos.names)
        return {j: {"position": f"position[{i}]", "velocity": f"velocity[{i}]"} for i, j in rows}

    @property
    def observation(self) -> tuple[ObservationTerm, ...]:
        """Terms of the policy's observation."""
        return servo_terms(self.servos, self.aim, self.features, self.history)

    @property
    def action(self) -> tuple[ActionTerm, ...]:
        """The policy's actions, as fast as goals may go, either way [rad/s]."""
        speed = self.servos.speed
        return tuple(ActionTerm(f"speed of {j}'s goal", "rad/s", -speed, speed) for j in self.servos.names)

    @property
    def limits(self) -> dict[str, float]:
        """The ends of each joint's goals [rad]."""
        s = self.servos
        ends = {"lowest": s.low, "highest": s.high}
        return {f"{end} goal of {name}": v for end, vs in ends.items() for name, v in zip(s.names, vs, strict=True)}

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Position and velocity of each joint."""
        sigmas = self.position_sigma_rad, self.velocity_sigma_rad_s
        rows = enumerate(self.servos.names)
        return tuple(Channel("position", "velocity", *sigmas, index=i, label=j, goal="goal") for i, j in rows)

    @cached_property
    def task(self) -> GoalTask:
        """The composed task of this robot's world.

        Raises:
            UsageError: Its servos have other gears than the joints.
        """
        task, joints = self.make_task(), self.servos.mounting
        if (built := [s.gear for s in task.robot.servos]) != (said := [j.gear for j in joints]):
            raise UsageError(
                f"the model's servos have the gears {built}, the joints {said}",
                hint="make each part of its joint: `Servo(joint, axis, sheet)`, not of the joint's name",
            )
        return task

    @property
    def tick_s(self) -> float:
        """The world's period [s]."""
        return float(self.task.control_timestep)

    @property
    def lead_s(self) -> float:
        """Half a step of the physics, which the world adds to the actuator's delay [s]."""
        return 0.5 * float(self.task.physics_timestep)

    @property
    def profile_rad_s(self) -> float:
        """How fast setpoints move to goals."""
        return self.servos.sheet.profile_rad_s

    @property
    def export_lead_s(self) -> float:
        """What C MuJoCo adds to the actuator's delay [s].

        Half a step for the leapfrog, as in the graph, and half a step as MuJoCo's setpoints are those of a step's end.
        Less a quarter of a tick: the graph has goals act as their mean over a tick, so a profile starts early, with the
        tick. By how much depends on when in the tick a goal comes; docs/guides/export.md has what is left of it.
        """
        return 2 * self.lead_s - 0.25 * self.tick_s

    def make_world(self, resumed: bool = False) -> ServoWorld:
        """Return the world's node; ``resumed``: episodes begin in the middle of a recording."""
        fields, worn = self.fields(self.task), self.servos.sheet.worn
        return ServoWorld(self.roles.world, self.task, fields, resumed, self.roles.actuator, worn)

    def make_agent(self, **options: Any) -> GoalAgent:
        """Return the policy's node, with options of ``BaseNode``."""
        s, roles, aims = self.servos, self.roles, len(self.aim)
        return GoalAgent(
            roles.supervisor, self.rate_hz, s.low, s.high, self.observe, self.history, aims, roles.sensor, **options
        )

    def random_params(self, key: jax.Array, draw: Draw) -> dict[str, Any]:
        """Draw an episode: half of the starts are at rest, half at any position.

        Args:
            draw: Draws dynamics and delays: key -> values by name.
        """
        k_values, k_aim, k_where, k_start = jax.random.split(key, 4)
        drawn, s = draw(k_values), self.servos
        low, high, rest = (jnp.asarray(x, jnp.float32) for x in (s.low, s.high, s.at_rest))
        anywhere = jax.random.uniform(k_start, low.shape, minval=low, maxval=high)
        start = jnp.where(jax.random.bernoulli(k_where), rest, anywhere)
        return self.node_params(drawn, start, jnp.zeros_like(start), self.draw_aim(k_aim))

    def displaced(self, params: Mapping[str, Any], position: jax.Array, velocity: jax.Array) -> dict[str, Any]:
        """Return an episode's parameters with another start, within the joints' limits; goals start there too.

        Args:
            params: What ``random_params`` returned.
            position: What is added to the joints' positions ``(joints,)`` [rad].
            velocity: What is added to their velocities ``(joints,)`` [rad/s].
        """
        world, agent = params[self.roles.world], params[self.roles.supervisor]
        start = jnp.clip(agent.start + position, *map(jnp.asarray, (self.servos.low, self.servos.high)))
        return {
            **params,
            self.roles.world: world.replace(qpos=start, qvel=world.qvel + velocity),
            self.roles.supervisor: agent.replace(start=start),
        }

    def node_params(
        self, values: Mapping[str, Any], position: Any, velocity: Any, aim: Any, policy: Any = None
    ) -> dict[str, Any]:
        """Return the parameters of all nodes.

        Args:
            position: Of the joints at the start ``(joints,)`` [rad]; goals start there too.
            velocity: Of the joints ``(joints,)`` [rad/s].
            aim: What the episode is about ``(k,)``.
        """
        start, speed = (jnp.asarray(x, jnp.float32) for x in (position, velocity))
        return {
            self.roles.world: self._world_params.replace(values=self.place(values, aim), qpos=start, qvel=speed),
            self.roles.sensor: DelayParams(delay=values.get("sensor_delay")),
            self.roles.actuator: DelayParams(delay=values.get("actuator_delay")),
            self.roles.supervisor: AgentParams(policy=policy, aim=aim, start=start),
        }

    def resumed_params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return parameters for an episode in the middle of a recording, from positions, then velocities."""
        position, velocity = jnp.split(jnp.asarray(start), 2)
        params = self.node_params(values, position, velocity, jnp.zeros(len(self.aim)))
        del params[self.roles.supervisor]
        return params

    def rest_params(self, values: Mapping[str, Any], policy: Any, trial: int) -> dict[str, Any]:
        """Return parameters for an episode from rest.

        Args:
            trial: Number of the trial, whose aim it has.
        """
        rest = self.servos.at_rest
        return self.node_params(values, rest, np.zeros_like(rest), self.draw_aim(jax.random.key(trial)), policy)

    def agent_params(self, session: ServoSession, policy: Any, trial: int) -> AgentParams:
        """Return the agent's parameters on hardware: goals start where the joints are.

        Args:
            trial: Number of the trial, whose aim it has.
        """
        start = jnp.asarray(session.rig.measure().position_rad, jnp.float32)
        return AgentParams(policy=policy, aim=self.draw_aim(jax.random.key(trial)), start=start)

    def make_device(self, port: str, silence_s: float) -> Device:
        """Return the servos on a port, not opened yet."""
        s = self.servos
        return load_device(s.device)(port, s.ids, s.sheet.drive, baud_rate=s.baud_rate, silence_s=silence_s)

    def gate(self, limits: GateLimits) -> GateConfig:
        """Return a gate that holds the last goals when commands are stale."""
        s = self.servos
        low, high = np.maximum(s.low, -limits.limit), np.minimum(s.high, limits.limit)
        return limits.gate((tuple(low), tuple(high)), stale="hold", node=self.roles.actuator, joints=s.names)

    def read(self, reading: Reading) -> JointReading:
        """Return the sensor's message of a reading."""
        return JointReading(reading.position_rad, reading.velocity_rad_s)

    @property
    def at_rest(self) -> JointReading:
        """The sensor's message of a robot at rest."""
        return JointReading(self.servos.at_rest, np.zeros(len(self.servos.joints)))

    def prepare(self, session: ServoSession, settle_s: float) -> None:
        """Bring the robot to where it rests, slowly; torque is off before and afterwards.

        Raises:
            HardwareLost: It does not come to rest within ``settle_s`` [s] a try.
            SafetyStop: It rests somewhere else, or what the gate stopped.
        """
        bring_home(session, self.servos, self.rate_hz, settle_s)

    def recording_nodes(self, session: ServoSession, signal: np.ndarray) -> dict[str, BaseNode]:
        """Return the graph on hardware that plays goals, one row a step ``(N, joints)`` [rad].

        A joint that stands elsewhere comes to its signal slowly, at 1 rad/s, instead of in a leap.
        """
        signal = np.asarray(signal, np.float64).reshape(-1, len(self.servos.joints))
        # Behind its end an excitation is 0, where these joints may not be: they wait where it ended.
        signal = self.around(np.vstack([signal, np.repeat(signal[-1:], round(_AFTER_S * self.rate_hz), axis=0)]))
        away = session.rig.measure().position_rad - signal[0]
        gone = np.arange(len(signal))[:, None] * HOME_RAD_S / self.rate_hz
        signal = signal + np.sign(away) * np.maximum(np.abs(away) - gone, 0.0)
        return super().recording_nodes(session, signal)

    def around(self, signal: np.ndarray) -> np.ndarray:
        """Return goals ``(N, joints)`` [rad] of an excitation: around the middle."""
        return signal + np.asarray(self.servos.middle or 0.0)

    def identified_mjcf(self, values: Mapping[str, Any]) -> str:
        """Return the robot's model with what was found, as MJCF."""
        s, task = self.servos, self.task
        text = task.root_entity.mjcf_model.root_model.to_xml_string()
        mjcf = parameters.identified_mjcf(text, task.robot, values, s.sheet, s.joints)
        return self.hand.loaded(mjcf, task, values) if self.hand else mjcf

    @cached_property
    def _world_params(self) -> Any:
        with jax.ensure_compile_time_eval():  # what is kept must not be of the function that is traced just now
            return self.make_world().init_params()
