"""The task of a walking robot: commanded velocities, what a reward sees, and the policy's node."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple, Unpack

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.arrays import namespace
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import NodeOptions
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.agent import AgentParams, PolicyAgent
from sim2real.robots.loop import AGENT, WORLD, Draw
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import GRAVITY, Judgement, RobotTask
from sim2real.robots.walking.drive import BodyReading, gravity_of, into_base
from sim2real.types import Array, Key, Scalar

if TYPE_CHECKING:
    from sim2real.robots.walking.robot import ComposedRobot


@dataclass(frozen=True)
class Commands:
    """Velocities that are commanded in an episode, one after the other; after the last, the first follows.

    Attributes:
        most: Largest magnitudes: forwards, to the left [m/s], yaw rate [rad/s].
        every_s: How long a command lasts [s].
        stand: Share of the commands that are 0, for which the robot stands still.
        count: Number of commands that are drawn.
        fixed: The command of all trials; None: each trial has its own.
    """

    most: tuple[float, float, float] = (1.0, 0.6, 0.8)
    every_s: float = 2.5
    stand: float = 0.1
    count: int = 4
    fixed: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if min(self.most) < 0 or self.every_s <= 0 or not 0 <= self.stand <= 1 or self.count < 1:
            raise UsageError(f"commands need sizes of at least 0, a time above 0 and a share in [0, 1], got {self}")
        if self.fixed is not None and not np.all(np.abs(self.fixed) <= self.most):
            most = ", ".join(f"{value:g}" for value in self.most)
            raise UsageError(f"the policy follows velocities of at most {most}, got {self.fixed}")

    @property
    def size(self) -> int:
        """Number of entries of an episode's aim."""
        return 3 * self.count

    def draw(self, key: Key) -> Array:
        """Return the commands of an episode, shape ``(3 * count,)``."""
        k_size, k_stand = jax.random.split(key)
        drawn = jax.random.uniform(k_size, (self.count, 3), minval=-1.0, maxval=1.0) * jnp.array(self.most)
        return (drawn * (jax.random.uniform(k_stand, (self.count, 1)) >= self.stand)).ravel()

    def of_trial(self, trial: int) -> np.ndarray:
        """Return the commands of a trial, none of them 0.

        A trial's number gives the same commands on hardware and in simulation.
        """
        if self.fixed is not None:
            return np.tile(np.array(self.fixed, np.float32), self.count)
        return np.asarray(replace(self, stand=0.0).draw(jax.random.key(trial)), np.float32)

    def at(self, drawn: Array, t_s: Scalar) -> Array:
        """Return the command ``(3,)`` at a time of an episode [s]."""
        xp = namespace(drawn, t_s)
        row = xp.asarray(t_s / self.every_s + 1e-4, dtype=np.int32) % self.count
        return xp.asarray(drawn).reshape(-1, 3)[row]


