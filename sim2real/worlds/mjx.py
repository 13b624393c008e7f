"""Worlds on MJX, MuJoCo in JAX."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from sim2real.composer.mjx import gate, stepping, warp
from sim2real.composer.mjx.import_mjx import mjx
from sim2real.errors import UsageError
from sim2real.graph.base import Base, GraphState, StepState
from sim2real.graph.node import BaseWorld


@struct.dataclass
class MjxParams(Base):
    """Parameters of an MJX world; each copy of a graph may have its own.

    Attributes:
        model: The MJX model.
        qpos: Shape ``(nq,)``: positions at the start of an episode [rad or m].
        qvel: Shape ``(nv,)``: velocities at the start [rad/s or m/s].
    """

    model: Any
    qpos: Any
    qvel: Any


@struct.dataclass
class MjxState(Base):
    """The world's output.

    Attributes:
        qpos: Shape ``(nq,)``: positions [rad or m].
        qvel: Shape ``(nv,)``: velocities [rad/s or m/s].
    """

    qpos: Any
    qvel: Any


class MjxWorld(BaseWorld):
    """A MuJoCo model that ticks in MJX; its controls come from one input.

    Args:
        name: Unique in the graph.
        rate: Ticks per second [Hz]; a tick is a whole number of the model's time steps.
        model: The model.
        command: Name of the input that carries the controls.
        field: Field of that input's message: shape ``(nu,)`` [the actuators' unit].
        color: Colour in drawings.
        order: Place in drawings.
        impl: ``"jax"``, or ``"warp"``: MuJoCo Warp, in single precision and without derivatives.
        nconmax: On Warp: contacts that there is room for, times the number of copies, which share it; default: a guess.
        njmax: On Warp: rows of constraints that there is room for in each copy; default: a guess.

    Raises:
        UsageError: When the tick is no whole number of time steps, or the model asks for what MJX does otherwise:
            delays of its own (ignored or misplaced there; they belong to the graph), the no-slip solver, an integrator
            that it does not have, springs without dampers; or when Warp cannot be had.
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
        *,
        impl: str = "jax",
        nconmax: int | None = None,
        njmax: int | None = None,
    ) -> None:
        super().__init__(name, rate, color=color, order=order)
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
            self._warp = warp.make_engine(model, impl, nconmax, njmax)
        except UsageError as error:
            raise UsageError(f"world {name!r}: {error.args[0]}", hint=error.hint) from None
        self._engine: Any = self._warp or stepping
        self._mjx_model: Any = self._warp.model if self._warp else mjx.put_model(model, impl="jax")

    def init_params(self, rng: Any = None, graph_state: GraphState | None = None) -> MjxParams:
        """Return the model and its reference position at rest."""
        del rng, graph_state
        return MjxParams(self._mjx_model, jnp.asarray(self.model.qpos0, jnp.float32), jnp.zeros(self.model.nv))

    def init_state(self, rng: Any = None, graph_state: GraphState | None = None) -> Any:
        """Return MJX data at the parameters' start."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        start: Any = self._warp.start if self._warp else mjx.make_data(self.model, impl="jax")
        return self._engine.forward(params.model, start.replace(qpos=params.qpos, qvel=params.qvel))

    def init_output(self, rng: Any = None, graph_state: GraphState | None = None) -> MjxState:
        """Return positions and velocities at the start."""
        params = (graph_state or GraphState()).params.get(self.name) or self.init_params(rng)
        return MjxState(jnp.asarray(params.qpos, jnp.float32), jnp.asarray(params.qvel, jnp.float32))

    def step(self, step_state: StepState) -> tuple[StepState, MjxState]:
        """Integrate over one tick under the newest control."""
        model, advance = step_state.params.model, self._engine.advance
        data = step_state.state.replace(ctrl=jnp.asarray(self._control(step_state), jnp.float32))
        if self.substeps == 1:
            data = advance(model, data, legacy=False)
        else:
            data, _ = jax.lax.scan(lambda d, _: (advance(model, d, legacy=False), None), data, length=self.substeps)
        new = step_state.replace(state=data)
        return new, MjxState(data.qpos, data.qvel)

    def _control(self, step_state: StepState) -> Any:
        return getattr(step_state.inputs[self.input_name].data, self.field)[-1]
