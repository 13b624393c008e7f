"""The policy's node of a walking robot: IMU, encoders, last actions and the command; its actions are joint targets."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Unpack

import jax.numpy as jnp
import numpy as np

from sim2real import pytree
from sim2real.arrays import namespace
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.loop import AGENT, SENSOR
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotAgent
from sim2real.robots.servo.agent import AgentParams, decide, first_carry
from sim2real.robots.walking.commands import Commands
from sim2real.robots.walking.messages import BodyReading, WalkDecision, gravity_of
from sim2real.types import Array, Key, PyTree


@pytree.dataclass
class WalkingState(Base):
    """The agent's state.

    Attributes:
        last: Shape ``(joints,)``: the last action.
        before: Shape ``(joints,)``: the action before that one.
        past: Shape ``(history, features)``: the last observations without the command, newest first.
        carry: State of a policy with memory.
    """

    last: Array
    before: Array
    past: Array
    carry: PyTree = ()


def features(reading: BodyReading, stance: np.ndarray, last: Array) -> Array:
    """Return what the policy gets of a reading: gyro, gravity, joints beside the stance, then its last action."""
    xp = namespace(reading.position, last)
    parts = [reading.gyro, gravity_of(reading.quaternion), reading.position - stance, reading.velocity, last]
    return xp.concatenate(parts).astype(np.float32)


class WalkingNode(BaseNode):
    """Sends joint targets around the stance; ``step`` draws them from a policy in JAX.

    Args:
        stance: Shape ``(joints,)``: targets of the action 0 [rad].
        scale: Change of a target by the action 1 [rad].
        history: Number of earlier observations that the policy gets.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        stance: np.ndarray,
        scale: float,
        history: int,
        commands: Commands,
        sensor: str = SENSOR,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._stance, self._scale, self._history = np.asarray(stance, np.float32), scale, history
        self._commands, self._sensor = commands, sensor

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentParams:
        """Return parameters without a policy: the robot stands."""
        del rng, graph_state
        return AgentParams(aim=jnp.zeros(self._commands.size), start=jnp.asarray(self._stance))

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> WalkingState:
        """Return a state without any past."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        zeros = jnp.zeros(len(self._stance))
        past = jnp.zeros((self._history, 6 + 3 * len(self._stance)))
        return WalkingState(zeros, zeros, past, first_carry(params.policy))

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> WalkDecision:
        """Return the targets at the start, and no velocity."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        return WalkDecision(jnp.asarray(params.start, jnp.float32), jnp.zeros(3))

    def command(self, step_state: StepState) -> Array:
        """Return the commanded velocity ``(3,)`` of a step: forwards, to the left [m/s], yaw rate [rad/s]."""
        return self._commands.at(step_state.params.aim, step_state.seq / self.rate)

    def observe(self, step_state: StepState) -> Array:
        """Return the policy's observation: the newest features, the command, then earlier features."""
        now, state = self._now(step_state), step_state.state
        xp = namespace(now, state.past)
        return xp.concatenate([now, self.command(step_state), state.past.ravel()]).astype(np.float32)

    def act(self, step_state: StepState, action: Array) -> tuple[StepState, WalkDecision]:
        """Return the new step state and the message for an action ``(joints,)``."""
        now, state = self._now(step_state), step_state.state
        xp = namespace(action, now, state.past)
        past = xp.concatenate([now[None], state.past])[: self._history]
        action = xp.asarray(action, np.float32)
        new = state.replace(last=action, before=state.last, past=past)
        targets = self._stance + np.float32(self._scale) * action
        return step_state.replace(state=new), WalkDecision(targets, xp.asarray(self.command(step_state), np.float32))

    def step(self, step_state: StepState) -> tuple[StepState, WalkDecision]:
        """Make a step with the policy's action."""
        policy, state = step_state.params.policy, step_state.state
        if policy is None:
            return self.act(step_state, jnp.zeros_like(self._stance))
        carry, action = decide(policy, state.carry, self.observe(step_state))
        return self.act(step_state.replace(state=state.replace(carry=carry)), action)

    def _now(self, step_state: StepState) -> Array:
        reading: BodyReading = step_state.inputs[self._sensor][-1].data
        return features(reading, self._stance, step_state.state.last)


class WalkingAgent(RobotAgent):
    """Observation and action of a walking robot: gyro, gravity, joints, last actions, and the commanded velocity."""

    units = MappingProxyType({"aim": "m/s, m/s, rad/s"})

    def __init__(
        self, joints: Sequence[str], stance: np.ndarray, scale: float, history: int, commands: Commands
    ) -> None:
        n = len(joints)
        self._stance, self._scale, self._history, self._commands = stance, scale, history, commands
        units = ("rad/s",) * 3 + ("1",) * 3 + ("rad",) * n + ("rad/s",) * n + ("1",) * n
        now = (
            ObservationTerm("gyro", units[:3]),
            ObservationTerm("gravity in the base's axes", units[3:6]),
            ObservationTerm("joint position less stance", units[6 : 6 + n]),
            ObservationTerm("joint velocity", units[6 + n : 6 + 2 * n]),
            ObservationTerm("last action", units[6 + 2 * n :]),
            ObservationTerm("command: forwards, left, yaw rate", ("m/s", "m/s", "rad/s")),
        )
        past = (ObservationTerm("earlier features, newest first", units, history),) if history else ()
        self.observation = (*now, *past)
        self.action = tuple(ActionTerm(name, "1", -1.0, 1.0) for name in joints)

    def make(self, rate_hz: float, **options: Unpack[NodeOptions]) -> WalkingNode:
        """Return the policy's node."""
        return WalkingNode(AGENT, rate_hz, self._stance, self._scale, self._history, self._commands, **options)

    def params(self, start: EpisodeStart, policy: PyTree) -> AgentParams:
        """Return the node's parameters for an episode: its commands are the aim."""
        return AgentParams(policy, start.aim, np.asarray(self._stance, np.float32))

    def tilt_rad(self, observation: np.ndarray) -> float:
        """Return the angle between the base's vertical axis and gravity [rad]."""
        return float(np.arccos(np.clip(-observation[5], -1.0, 1.0)))
