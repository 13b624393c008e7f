"""Sensor and actuator in simulation, for any world. Imports no MuJoCo, which would take seconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.robots.loop import DelayParams, delay_of
from sim2real.robots.messages import Goals
from sim2real.robots.roles import ROLES


class SimSensor(BaseNode):
    """The encoders in simulation: passes on the world's message, with the delay in ``DelayParams``.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        world: The world that it reads.
        **options: Options of ``BaseNode``.
    """

    def __init__(self, name: str, rate: float, world: BaseNode, **options: Any) -> None:
        super().__init__(name, rate, **options)
        self._world = world

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> DelayParams:
        """Return parameters without a delay."""
        del rng, graph_state
        return DelayParams()

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        """Return the world's message at the start."""
        return self._world.init_output(rng, graph_state)

    def init_delays(self, rng: Any = None, graph_state: GraphState | None = None) -> dict[str, Any]:
        """Return the sensing delay [s], if the parameters have one."""
        del rng
        return delay_of(self.name, self._world.name, graph_state)

    def step(self, step_state: StepState) -> tuple[StepState, Any]:
        """Return the world's message."""
        return step_state, step_state.inputs[self._world.name][-1].data


class SimActuator(BaseNode):
    """The bus in simulation: passes on the agent's commands.

    The default output is ``start`` of the agent's parameters, at which the joints are held, or zeros if they have none.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        joints: Number of joints.
        field: Field of the agent's message that is the command, shape ``(joints,)``.
        message: Makes the node's message from a command.
        agent: Name of the agent.
        **options: Options of ``BaseNode``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        joints: int,
        field: str = "goal",
        message: Callable[[Any], Any] = Goals,
        agent: str = ROLES.supervisor,
        **options: Any,
    ) -> None:
        super().__init__(name, rate, **options)
        self._joints, self._field, self._message, self._agent = joints, field, message, agent

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> DelayParams:
        """Return parameters without a delay."""
        del rng, graph_state
        return DelayParams()

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        """Return a message with the agent's start, or with zeros."""
        del rng
        start = getattr((graph_state or GraphState()).params.get(self._agent), "start", None)
        return self._message(jnp.zeros(self._joints) if start is None else jnp.asarray(start, jnp.float32))

    def step(self, step_state: StepState) -> tuple[StepState, Any]:
        """Return the newest command."""
        return step_state, self._message(getattr(step_state.inputs[self._agent][-1].data, self._field))
