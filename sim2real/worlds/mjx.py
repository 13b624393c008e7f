"""Worlds on MJX, MuJoCo in JAX."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import Tracer

from sim2real import pytree
from sim2real.composer.physics.mjx import gate, stepping
from sim2real.composer.physics.mjx.import_mjx import mjx
from sim2real.errors import UsageError
from sim2real.graph.base import Base, Empty, GraphState, StepState
from sim2real.graph.node import BaseWorld
from sim2real.types import MjModel, PyTree
from sim2real.worlds.rollouts import Start, StepLaw


@pytree.dataclass
class MjxParams(Base):
    """Parameters of an MJX world; each copy of a graph may have its own.

    Attributes:
        qpos: Shape ``(nq,)``: positions at the start of an episode [rad or m].
        qvel: Shape ``(nv,)``: velocities at the start [rad/s or m/s].
    """

    model: mjx.Model
    qpos: jax.Array
    qvel: jax.Array


@pytree.dataclass
class MjxState(Base):
    """The world's output.

    Attributes:
        qpos: Shape ``(nq,)``: positions [rad or m].
        qvel: Shape ``(nv,)``: velocities [rad/s or m/s].
    """

    qpos: jax.Array
    qvel: jax.Array


class MjxWorld(BaseWorld):
    """A MuJoCo model that ticks in MJX; its controls come from one input.

    Args:
        rate: Ticks per second [Hz]; a tick is a whole number of the model's time steps.
        field: Field of that input's message: shape ``(nu,)`` [the actuators' unit].

    Raises:
        UsageError: The tick is no whole number of time steps, or the model asks for what MJX does otherwise:
            delays of its own (ignored or misplaced there; they belong to the graph), the no-slip solver, an integrator
            that it does not have, springs without dampers.
    """

    def __init__(
        self,
        name: str,
        rate: float,
        model: mujoco.MjModel,  # pyright: ignore[reportAttributeAccessIssue]
        command: str = "actuator",
        field: str = "action",
        color: str | None = None,
        order: int | None = None,
    ) -> None:
        super().__init__(name, rate, color=color, order=order)
        self.derives = False
        self.model = model
        self.input_name, self.field = command, field
        steps = 1.0 / (self.rate * model.opt.timestep)
        self.substeps = round(steps)
        if self.substeps < 1 or not math.isclose(steps, self.substeps, rel_tol=1e-6):
            raise UsageError(
                f"world {name!r}: a tick of {1 / self.rate:g} s is {steps:g} time steps of {model.opt.timestep:g} s",
                hint="choose a rate or a timestep that divides the tick",
            )
        try:
            gate.check_model(model)
        except UsageError as error:
            raise UsageError(f"world {name!r}: {error.args[0]}", hint=error.hint) from None
        self._mjx_model: mjx.Model = mjx.put_model(model, impl="jax")
        self._apart = False
        self.law: StepLaw | None = None
        """Fields of the model that a subclass sets before every physics step, from the state."""

    def init_params(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> MjxParams:
        """Return the model and its reference position at rest."""
        del rng, graph_state
        return MjxParams(self._mjx_model, jnp.asarray(self.model.qpos0, float), jnp.zeros(self.model.nv))

    def init_state(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> PyTree:
        """Return MJX data at the parameters' start."""
        if self._apart:
            return Empty()
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        start = mjx.make_data(self.model, impl="jax").replace(qpos=params.qpos, qvel=params.qvel)
        return stepping.JaxEngine().forward(params.model, start)

    def init_output(self, rng: jax.Array | None = None, graph_state: GraphState | None = None) -> MjxState:
        """Return positions and velocities at the start."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        return MjxState(jnp.asarray(params.qpos, float), jnp.asarray(params.qvel, float))

    def step(self, step_state: StepState) -> tuple[StepState, MjxState]:
        """Integrate over one tick under the newest control."""
        params, control = step_state.params, self._control(step_state)
        data = step_state.state
        data = data if self.law else data.replace(ctrl=jnp.asarray(control, float))

        def once(data: PyTree, _: Any = None) -> tuple[Any, None]:
            model = params.model
            if self.law:
                law = self.law(jnp, self.law_values(params), control, data.qpos, data.qvel)
                cast = lambda new, old: jnp.asarray(new, old.dtype)  # noqa: E731
                data = data.replace(ctrl=cast(law[0], data.ctrl), qfrc_applied=cast(law[1], data.qfrc_applied))
                model = stepping.with_fields(model, {n: cast(a, getattr(model, n)) for n, a in law[2].items()})
            return stepping.JaxEngine().advance(model, data, legacy=False), None

        data = once(data)[0] if self.substeps == 1 else jax.lax.scan(once, data, length=self.substeps)[0]
        return step_state.replace(state=data), MjxState(data.qpos, data.qvel)

    def velocity(self, state: PyTree) -> jax.Array:
        """Return the velocities ``(nv,)`` [rad/s or m/s]."""
        return state.qvel

    def with_velocity(self, state: PyTree, velocity: jax.Array) -> PyTree:
        """Return the data with other velocities ``(nv,)`` [rad/s or m/s]."""
        return state.replace(qvel=velocity)

    def law_values(self, params: PyTree) -> dict[str, jax.Array]:
        """Return the numbers that ``law`` needs; they may differ from copy to copy."""
        del params
        return {}

    # -- physics that runs elsewhere, see ``worlds.rollouts``

    def open_loop(self) -> MjModel:
        """Switch the node's physics off, and return the ``MjModel``; UsageError if a subclass overrides the step."""
        for name in ("step", "init_state", "init_output"):
            if getattr(type(self), name) is not getattr(MjxWorld, name):
                kind = type(self).__name__
                raise UsageError(
                    f"world {self.name!r}: {kind}.{name} overrides MjxWorld's, and may depend on the state"
                )
        self._apart = True
        return self.model

    def fields(self, params: MjxParams, state: PyTree) -> dict[str, jax.Array]:
        """Return the fields of the model that differ from the compiled one."""
        del state
        changes = {}
        old, new = (jax.tree_util.tree_flatten_with_path(m)[0] for m in (self._mjx_model, params.model))
        for (path, before), (_, after) in zip(old, new, strict=True):
            concrete = not isinstance(after, Tracer)
            if after is not before and not (concrete and np.array_equal(before, after)):
                changes[jax.tree_util.keystr(path).lstrip(".")] = after
        return changes

    def start(self, params: MjxParams, state: PyTree) -> Start:
        """Return where the physics starts."""
        del state
        return Start(jnp.asarray(params.qpos), jnp.asarray(params.qvel), jnp.zeros(self.model.nv))

    def controls(self, step_state: StepState) -> tuple[StepState, jax.Array]:
        """Return the step state, and the newest control of each physics step, ``(substeps, nu)`` or a law's input."""
        control = jnp.asarray(self._control(step_state), float)
        return step_state, jnp.broadcast_to(control, (self.substeps, *control.shape))

    def message(self, state: PyTree, qpos: jax.Array, qvel: jax.Array, qacc: jax.Array) -> MjxState:
        """Return the world's message.

        Args:
            qpos: Positions ``(nq,)`` [m or rad].
            qvel: Velocities ``(nv,)`` [m/s or rad/s].
        """
        del state, qacc
        return MjxState(qpos, qvel)

    def _control(self, step_state: StepState) -> jax.Array:
        """Return the controls ``(nu,)`` of a tick; they may depend on its inputs and on parameters."""
        return getattr(step_state.inputs[self.input_name].data, self.field)[-1]
