"""A composed task as the world of a graph."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from sim2real import pytree
from sim2real.composer.mjx_environment import MjxEnvironment, State
from sim2real.composer.physics.mjx import constants
from sim2real.composer.physics.mjx.physics import MjxPhysics
from sim2real.composer.task import Task
from sim2real.composer.variation.variators import CONSTANTS
from sim2real.errors import UsageError
from sim2real.graph.base import Base, GraphState, StepState, Value
from sim2real.graph.node import BaseWorld
from sim2real.worlds.recorded import delay_of

if TYPE_CHECKING:
    from mujoco import mjx

    from sim2real.composer.mjcf.element import Elements
    from sim2real.types import PyTree


@pytree.dataclass
class WorldParams(Base):
    """Parameters that differ from copy to copy.

    Attributes:
        values: Name -> array, in the unit of the attribute that it sets.
        qpos: Positions ``(nq,)`` at the start, before the task's hooks [m or rad]; None: the model's.
        qvel: Velocities ``(nv,)`` at the start [m/s or rad/s]; None: 0.
    """

    values: dict[str, PyTree]
    qpos: PyTree = None
    qvel: PyTree = None


@pytree.dataclass
class Observations(Base):
    """The observation of a task.

    Attributes:
        values: Key of the observable -> array.
    """

    values: dict[str, jax.Array]


class ComposedWorld(BaseWorld):
    """A task that ticks in MJX as a node: its action comes from one input, its output is the observation.

    A tick is a control step. Delays of observables act inside the node, delays of connections between nodes. The state
    is the environment's: data, samples that may still be read, variables of the task. Subclasses may send another
    message: see ``output``.

    Args:
        field: Field of that input's message: shape ``(nu,)``.
        parameters: Name -> (element or elements, attribute), such as ``{"friction": (joint, "frictionloss")}``.
        rate: Ticks per second [Hz]; must be the rate of control steps, which is the default.
        **options: Passed on to ``MjxEnvironment``.

    Raises:
        UsageError: The rate is not that of control steps, a parameter cannot vary on MJX, or MJX cannot run the world.
    """

    def __init__(
        self,
        name: str,
        task: Task,
        command: str = "actuator",
        field: str = "action",
        parameters: Mapping[str, tuple[Elements, str]] | None = None,
        rate: float | None = None,
        color: str | None = None,
        order: int | None = None,
        **options: PyTree,
    ) -> None:
        # Compile the task, and check that a tick is a control step.
        self.environment = MjxEnvironment(task, **options)
        ticks = 1.0 / task.control_timestep
        if rate is not None and not math.isclose(rate, ticks, rel_tol=1e-6):
            raise UsageError(
                f"world {name!r}: a tick of {1 / rate:g} s is no control step of {task.control_timestep:g} s",
                hint="set the task's control_timestep to 1 / rate",
            )
        super().__init__(name, ticks, color=color, order=order)
        self.input_name, self.field = command, field
        self._parameters = dict(parameters or {})
        self._derives = any(attribute in CONSTANTS for _, attribute in self._parameters.values())
        # Set the parameters once: this refuses parameters that cannot vary.
        physics = self._view()
        self._set(physics, self.init_params())  # raises an error for parameters that cannot vary
        if self._derives:
            self.environment.carry(constants.derived(self.environment.model, physics.mjx_model))

    def _view(self) -> MjxPhysics:
        return MjxPhysics(self.environment.model, self.environment.mjx_model, None, {})

    def _set(self, physics: MjxPhysics, params: WorldParams) -> None:
        for name, (elements, attribute) in self._parameters.items():
            physics.set(elements, attribute, params.values[name])

    def _model(self, params: WorldParams, starts: bool = False) -> mjx.Model:
        """Return the model with the parameters; ``starts``: compute constants derived from masses and lengths."""
        physics = self._view()
        self._set(physics, params)
        if starts and self._derives:
            physics.recompute_constants()
        return physics.mjx_model

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> WorldParams:
        """Return the parameters' compiled values."""
        del rng, graph_state
        physics = self._view()
        return WorldParams({k: jnp.asarray(physics.get(*place)) for k, place in self._parameters.items()})

    def init_state(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> State:
        """Return the start of an episode."""
        key, params = jax.random.key(0) if rng is None else rng, self._params(graph_state)
        model = self.environment.model
        qpos = model.qpos0 if params.qpos is None else params.qpos
        qvel = jnp.zeros(model.nv) if params.qvel is None else params.qvel
        return self.environment.reset(key, self._model(params, starts=True), (qpos, qvel))

    def init_delays(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> dict[str, Value]:
        """Return the delay of commands in an episode [s]: ``delay`` in the sender's parameters."""
        del rng
        return delay_of(self.input_name, self.input_name, graph_state)

    def output(self, state: State) -> PyTree:
        """Return the message of a state; default: the task's observation."""
        return Observations(state.observation)

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return the message at the start of the episode."""
        state = (graph_state or GraphState()).state.get(self.name)
        return self.output(self.init_state(rng, graph_state) if state is None else state)

    def step(self, step_state: StepState) -> tuple[StepState, PyTree]:
        """Take a control step under the newest action."""
        action = self._action(step_state)
        before = step_state.state
        params = step_state.params
        state: PyTree = self.environment.step(before, action, self._model(params))
        # An episode that has ended stays ended, because readers do not read every tick.
        truncated = jnp.where(before.done, before.truncated, state.truncated)
        state = state.replace(done=before.done | state.done, truncated=truncated)
        new = step_state.replace(state=state)
        return new, self.output(state)

    @property
    def has_reward(self) -> bool:
        """Whether the task has a reward, which is in the state."""
        return self.environment.has_reward

    def ends(self, state: State) -> tuple[jax.Array, jax.Array]:
        """Return whether the task ended its episode, and whether its time limit did, at this tick or before."""
        return state.done & ~state.truncated, state.truncated

    def _action(self, step_state: StepState) -> jax.Array:
        return getattr(step_state.inputs[self.input_name].data, self.field)[-1]

    def _params(self, graph_state: GraphState | None) -> WorldParams:
        params = (graph_state or GraphState()).params.get(self.name)
        return self.init_params() if params is None else params
