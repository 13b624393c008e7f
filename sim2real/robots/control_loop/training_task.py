"""The training task of a robot in a loop: random dynamics, delays and starts, and what the robot says of its states."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState, StepState
from sim2real.policy.contract import ActionTerm
from sim2real.robots.control_loop.loop import DelayParams, draw_values
from sim2real.robots.roles import Roles
from sim2real.train.environment.tasks import Rewards

Draw = Callable[[jax.Array], dict[str, Any]]
"""Draws dynamics and delays of an episode, by name."""


class TrainableLoop(Protocol):
    """What a task asks of its robot; see ``LoopRobot``."""

    roles: Roles
    channels: tuple[Any, ...]

    @property
    def action(self) -> tuple[ActionTerm, ...]:
        """The policy's actions, with their bounds."""
        ...

    @property
    def observation_size(self) -> int:
        """Number of entries of the policy's observation."""
        ...

    def random_params(self, key: jax.Array, draw: Draw) -> dict[str, Any]:
        """Return parameters of the nodes for a random episode."""
        ...

    def displaced(self, params: Mapping[str, Any], position: jax.Array, velocity: jax.Array) -> dict[str, Any]:
        """Return an episode's parameters with another start, see ``LoopRobot``.

        Args:
            position: What is added to the joints' positions ``(joints,)`` [rad].
            velocity: What is added to their velocities ``(joints,)`` [rad/s].
        """
        ...

    def judged(self, graph_state: GraphState) -> Any:
        """Return what reward and success are functions of."""
        ...

    def reward(self, state: Any, action: jax.Array) -> Rewards:
        """Return the reward of a policy step, or its terms by name."""
        ...

    def success(self, state: Any) -> jax.Array:
        """Return whether a state of the world is one that the task wants, bool."""
        ...

    def terminated(self, state: Any) -> jax.Array:
        """Return whether a state of the world ends the episode, bool."""
        ...

    def true_state(self, state: Any) -> Any:
        """Return what of a state of the world is worth knowing, a pytree of arrays."""
        ...


class LoopTask:
    """The training task of a robot in a loop; see ``sim2real.train.environment.graph_environment.TrainingTask``.

    Args:
        agent: The agent's node in the graph.
        draws: Samples of some parameters, each of shape ``(K,)``; one of the K joint samples is drawn for each episode
            in place of the values.

    Attributes:
        start: Largest change of a joint's position [rad] and of its velocity [rad/s] at the start of an episode.
    """

    def __init__(
        self,
        robot: TrainableLoop,
        agent: Any,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
    ) -> None:
        self.robot, self.agent = robot, agent
        self.values: dict[str, Any] = dict(values)
        self.supervisor = robot.roles.supervisor
        self.draws = {n: jnp.asarray(d, jnp.float32) for n, d in draws.items()}
        self.observation_size = robot.observation_size
        self.start = (0.0, 0.0)
        self.action_low, self.action_high = np.array([(t.low, t.high) for t in robot.action], np.float32).T

    @property
    def data(self) -> Any:
        """The values and samples of the parameters; see ``HoldsData``."""
        return {n: jnp.asarray(v, jnp.float32) for n, v in self.values.items()}, self.draws

    def with_data(self, data: Any) -> LoopTask:
        """Return a copy with other values and samples, which may be traced."""
        task = copy.copy(self)
        task.values, task.draws = data
        return task

    def params(self, key: jax.Array) -> dict[str, Any]:
        """Draw the parameters of an episode."""
        return self.params_at(key, None)

    def params_at(self, key: jax.Array, width: jax.Array | None) -> dict[str, Any]:
        """Draw the parameters of an episode that has a share of all differences; None: all of them."""
        draw = partial(self._draw, width=width)
        if any(self.start):
            key, key_start = jax.random.split(key)
            params = self.robot.displaced(self.robot.random_params(key, draw), *self.offsets(key_start, width))
        else:
            params = self.robot.random_params(key, draw)
        sensor = self.robot.roles.sensor
        if width is None or not isinstance(params[sensor], DelayParams):
            return params
        return {**params, sensor: params[sensor].replace(noise=width)}

    def offsets(self, key: jax.Array, width: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Draw how far from the robot's own start an episode starts: positions and velocities, ``(joints,)`` each.

        Args:
            width: Share of the differences; None: all of them.
        """
        share = 1.0 if width is None else width
        drawn = share * jax.random.uniform(key, (2, len(self.robot.channels)), minval=-1.0, maxval=1.0)
        return self.start[0] * drawn[0], self.start[1] * drawn[1]

    def observe(self, step_state: StepState) -> jax.Array:
        """Return the policy's observation, made by the agent's node."""
        return self.agent.observe(step_state)

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, Any]:
        """Return the agent's new step state and its message for an action."""
        return self.agent.act(step_state, action)

    def reward(self, graph_state: GraphState, action: jax.Array) -> Rewards:
        """Return the robot's reward of a row."""
        return self.robot.reward(self.robot.judged(graph_state), action)

    def success(self, graph_state: GraphState) -> jax.Array:
        """Return whether the task is fulfilled."""
        return self.robot.success(self.robot.judged(graph_state))

    def terminated(self, graph_state: GraphState) -> jax.Array:
        """Return whether the robot's episode ended."""
        return self.robot.terminated(self.robot.judged(graph_state))

    def privileged(self, graph_state: GraphState) -> jax.Array:
        """Return what is true: the world's state, and the parameters that the episode has, shape ``(P,)``."""
        known = (self.robot.true_state(self.robot.judged(graph_state)), graph_state.params)
        numbers = [x for x in map(jnp.asarray, jax.tree.leaves(known)) if jnp.issubdtype(x.dtype, jnp.inexact)]
        return jnp.concatenate([x.astype(jnp.float32).ravel() for x in numbers])

    def _draw(self, key: jax.Array, width: jax.Array | None) -> dict[str, Any]:
        drawn = draw_values(key, self.values, self.draws)
        if width is None:
            return drawn
        return {n: own + width * (drawn[n] - own) if n in self.draws else own for n, own in self.values.items()}
