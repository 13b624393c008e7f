"""The task of a servo arm: aims, rewards, observation and actions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Unpack

import numpy as np

from sim2real.arrays import namespace
from sim2real.graph.base import GraphState
from sim2real.graph.node import NodeOptions
from sim2real.later import jax, jnp
from sim2real.policy.contract import ActionTerm, ObservationTerm
from sim2real.robots.agent import GoalAgent
from sim2real.robots.loop import AGENT, WORLD, Draw
from sim2real.robots.messages import EpisodeStart, JointReading
from sim2real.robots.robot import Judgement, RobotTask
from sim2real.robots.servo.servos import Servos
from sim2real.types import Array, Key, PyTree, Scalar


@dataclass(frozen=True)
class Aim:
    """The aim of an episode, such as a target's position, or a target that moves.

    Attributes:
        entries: Name and unit of each of the k entries.
        draw: Returns the random numbers of an episode ``(m,)``, for a key of JAX (training) or the number of a trial;
            see ``uniform``. If the aim does not move, the numbers are the aim.
        at: Returns the aim ``(k,)`` for an episode's numbers and the time from its start [s]; None: the aim does not
            move.
    """

    entries: tuple[tuple[str, str], ...]
    draw: Callable[[Key | int], Array]
    at: Callable[[Array, Scalar], Array] | None = None


def uniform(key: Key | int, low: PyTree, high: PyTree) -> Array:
    """Return random numbers between bounds, each ``(n,)`` float32; one key always gives the same numbers.

    Args:
        key: A key of JAX, also in a traced function; or a seed of numpy, which needs no JAX.
    """
    if isinstance(key, int | np.integer):
        return np.random.default_rng(key).uniform(low, high).astype(np.float32)
    return jax.random.uniform(key, np.shape(low), minval=np.asarray(low), maxval=np.asarray(high))


class ServoMoment(NamedTuple):
    """The state after a policy step, from which rewards are computed.

    Attributes:
        position: Positions of the joints ``(joints,)`` [rad].
        velocity: Velocities of the joints ``(joints,)`` [rad/s].
        aim: The aim at this time ``(k,)``.
    """

    position: Array
    velocity: Array
    aim: Array


Feature = tuple[str, tuple[str, ...]] | tuple[str, tuple[str, ...], float]
"""Name and units of a term of the observation, and its largest magnitude [the units] if it has one."""
Observe = Callable[[JointReading, Array, Array], Array]
"""Returns the present part of the observation: (reading, goals ``(joints,)`` [rad], aim ``(k,)``) -> ``(features,)``.

