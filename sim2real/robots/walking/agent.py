"""The policy of a walking robot: IMU, encoders, last actions and the command; its actions are joint targets."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType
from typing import Unpack

import numpy as np

from sim2real.arrays import namespace
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import NodeOptions
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.agent import AgentParams, PolicyAgent
from sim2real.robots.loop import AGENT
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotAgent
from sim2real.robots.walking.commands import Commands
from sim2real.robots.walking.messages import BodyReading, WalkDecision, gravity_of
from sim2real.types import Array, Key, PyTree


class WalkingNode(PolicyAgent):
    """Sends joint targets around the stance.

    Its features are gyro, gravity, joints beside the stance, and the last action. The history has features alone.

    Args:
        stance: Shape ``(joints,)``: targets of the action 0 [rad].
        scale: Change of a target by the action 1 [rad].
        history: Number of earlier observations that the policy gets.
    """

    def __init__(
        self,
        rate: float,
        stance: np.ndarray,
        scale: float,
        history: int,
        commands: Commands,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(AGENT, rate, len(stance), history, (6 + 3 * len(stance),), **options)
        self._stance, self._scale, self._commands = np.asarray(stance, np.float32), np.float32(scale), commands

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentParams:
        """Return parameters without a policy: the robot stands."""
        return AgentParams(aim=np.zeros(self._commands.size, np.float32), start=self._stance)

    def commanded(self, step_state: StepState) -> Array:
        """Return the commanded velocity ``(3,)`` of a step: forwards, to the left [m/s], yaw rate [rad/s]."""
        return self._commands.at(step_state.params.aim, step_state.seq / self.rate)

    def features(self, reading: BodyReading, step_state: StepState) -> Array:
        last = step_state.state.last
        parts = [reading.gyro, gravity_of(reading.quaternion), reading.position - self._stance, reading.velocity, last]
        return namespace(reading.position, last).concatenate(parts).astype(np.float32)

    def shown(self, features: Array, step_state: StepState) -> Array:
        return namespace(features).concatenate([features, self.commanded(step_state)])

    def command(self, before: Array, action: Array) -> Array:
        return self._stance + self._scale * action

    def message(self, command: Array, step_state: StepState) -> WalkDecision:
        commanded = self.commanded(step_state)
        return WalkDecision(command, namespace(commanded).asarray(commanded, np.float32))

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> WalkDecision:
        """Return the targets at the start, and no velocity."""
        start = self._params(graph_state).start
        return WalkDecision(namespace(start).asarray(start, np.float32), np.zeros(3, np.float32))


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
        return WalkingNode(rate_hz, self._stance, self._scale, self._history, self._commands, **options)

    def params(self, start: EpisodeStart, policy: PyTree) -> AgentParams:
        """Return the node's parameters for an episode: its commands are the aim."""
        return AgentParams(policy, start.aim, np.asarray(self._stance, np.float32))

    def tilt_rad(self, observation: np.ndarray) -> float:
        """Return the angle between the base's vertical axis and gravity [rad]."""
        return float(np.arccos(np.clip(-observation[5], -1.0, 1.0)))
