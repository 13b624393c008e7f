"""Sensor and actuator in simulation, for any world: imports no MuJoCo, which takes seconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from sim2real.graph.base import GraphState, StepState
from sim2real.graph.node import BaseNode
from sim2real.robots.loop import DelayParams, delay_of
from sim2real.robots.messages import Goals


class SimSensor(BaseNode):
    """The encoders in simulation: pass the world's message on, as late as ``DelayParams`` says.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        world: The world that it reads.
        **options: As of ``BaseNode``.
    """

    def __init__(self, name: str, rate: float, world: BaseNode, **options: Any) -> None:
        super().__init__(name, rate, **options)
        self._world = world

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> DelayParams:
        """Return no delay of its own."""
        del rng, graph_state
        return DelayParams()

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        """Return the world's message at the start."""
        return self._world.init_output(rng, graph_state)

    def init_delays(self, rng: Any = None, graph_state: GraphState | None = None) -> dict[str, Any]:
        """Return the sensing delay, where the parameters set one."""
        del rng
        return delay_of(self.name, self._world.name, graph_state)

    def step(self, step_state: StepState) -> tuple[StepState, Any]:
        """Measure."""
        return step_state, step_state.inputs[self._world.name][-1].data


class SimActuator(BaseNode):
    """The bus in simulation: passes the agent's commands on.

    Before the first one it is the agent's ``start``, so that joints are held where they are; zeros for agents without.

    Args:
        name: Unique in the graph.
        rate: Steps per second [Hz].
        joints: How many there are.
        field: Field of the agent's message that is the command, ``(joints,)``.
        message: Makes the node's message of a command.
        **options: As of ``BaseNode``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        joints: int,
        field: str = "goal",
        message: Callable[[Any], Any] = Goals,
        **options: Any,
    ) -> None:
        super().__init__(name, rate, **options)
        self._joints, self._field, self._message = joints, field, message

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> DelayParams:
        """Return no delay of its own."""
        del rng, graph_state
        return DelayParams()

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        """Return where the agent starts."""
        del rng
        start = getattr((graph_state or GraphState()).params.get("agent"), "start", None)
        return self._message(jnp.zeros(self._joints) if start is None else jnp.asarray(start, jnp.float32))

    def step(self, step_state: StepState) -> tuple[StepState, Any]:
        """Pass the newest command on."""
        return step_state, self._message(getattr(step_state.inputs["agent"][-1].data, self._field))
