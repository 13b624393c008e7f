"""Swing up from anywhere and stay upright."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.graph.base import GraphState, StepState
from sim2real.robots.loop import draw_values

from .model import HISTORY, Agent, node_params

LIMIT_V = 2.0
"""Largest voltage that the policy may ask for [V]."""


def upright(th: Any, thdot: Any) -> Any:
    """Return where the pendulum counts as upright: cos(th) > 0.95 and |thdot| < 0.5 rad/s."""
    return (jnp.cos(th) > 0.95) & (jnp.abs(thdot) < 0.5)


class SwingUp:
    """The task of the pendulum; see ``sim2real.train.env.TrainingTask``.

    Args:
        agent: The agent's node of the graph.
        values: Parameters to train on, by name.
        draws: Values that episodes take instead, ``(K,)`` each, drawn together; values not named are fixed.
        delay_spread_s: Delays vary by this much either way [s].
    """

    supervisor = "agent"
    observation_size = 3 + HISTORY * 4
    action_low = np.array([-LIMIT_V], np.float32)
    action_high = np.array([LIMIT_V], np.float32)

    def __init__(
        self, agent: Agent, values: Mapping[str, float], draws: Mapping[str, np.ndarray], delay_spread_s: float
    ) -> None:
        self.agent = agent
        self.values = dict(values)
        self.draws = {n: jnp.asarray(d, jnp.float32) for n, d in draws.items()}
        self.delay_spread_s = delay_spread_s

    def params(self, key: jax.Array) -> dict[str, Any]:
        """Draw dynamics, delays and the state in which an episode starts: half of them hanging, half anywhere."""
        k_values, k_state, k_where = jax.random.split(key, 3)
        drawn = draw_values(k_values, self.values, self.draws, self.delay_spread_s)
        anywhere = jax.random.uniform(k_state, (2,), minval=-1.0, maxval=1.0) * jnp.array([jnp.pi, 9.0])
        hanging = jnp.array([jnp.pi, 0.0]) + 0.05 * anywhere
        start = jnp.where(jax.random.bernoulli(k_where), hanging, anywhere)
        return node_params(drawn, start)

    def observe(self, step_state: StepState) -> jax.Array:
        """Return what the agent's node shows the policy, shape ``(19,)``."""
        return self.agent.observe(step_state)

    def act(self, step_state: StepState, action: jax.Array) -> tuple[StepState, Any]:
        """Let the agent's node pass the action on."""
        return self.agent.act(step_state, action)

    def reward(self, graph_state: GraphState, action: jax.Array) -> jax.Array:
        """Return minus the seed's cost: angle, speed that matters only near the top, and voltage."""
        state = graph_state.state["world"]
        th = state.th - 2 * jnp.pi * jnp.floor((state.th + jnp.pi) / (2 * jnp.pi))
        return -(th**2 + 0.1 * (state.thdot / (1 + 10 * jnp.abs(th))) ** 2 + 0.01 * action[0] ** 2)

    def success(self, graph_state: GraphState) -> jax.Array:
        """Return whether the pendulum is upright."""
        state = graph_state.state["world"]
        return upright(state.th, state.thdot)