class Moment(NamedTuple):
    """The true state after a policy step of a walking robot. Vectors of the base are in its axes.

    Attributes:
        command: Shape ``(3,)``: forwards, to the left [m/s], yaw rate [rad/s].
        linear: Shape ``(3,)``: velocity of the base [m/s].
        angular: Shape ``(3,)``: angular velocity of the base [rad/s].
        gravity: Shape ``(3,)``: direction of gravity.
        mean: Shape ``(3,)``: forward, left and yaw velocity, smoothed over 0.4 s.
        height: Height of the base above its lowest foot [m].
        offset: Shape ``(joints,)``: position less stance [rad].
        torque: Shape ``(joints,)`` [N m].
        last: Shape ``(joints,)``: this step's action.
        before: Shape ``(joints,)``: the action of the step before.
        touches: Shape ``(feet,)``, bool.
        lands: Shape ``(feet,)``, bool: the foot landed in this step.
        swing_s: Shape ``(feet,)``: time in the air of the last swing [s].
        slip_m_s: Shape ``(feet,)``: speed of the foot along the ground while it touches [m/s].
        falls: Whether the episode ends with this step, bool.
    """

    command: jax.Array
    linear: jax.Array
    angular: jax.Array
    gravity: jax.Array
    mean: jax.Array
    height: jax.Array
    offset: jax.Array
    torque: jax.Array
    last: jax.Array
    before: jax.Array
    touches: jax.Array
    lands: jax.Array
    swing_s: jax.Array
    slip_m_s: jax.Array
    falls: jax.Array

    @property
    def moving(self) -> jax.Array:
        """1 if a velocity is commanded, 0 if the robot has to stand still."""
        return (jnp.sum(self.command**2) > 0.01).astype(jnp.float32)

    # -- terms of a reward

    def tracks(self, width: float = 0.25) -> jax.Array:
        """Return 1 at the commanded velocity, and 1/e at a squared error of ``width`` [m^2/s^2]."""
        return jnp.exp(-jnp.sum((self.command[:2] - self.linear[:2]) ** 2) / width)

    def turns(self, width: float = 0.25) -> jax.Array:
        """Return 1 at the commanded yaw rate, and 1/e at a squared error of ``width`` [rad^2/s^2]."""
        return jnp.exp(-((self.command[2] - self.angular[2]) ** 2) / width)

    def action_rate(self) -> jax.Array:
        """Return the squared change from the last action."""
        return jnp.sum((self.last - self.before) ** 2)

    def steps(self, least_s: float = 0.1, most_s: float = 0.5) -> jax.Array:
        """Return the time in the air of feet that landed, beyond ``least_s`` [s]; 0 if no motion is commanded."""
        credit = jnp.clip(self.swing_s, 0.0, most_s) - least_s
        return self.moving * jnp.sum(jnp.where(self.lands, credit, 0.0))

    def slip(self) -> jax.Array:
        """Return the squared speed of feet along the ground."""
        return jnp.sum(jnp.clip(self.slip_m_s, 0.0, 2.0) ** 2)

    def lifted_at_rest(self) -> jax.Array:
        """Return the number of feet in the air while the robot has to stand still."""
        return (1.0 - self.moving) * jnp.sum(~self.touches)


_GAIT_S, _CLOSE = 0.4, 0.2
"""Duration of a step of the gait, over which velocities are averaged [s]; largest error of a success [m/s, rad/s]."""
Term = tuple[float, Callable[[Moment], jax.Array | float]]
"""A term of the reward: its weight, and a function of a ``Moment``."""


class WalkingNode(PolicyAgent):
    """Sends joint targets around the stance.

    Its features are gyro, gravity, joint angles minus stance, and the last action. The history repeats the features.
    """

    def __init__(self, robot: ComposedRobot, rate: float, **options: Unpack[NodeOptions]) -> None:
        self._stance, self._scale = np.asarray(robot.stance, np.float32), np.float32(robot.scale)
        count, aims = len(robot.stance), (robot.commands.size, robot.commands.at)
        super().__init__(AGENT, rate, count, robot.history, (6 + 3 * count,), *aims, **options)

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> AgentParams:
        return super().init_params().replace(start=self._stance)

    def features(self, reading: BodyReading, step_state: StepState) -> Array:
        last = step_state.state.last
        parts = [reading.gyro, gravity_of(reading.quaternion), reading.position - self._stance, reading.velocity, last]
        return namespace(reading.position, last).concatenate(parts).astype(np.float32)

    def shown(self, features: Array, step_state: StepState) -> Array:
        return namespace(features).concatenate([features, self.aim(step_state)])

    def command(self, before: Array, action: Array) -> Array:
        return self._stance + self._scale * action


