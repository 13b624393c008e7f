"""The task of a robot of servos: each episode has an aim, and starts at rest or at a random position."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from sim2real.later import jax, jnp
from sim2real.robots.loop import Draw
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import RobotTask
from sim2real.robots.servo.servos import Servos
from sim2real.training.environment.tasks import Rewards
from sim2real.types import Array, Key, PyTree


@dataclass(frozen=True)
class Aim:
    """The aim of an episode, such as a target's position.

    Attributes:
        entries: Name and unit of each of the k entries.
        draw: Returns the aim of an episode ``(k,)``: of training for a key of JAX, of a trial for its number; see
            ``uniform``.
        elements: Returns the parts of the composed task that an aim sets: name -> (elements, attribute).
        place: Returns the arrays of ``elements`` for an aim ``(k,)``.
    """

    entries: tuple[tuple[str, str], ...]
    draw: Callable[[Key | int], Array]
    elements: Callable[[PyTree], Mapping[str, tuple[PyTree, str]]] = lambda task: {}
    place: Callable[[Array], dict[str, Array]] = lambda aim: {}


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


class AimTask(RobotTask):
    """A composed task's reward, from random aims and starts: half of the episodes start at rest.

    Args:
        success: Returns whether a state of the world fulfils the task, bool.
        score: Returns figures of a deployment; see ``RobotTask.score``.
        reward: Returns the reward of a state and an action; default: the composed task's, minus a penalty on speed.
    """

    def __init__(
        self,
        servos: Servos,
        aim: Aim,
        success: Callable[[PyTree], jax.Array],
        score: Callable[[np.ndarray, Mapping[str, np.ndarray]], dict[str, float]],
        reward: Callable[[PyTree, jax.Array], Rewards] | None = None,
    ) -> None:
        self._servos, self.aim = servos, aim
        self._success, self._score, self._reward = success, score, reward

    def random(self, key: Key, draw: Draw) -> tuple[dict[str, PyTree], EpisodeStart]:
        """Return values and a start: half of the starts are at rest, half at any position."""
        k_values, k_aim, k_where, k_start = jax.random.split(key, 4)
        values, s = draw(k_values), self._servos
        low, high, rest = (jnp.asarray(x, jnp.float32) for x in (s.low, s.high, s.at_rest))
        anywhere = jax.random.uniform(k_start, low.shape, minval=low, maxval=high)
        position = jnp.where(jax.random.bernoulli(k_where), rest, anywhere)
        return values, EpisodeStart(position, jnp.zeros_like(position), self.aim.draw(k_aim))

    def at_rest(self, trial: int) -> EpisodeStart:
        """Return the start at rest with the aim of a trial."""
        rest = self._servos.at_rest
        return EpisodeStart(rest, np.zeros_like(rest), self.aim.draw(trial))

    def moved(self, start: EpisodeStart, position: Array, velocity: Array) -> EpisodeStart:
        """Return a start with an offset, within the goals' bounds."""
        low, high = (jnp.asarray(bound) for bound in (self._servos.low, self._servos.high))
        position = jnp.clip(start.position + position, low, high)
        return start.replace(position=position, velocity=start.velocity + velocity)

    def reward(self, state: PyTree, action: jax.Array) -> Rewards:
        """Return the reward of a policy step."""
        if self._reward is not None:
            return self._reward(state, action)
        return {"task": state.reward, "speed": -0.01 * jnp.mean((action / self._servos.speed) ** 2)}

    def success(self, state: PyTree) -> jax.Array:
        """Return whether the task is fulfilled, bool."""
        return self._success(state)

    def score(self, t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return figures of how well a deployment went."""
        return self._score(t_s, states)
