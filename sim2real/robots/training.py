"""The training task of a servo robot: a composed task with random dynamics, delays and starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState, StepState
from sim2real.robots.agent import GoalAgent
from sim2real.robots.loop import draw_values

if TYPE_CHECKING:
    from sim2real.robots.servo_robot import ServoRobot


class ServoTask:
    """The training task of a servo robot; see ``sim2real.train.env.TrainingTask``.

    Args:
        robot: The robot.
        agent: The agent's node in the graph.
        values: Parameters by name.
        draws: Samples of some parameters, each of shape ``(K,)``; one of the K joint samples is drawn for each episode
            in place of the values.
        delay_spread_s: Largest deviation of an episode's delay from its value [s].
    """

    def __init__(
        self,
        robot: ServoRobot,
        agent: GoalAgent,
        values: Mapping[str, float],
        draws: Mapping[str, np.ndarray],
        delay_spread_s: float,
    ) -> None:
        self.robot, self.agent, self.values = robot, agent, dict(values)
        self.supervisor = robot.roles.supervisor
        self.draws = {n: jnp.asarray(d, jnp.float32) for n, d in draws.items()}
        self.delay_spread_s = delay_spread_s
        self.observation_size = robot.observation_size
        speed = np.full(len(robot.servos.joints), robot.servos.speed, np.float32)
        self.action_low, self.action_high = -speed, speed

    def params(self, key: jax.Array) -> dict[str, Any]:
        """Draw dynamics, delays, aim and start of an episode: half of the starts are at rest, half at any position."""
        k_values, k_aim, k_where, k_start = jax.random.split(key, 4)
        drawn = draw_values(k_values, self.values, self.draws, self.delay_spread_s)
        servos = self.robot.servos
        low, high, rest = (jnp.asarray(x, jnp.float32) for x in (servos.low, servos.high, servos.at_rest))
        anywhere = jax.random.uniform(k_start, low.shape, minval=low, maxval=high)
        start = jnp.where(jax.random.bernoulli(k_where), rest, anywhere)
        return self.robot.node_params(drawn, start, jnp.zeros_like(start), self.robot.draw_aim(k_aim))

    def observe(self, step_state: StepState) -> jax.Array:
        """Return the policy's observation, made by the agent's node."""
        return self.agent.observe(step_state)

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, Any]:
        """Return the agent's new step state and its message for an action."""
        return self.agent.act(step_state, action)

    def reward(self, graph_state: GraphState, action: jax.Array) -> jax.Array:
        """Return the robot's reward of a row."""
        return self.robot.reward(graph_state.state[self.robot.roles.world], action)

    def success(self, graph_state: GraphState) -> jax.Array:
        """Return whether the task is fulfilled."""
        return self.robot.success(graph_state.state[self.robot.roles.world])