In training it gets arrays of JAX, on the robot of NumPy: ``namespace(goals)`` of ``sim2real.arrays`` is the matching
module. ``jax.numpy`` works too, but is slower on the robot."""

_MARGIN_RAD, _SPEED_FACTOR, _FASTEST_RAD_S = math.pi, 5.0, 1e3
"""Bounds of measurements: how far beyond the goals' bounds [rad]; factor on the servo's speed without load; and this
speed if the data sheet has no damping [rad/s].
"""


class AimTask(RobotTask):
    """A task with random aims and random starts, half of them at rest.

    The policy observes positions, velocities, goals, the aim and a short history; its actions are the goals' speeds.

    Args:
        reward: Returns the reward of a moment; a penalty on the goals' speed is added.
        success: Returns whether the task is fulfilled, bool.
        score: Returns figures of a deployment; see ``RobotTask.score``.
        features: Names, units and largest magnitudes of the present part of the observation; None: positions,
            velocities, goals and aim.
        observe: Computes the present part; see ``Observe``.
        history: Past steps in the observation.
    """

    def __init__(
        self,
        servos: Servos,
        aim: Aim,
        reward: Callable[[ServoMoment], jax.Array],
        success: Callable[[ServoMoment], jax.Array],
        score: Callable[[np.ndarray, Mapping[str, np.ndarray]], dict[str, float]],
        features: tuple[Feature, ...] | None = None,
        observe: Observe | None = None,
        history: int = 3,
    ) -> None:
        self._servos, self.aim, self._history, self._observe = servos, aim, history, observe or observe_all
        self._reward, self._success, self._score = reward, success, score
        self.observation = servo_terms(servos, aim.entries, features, history)
        speed, names = servos.speed, servos.names
        self.action = tuple(ActionTerm(f"speed of {name}'s goal", "rad/s", -speed, speed) for name in names)
        ends = {"lowest": servos.low, "highest": servos.high}
        self.limits = {f"{end} goal of {n}": v for end, vs in ends.items() for n, v in zip(names, vs, strict=True)}
        self.units = {f"aim[{i}]": unit for i, (_, unit) in enumerate(aim.entries)}

    def make_agent(self, rate_hz: float, **options: Unpack[NodeOptions]) -> GoalAgent:
        s, aim = self._servos, self.aim
        ends = AGENT, rate_hz, s.low, s.high
        return GoalAgent(*ends, self._observe, self._history, len(aim.draw(0)), aim.at, **options)

    def random(self, key: Key, draw: Draw) -> tuple[dict[str, PyTree], EpisodeStart]:
        k_values, k_aim, k_where, k_start = jax.random.split(key, 4)
        values, s = draw(k_values), self._servos
        low, high, rest = (jnp.asarray(x, jnp.float32) for x in (s.low, s.high, s.at_rest))
        anywhere = jax.random.uniform(k_start, low.shape, minval=low, maxval=high)
        position = jnp.where(jax.random.bernoulli(k_where), rest, anywhere)
        return values, EpisodeStart(position, jnp.zeros_like(position), self.aim.draw(k_aim))

    def at_rest(self, trial: int) -> EpisodeStart:
        rest = self._servos.at_rest
        return EpisodeStart(rest, np.zeros_like(rest), self.aim.draw(trial))

    def moved(self, start: EpisodeStart, position: Array, velocity: Array, share: Scalar = 1.0) -> EpisodeStart:
        del share  # a target's distance does not make it easier
        low, high = (jnp.asarray(bound) for bound in (self._servos.low, self._servos.high))
        position = jnp.clip(start.position + position, low, high)
        return start.replace(position=position, velocity=start.velocity + velocity)

    def judge(self, graph_state: GraphState, action: jax.Array) -> Judgement:
        state, aim = graph_state.state[WORLD], jnp.asarray(graph_state.params[AGENT].aim)
        if self.aim.at is not None:
            aim = self.aim.at(aim, state.time_s)
        now = ServoMoment(state.position, state.velocity, aim)
        speed = -0.01 * jnp.mean((action / self._servos.speed) ** 2)
        return Judgement({"task": self._reward(now), "speed": speed}, self._success(now))

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        return self._score(t_s, states)


def observe_all(reading: JointReading, goal: Array, aim: Array) -> Array:
    """Return positions, velocities, goals and aim."""
    return namespace(goal).concatenate([reading.position, reading.velocity, goal, aim])


def servo_terms(
    servos: Servos, aim: tuple[tuple[str, str], ...], features: tuple[Feature, ...] | None, history: int
) -> tuple[ObservationTerm, ...]:
    """Return the terms of the observation that ``GoalAgent`` makes.

    Args:
        aim: Names and units of the aim's entries.
        features: Terms of the present; None: positions, velocities, goals and aim.
    """
    # Bounds of the measurements: the goals' range with a margin, and the servos' largest speed.
    n, sheet = len(servos.joints), servos.sheet
    free = _SPEED_FACTOR * sheet.stall / sheet.damping if sheet.damping else _FASTEST_RAD_S
    fast = tuple(free / gear for gear in servos.gears)
    position, velocity, goal = (
        (tuple(v - _MARGIN_RAD for v in servos.low), tuple(v + _MARGIN_RAD for v in servos.high)),
        (tuple(-v for v in fast), fast),
        (servos.low, servos.high),
    )
    # The present part of the observation.
    if features is None:
        measured = (("position", "rad", position), ("velocity", "rad/s", velocity), ("goal", "rad", goal))
        present = [ObservationTerm(name, (unit,) * n, 1, *bounds) for name, unit, bounds in measured]
        if aim:
            present.append(ObservationTerm("aim", tuple(unit for _, unit in aim)))
    else:
        present = [ObservationTerm.within(f[0], f[1], f[2] if len(f) > 2 else math.inf) for f in features if f[1]]
    # The history.
    if history:
        units = ("rad",) * n + ("rad/s",) * n + ("rad",) * n
        low, high = (position[i] + velocity[i] + goal[i] for i in (0, 1))
        # Before the first steps, the history is 0.
        bounds = tuple(min(v, 0.0) for v in low), tuple(max(v, 0.0) for v in high)
        present.append(ObservationTerm("past position, velocity, goal", units, history, *bounds))
    return tuple(present)
