"""The training task of a robot in a loop: random dynamics, delays and starts, and the robot's rewards."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from sim2real.graph.base import GraphState, StepState
from sim2real.later import jax, jnp
from sim2real.robots.control_loop.loop import draw_values
from sim2real.robots.robot_parts import ConnectedParts
from sim2real.training.environment.tasks import Rewards
from sim2real.types import PyTree


class LoopTask:
    """The training task of a robot in a loop; see ``sim2real.training.environment.graph_environment.TrainingTask``.

    Args:
        draws: Samples of some parameters, each of shape ``(K,)``; one of the K joint samples is drawn for each episode
            in place of the values.

    Attributes:
        start: Largest change of a joint's position [rad] and of its velocity [rad/s] at the start of an episode.
    """

    def __init__(
        self, robot: ConnectedParts, agent: Any, values: Mapping[str, float], draws: Mapping[str, np.ndarray]
    ) -> None:
        self.robot, self.agent = robot, agent
        self.values: dict[str, PyTree] = dict(values)
        self.supervisor = robot.roles.supervisor
        self.draws = {n: jnp.asarray(d, jnp.float32) for n, d in draws.items()}
        self.observation_size = robot.agent.observation_size
        self.start = (0.0, 0.0)
        self.action_low, self.action_high = np.array([(t.low, t.high) for t in robot.agent.action], np.float32).T

    @property
    def data(self) -> PyTree:
        """The values and samples of the parameters; see ``HoldsData``."""
        return {n: jnp.asarray(v, jnp.float32) for n, v in self.values.items()}, self.draws

    def with_data(self, data: PyTree) -> LoopTask:
        """Return a copy with other values and samples, which may be traced."""
        task = copy.copy(self)
        task.values, task.draws = data
        return task

    def params(self, key: jax.Array) -> dict[str, PyTree]:
        """Draw the parameters of an episode."""
        return self.params_at(key, None)

    def params_at(self, key: jax.Array, width: jax.Array | None) -> dict[str, PyTree]:
        """Draw the parameters of an episode that has a share of all differences; None: all of them."""
        draw = partial(self._draw, width=width)
        task = self.robot.task
        # Draw values and start; then move the start, and scale the noise.
        if any(self.start):
            key, key_start = jax.random.split(key)
            values, start = task.random(key, draw)
            start = task.moved(start, *self.offsets(key_start, width))
        else:
            values, start = task.random(key, draw)
        if width is not None:
            start = task.narrowed(start, width)
        params = self.robot.node_parameters(values, start)
        if width is not None:
            sensor = self.robot.roles.sensor
            params[sensor] = params[sensor].replace(noise=width)
        return params

    def offsets(self, key: jax.Array, width: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Draw the offsets of an episode's start: positions [rad] and velocities [rad/s], ``(joints,)`` each.

        Args:
            width: Share of the differences; None: all of them.
        """
        share = 1.0 if width is None else width
        drawn = share * jax.random.uniform(key, (2, len(self.robot.sensor.channels)), minval=-1.0, maxval=1.0)
        return self.start[0] * drawn[0], self.start[1] * drawn[1]

    def observe(self, step_state: StepState) -> jax.Array:
        """Return the policy's observation, made by the agent's node."""
        return self.agent.observe(step_state)

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, PyTree]:
        """Return the agent's new step state and its message for an action."""
        return self.agent.act(step_state, action)

    def reward(self, graph_state: GraphState, action: jax.Array) -> Rewards:
        """Return the robot's reward of a row."""
        return self.robot.task.reward(self._judged(graph_state), action)

    def success(self, graph_state: GraphState) -> jax.Array:
        """Return whether the task is fulfilled."""
        return self.robot.task.success(self._judged(graph_state))

    def terminated(self, graph_state: GraphState) -> jax.Array:
        """Return whether the robot's episode ended."""
        return self.robot.task.terminated(self._judged(graph_state))

    def privileged(self, graph_state: GraphState) -> jax.Array:
        """Return the true state of the world, and the parameters of the episode, shape ``(P,)``."""
        state = self.robot.model.true_state(graph_state.state[self.robot.roles.world])
        numbers = [x for x in map(jnp.asarray, jax.tree.leaves((state, graph_state.params)))]
        numbers = [x for x in numbers if jnp.issubdtype(x.dtype, jnp.inexact)]
        return jnp.concatenate([x.astype(jnp.float32).ravel() for x in numbers])

    def _judged(self, graph_state: GraphState) -> PyTree:
        return self.robot.task.judged(graph_state, self.robot.roles)

    def _draw(self, key: jax.Array, width: jax.Array | None) -> dict[str, PyTree]:
        drawn = draw_values(key, self.values, self.draws)
        if width is None:
            return drawn
        return {n: value + width * (drawn[n] - value) if n in self.draws else value for n, value in self.values.items()}