class WalkingTask(RobotTask):
    """Follow commanded velocities without a fall.

    The policy observes gyro, gravity, joints, last actions, and the commanded velocity.
    """

    units = MappingProxyType({"aim": "m/s, m/s, rad/s"})

    def __init__(self, robot: ComposedRobot) -> None:
        self._robot, self._commands, n = robot, robot.commands, len(robot.joints)
        self._stance, self._terms = np.asarray(robot.stance, np.float32), robot.terms()
        units = ("rad/s",) * 3 + ("1",) * 3 + ("rad",) * n + ("rad/s",) * n + ("1",) * n
        now = (
            ObservationTerm("gyro", units[:3]),
            ObservationTerm(GRAVITY, units[3:6]),
            ObservationTerm("joint position less stance", units[6 : 6 + n]),
            ObservationTerm("joint velocity", units[6 + n : 6 + 2 * n]),
            ObservationTerm("last action", units[6 + 2 * n :]),
            ObservationTerm("command: forwards, left, yaw rate", ("m/s", "m/s", "rad/s")),
        )
        past = ObservationTerm("earlier features, newest first", units, robot.history) if robot.history else None
        self.observation = (*now, past) if past else now
        self.action = tuple(ActionTerm(name, "1", -1.0, 1.0) for name in robot.joints)

    def make_agent(self, rate_hz: float, **options: Unpack[NodeOptions]) -> WalkingNode:
        return WalkingNode(self._robot, rate_hz, **options)

    def random(self, key: Key, draw: Draw) -> tuple[dict, EpisodeStart]:
        k_values, k_commands = jax.random.split(key)
        stance = jnp.asarray(self._stance)
        return draw(k_values), EpisodeStart(stance, jnp.zeros_like(stance), self._commands.draw(k_commands), stance)

    def at_rest(self, trial: int) -> EpisodeStart:
        stance = self._stance
        return EpisodeStart(stance, np.zeros_like(stance), self._commands.of_trial(trial), stance)

    def moved(self, start: EpisodeStart, position: Array, velocity: Array, share: Scalar = 1.0) -> EpisodeStart:
        return super().moved(start, position, velocity).replace(aim=share * start.aim)

    def moment(self, graph_state: GraphState) -> Moment:
        """Return the state from which the rewards are computed."""
        world, agent, period_s = graph_state.state[WORLD], graph_state.state[AGENT], 1.0 / self._robot.policy_hz
        data, v = world.data, world.variables
        t_s = (graph_state.step - 1) * period_s
        turn, feet = data.qpos[3:7], v["at_m"]
        moment = Moment(
            command=jnp.asarray(self._commands.at(graph_state.params[AGENT].aim, t_s)),
            linear=jnp.asarray(into_base(turn, data.qvel[:3])),
            angular=data.qvel[3:6],
            gravity=jnp.asarray(gravity_of(turn)),
            mean=v["mean"],
            height=data.qpos[2] - jnp.min(feet[:, 2]),
            offset=data.qpos[7:] - self._stance,
            torque=data.actuator_force,
            last=agent.last,
            before=agent.before,
            touches=v["air_s"] == 0.0,
            lands=(v["ground_s"] > 0.0) & (v["ground_s"] < period_s + 1e-4) & (v["swing_s"] > 0.0),
            swing_s=v["swing_s"],
            slip_m_s=v["slip_m_s"],
            falls=jnp.bool_(False),
        )
        return moment._replace(falls=self._robot.falls(moment))

    def judge(self, graph_state: GraphState, action: jax.Array) -> Judgement:
        now = self.moment(graph_state)
        terms = {name: jnp.float32(weight * measure(now)) for name, (weight, measure) in self._terms.items()}
        return Judgement(terms, jnp.all(jnp.abs(now.mean - now.command) < _CLOSE), now.falls)

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return how well a deployment went: share of the time upright, largest tilt, and errors of the velocity.

        The errors are means over time, of velocities averaged over a step of the gait. Encoders and IMU do not measure
        the linear velocity: its error needs the true states of an emulated robot.
        """
        turn = np.stack([states[f"quaternion[{i}]"] for i in range(4)], axis=-1)
        turn = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
        upright = 1.0 - 2.0 * (turn[:, 1] ** 2 + turn[:, 2] ** 2)
        # Commands change at policy steps, states have other times.
        step = ((t_s - t_s[0]) * self._robot.policy_hz + 1e-6).astype(int)
        off = []
        for name, aim in (("linear[0]", "aim[0]"), ("linear[1]", "aim[1]"), ("gyro[2]", "aim[2]")):
            wanted = states[aim][np.minimum(step, len(states[aim]) - 1)]
            window = max(1, round(_GAIT_S / max(float(np.median(np.diff(t_s))), 1e-3)))
            gap = states.get(name, np.full(len(t_s), np.nan)) - wanted
            off.append(np.convolve(gap, np.ones(window) / window, "valid"))
        return {
            "success": float((upright > 0.5).mean()),
            "tilt_rad": float(np.arccos(np.clip(upright, -1.0, 1.0)).max()),
            "velocity_error_m_s": float(np.hypot(off[0], off[1]).mean()),
            "yaw_error_rad_s": float(np.abs(off[2]).mean()),
        }
