"""The task of a robot of servos: each episode has an aim, and starts at rest or at a random position."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim2real.graph.base import GraphState
from sim2real.later import jax, jnp
from sim2real.robots.loop import AGENT, WORLD, Draw
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotTask
from sim2real.robots.servo.servos import Servos
from sim2real.training.environment.tasks import Rewards
from sim2real.types import Array, Key, PyTree, Scalar


@dataclass(frozen=True)
class Aim:
    """The aim of an episode, such as a target's position, or a target that moves.

    Attributes:
        entries: Name and unit of each of the k entries.
        draw: Returns the numbers of an episode ``(m,)``: of training for a key of JAX, of a trial for its number; see
            ``uniform``. They are the aim itself ``(k,)`` if it does not move.
        at: Returns the aim ``(k,)`` for an episode's numbers and the time from its start [s]; None: it does not move.
    """

    entries: tuple[tuple[str, str], ...]
    draw: Callable[[Key | int], Array]
    at: Callable[[Array, Scalar], Array] | None = None


def uniform(key: Key | int, low: PyTree, high: PyTree) -> Array:
    """Return one number between each pair of bounds ``(n,)``, float32; one key always gives the same ones.

    Args:
        key: A key of JAX, also in a traced function; or a seed of numpy, which needs no JAX.
    """
    if isinstance(key, int | np.integer):
        return np.random.default_rng(key).uniform(low, high).astype(np.float32)
    return jax.random.uniform(key, np.shape(low), minval=np.asarray(low), maxval=np.asarray(high))


NO_AIM = Aim((), lambda key: np.zeros(0, np.float32))
"""The aim of a task that is the same in every episode."""


class ServoMoment(NamedTuple):
    """What a reward sees after a policy step.

    Attributes:
        position: Of the joints ``(joints,)`` [rad].
        velocity: Of the joints ``(joints,)`` [rad/s].
        aim: The aim at this time ``(k,)``.
    """

    position: Array
    velocity: Array
    aim: Array


class AimTask(RobotTask):
    """A task with random aims and starts: half of the episodes start at rest.

    Args:
        reward: Returns the reward of a moment; a penalty on the goals' speed is added.
        success: Returns whether the task is fulfilled, bool.
        score: Returns figures of a deployment; see ``RobotTask.score``.
    """

    def __init__(
        self,
        servos: Servos,
        aim: Aim,
        reward: Callable[[ServoMoment], jax.Array],
        success: Callable[[ServoMoment], jax.Array],
        score: Callable[[np.ndarray, Mapping[str, np.ndarray]], dict[str, float]],
    ) -> None:
        self._servos, self.aim = servos, aim
        self._reward, self._success, self._score = reward, success, score

    def random(self, key: Key, draw: Draw) -> tuple[dict[str, PyTree], EpisodeStart]:
        """Return values and a start: half of the starts are at rest, half at any position."""
        k_values, k_aim, k_where, k_start = jax.random.split(key, 4)
        values, s = draw(k_values), self._servos
        low, high, rest = (jnp.asarray(x, jnp.float32) for x in (s.low, s.high, s.at_rest))
        anywhere = jax.random.uniform(k_start, low.shape, minval=low, maxval=high)
        position = jnp.where(jax.random.bernoulli(k_where), rest, anywhere)
        return values, EpisodeStart(position, jnp.zeros_like(position), self.aim.draw(k_aim))

    def at_rest(self, trial: int) -> EpisodeStart:
        rest = self._servos.at_rest
        return EpisodeStart(rest, np.zeros_like(rest), self.aim.draw(trial))

    def moved(self, start: EpisodeStart, position: Array, velocity: Array) -> EpisodeStart:
        """Return a start with an offset, within the goals' bounds."""
        low, high = (jnp.asarray(bound) for bound in (self._servos.low, self._servos.high))
        position = jnp.clip(start.position + position, low, high)
        return start.replace(position=position, velocity=start.velocity + velocity)

    def judged(self, graph_state: GraphState) -> ServoMoment:
        state, aim = graph_state.state[WORLD], jnp.asarray(graph_state.params[AGENT].aim)
        if self.aim.at is not None:
            aim = self.aim.at(aim, state.time_s)
        return ServoMoment(state.position, state.velocity, aim)

    def reward(self, state: ServoMoment, action: jax.Array) -> Rewards:
        return {"task": self._reward(state), "speed": -0.01 * jnp.mean((action / self._servos.speed) ** 2)}

    def success(self, state: ServoMoment) -> jax.Array:
        return self._success(state)

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        return self._score(t_s, states)
