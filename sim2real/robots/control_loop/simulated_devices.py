"""Sensor and actuator in simulation, for any world. Imports no MuJoCo, which would take seconds."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import NamedTuple, Unpack

import numpy as np

from sim2real import pytree
from sim2real.artifacts.identification import Noise
from sim2real.errors import UsageError
from sim2real.graph.base import Base, GraphState, StepState, Value
from sim2real.graph.node import BaseNode, NodeOptions
from sim2real.later import jax, jnp
from sim2real.robots.control_loop.loop import DelayParams, delay_of
from sim2real.robots.control_loop.messages import Goals
from sim2real.robots.roles import ROLES
from sim2real.types import Array, Key, PyTree


class NoiseSizes(NamedTuple):
    """Sizes of a sensor's noise, each of shape ``(noise,)`` in the units of ``Noise``."""

    deviation: Array
    quantum: Array
    bias: Array


class SimSensor(BaseNode):
    """The encoders in simulation: passes on the world's message, with the delay in ``DelayParams``.

    Args:
        rate: Steps per second [Hz].
        **options: Options of ``BaseNode``.

    Attributes:
        noise: Noise of the readings; empty: they are exact.
    """

    def __init__(self, name: str, rate: float, world: BaseNode, **options: Unpack[NodeOptions]) -> None:
        super().__init__(name, rate, **options)
        self._world = world
        self.noise: tuple[Noise, ...] = ()
        self._sizes: NoiseSizes | None = None

    @property
    def data(self) -> NoiseSizes | None:
        """The sizes of the noise; see ``HoldsData``."""
        if self._sizes is not None or not self.noise:
            return self._sizes
        numbers = np.array([(n.deviation, n.quantum, n.bias) for n in self.noise], np.float32)
        return NoiseSizes(*numbers.T)

    def with_data(self, data: NoiseSizes) -> SimSensor:
        """Return a copy whose noise has other sizes, which may be traced."""
        sensor = copy.copy(self)
        sensor._sizes = data
        return sensor

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> DelayParams:
        """Return parameters without a delay."""
        del rng, graph_state
        return DelayParams()

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the world's message at the start."""
        return self._world.init_output(rng, graph_state)

    def init_delays(self, rng: Key | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        """Return the sensing delay [s], if the parameters have one."""
        del rng
        return delay_of(self.name, self._world.name, graph_state)

    def init_state(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the biases of an episode, ``(noise,)``; without any noise there is no state."""
        if (sizes := self.data) is None:
            return super().init_state(rng, graph_state)
        drawn = jnp.zeros(len(self.noise)) if rng is None else jax.random.normal(rng, (len(self.noise),))
        params = (graph_state or GraphState()).params.get(self.name)
        return SensorBias(_scale(params) * drawn * sizes.bias)

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Return the world's message, with noise if there is any."""
        message = step_state.inputs[self._world.name][-1].data
        return step_state, message if (sizes := self.data) is None else self._noisy(message, step_state, sizes)

    def _noisy(self, message: PyTree, step_state: StepState, sizes: NoiseSizes) -> PyTree:
        if step_state.rng is None:
            raise UsageError(f"sensor {self.name!r} has noise and no random numbers to draw it from")
        # A key of its own for each step; the sensor has no other use for its random numbers.
        key = jax.random.fold_in(step_state.rng, step_state.seq)
        added = jax.random.normal(key, (len(self.noise),)) * sizes.deviation
        added = _scale(step_state.params) * added + step_state.state.bias
        changed: dict[str, PyTree] = {}
        for noise, error, quantum in zip(self.noise, added, sizes.quantum, strict=True):
            field, index = noise.place
            value = jnp.asarray(changed.get(field, getattr(message, field)))
            entry = (value if index is None else value[index]) + error
            entry = quantum * jnp.round(entry / quantum) if noise.quantum else entry
            changed[field] = entry if index is None else value.at[index].set(entry)
        return message.replace(**changed)


def _scale(params: PyTree) -> PyTree:
    """Return the factor on the noise in a sensor's parameters."""
    noise = getattr(params, "noise", None)
    return 1.0 if noise is None else noise


@pytree.dataclass
class SensorBias(Base):
    """The constant error of a simulated sensor's readings in an episode.

    Attributes:
        bias: Shape ``(noise,)``, each in the unit of its noise.
    """

    bias: Array


class SimActuator(BaseNode):
    """The bus in simulation: passes on the agent's commands.

    The default output is ``start`` of the agent's parameters, at which the joints are held, or zeros if they have none.

    Args:
        rate: Steps per second [Hz].
        field: Field of the agent's message that is the command, shape ``(joints,)``.
        **options: Options of ``BaseNode``.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        joints: int,
        field: str = "goal",
        message: Callable[[PyTree], PyTree] = Goals,
        agent: str = ROLES.supervisor,
        **options: Unpack[NodeOptions],
    ) -> None:
        super().__init__(name, rate, **options)
        self._joints, self._field, self._message, self._agent = joints, field, message, agent

    def init_params(self, rng: Key | None = None, graph_state: GraphState | None = None) -> DelayParams:
        """Return parameters without a delay."""
        del rng, graph_state
        return DelayParams()

    def init_output(self, rng: Key | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return a message with the agent's start, or with zeros."""
        del rng
        start = getattr((graph_state or GraphState()).params.get(self._agent), "start", None)
        return self._message(np.zeros(self._joints, np.float32) if start is None else jnp.asarray(start, jnp.float32))

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Return the newest command."""
        return step_state, self._message(getattr(step_state.inputs[self._agent][-1].data, self._field))
