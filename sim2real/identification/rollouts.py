"""Residuals of segments for parameters and initial states, simulated by C MuJoCo or by the compiled graph.

``Rollouts.errors`` is all that identification asks of an engine; everything else is numpy on the host. Its programs get
the segments as an argument, so they depend on shapes alone, and copies are padded to few sizes: each compiles once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.identification.config import FitConfig
from sim2real.identification.model import CarriesPayload, IdentifiableModel
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.segments import Data, padded
from sim2real.runtime.compiled.open_loop import OpenLoopGraph, Tables
from sim2real.types import Array, MjModel, PyTree, Scalar
from sim2real.worlds import rollouts as physics

_NEEDED = ("open_loop", "fields", "start", "controls", "message")
_ON_C, _COMPILED = (4, 24, 48, 128, 512), (32, 256, 1024)
"""Numbers of copies in one call of a program, on C and compiled; each number is a program. On C, a Jacobian of 20 logs
took 24 s of processor time with at most 128 copies, 18 s with 512.
"""


@dataclass(frozen=True)
class Engine:
    """The selected engine.

    Attributes:
        why: The reason, as text.
        model: C MuJoCo's model.
    """

    name: Literal["c", "compiled"]
    why: str
    model: Any = None

    def __str__(self) -> str:
        """Return engine and reason in one line."""
        return f"{'C MuJoCo' if self.name == 'c' else 'compiled'}: {self.why}"


def choose_engine(wanted: str, nodes: Mapping[str, BaseNode], messages: Mapping[str, PyTree]) -> Engine:
    """Choose an engine; for C, the physics is taken out of the world.

    Args:
        wanted: ``auto``, ``c`` or ``compiled``.
        messages: Node -> its recorded messages.

    Raises:
        UsageError: C is wanted, and the world cannot run on it.
    """
    if wanted == "compiled":
        return Engine("compiled", "requested")
    try:
        model = _open_loop_world(nodes, messages).open_loop()
    except UsageError as error:
        if wanted == "c":
            hint = error.hint or "take --engine compiled, or auto"
            raise UsageError(f"engine c: {error.args[0]}", hint=hint) from None
        return Engine("compiled", error.args[0])
    return Engine("c", "requested" if wanted == "c" else "the world is MuJoCo's", model)


def _open_loop_world(nodes: Mapping[str, BaseNode], messages: Mapping[str, PyTree]) -> PyTree:
    worlds = [n for n in nodes.values() if isinstance(n, BaseWorld)]
    if len(worlds) != 1 or not all(hasattr(worlds[0], n) for n in _NEEDED):
        names = ", ".join(f"{n.name!r} ({type(n).__name__})" for n in worlds) or "there is none"
        raise UsageError(f"the world is not one of MuJoCo's: {names}")
    live = [c.output_node.name for c in worlds[0].inputs.values() if c.output_node.name not in messages]
    if live:
        raise UsageError(f"the world {worlds[0].name!r} has the input {live[0]!r}, which is not recorded")
    return worlds[0]


def jitted(function: Callable[..., PyTree]) -> Any:
    """Return a function that XLA compiles.

    On a CPU, XLA's fusion emitters are off (jaxlib 0.10), as programs that run for seconds then need half the time.
    """
    old = jax.default_backend() == "cpu" and jax.__version__.startswith("0.10.")
    return jax.jit(function, compiler_options={"xla_cpu_use_fusion_emitters": False} if old else None)


class PhysicsInputs(NamedTuple):
    """What C MuJoCo needs for a rollout.

    Attributes:
        fields: Fields of the model that differ from the compiled one.
        start: Initial state of the physics.
        controls: Shape ``(ticks, substeps, nu)``, or the inputs of the law.
        law: Parameters of the law.
    """

    fields: Mapping[str, PyTree]
    start: physics.Start
    controls: PyTree
    law: Mapping[str, PyTree]


class GraphOnC:
    """A graph whose physics runs on C MuJoCo, between two programs.

    The first program computes the world's inputs in each tick, with their delays and averages. C steps all copies, each
    with its own parameters. The second program computes the sensor's outputs from the world's messages.
    """

    def __init__(self, graph: OpenLoopGraph, model: MjModel) -> None:
        self._graph, self._model = graph, model
        self._world: Any = graph.nodes[graph.world or ""]
        self._law: physics.StepLaw | None = getattr(self._world, "law", None)
        self._steppers: dict[tuple[str, ...], physics.Rollouts] = {}

    def inputs(
        self, gs: GraphState, params: Mapping[str, PyTree], tables: Tables, messages: Mapping[str, PyTree]
    ) -> PhysicsInputs:
        """Return the inputs of C for an episode; traceable."""
        world = self._world
        state, world_params = gs.state[world.name], params[world.name]
        law = world.law_values(world_params) if self._law else {}
        controls = self._graph.drive(gs, tables, messages, world.controls)
        return PhysicsInputs(dict(world.fields(world_params, state)), world.start(world_params, state), controls, law)

    def step(self, inputs: PhysicsInputs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, velocities and accelerations ``(..., 1 + ticks, n)`` of copies, rolled out on C."""
        names = tuple(sorted(inputs.fields))
        if names not in self._steppers:
            world = self._world
            self._steppers[names] = physics.Rollouts(self._model, world.substeps, names, world.derives, self._law)
        return self._steppers[names](inputs.fields, inputs.start, inputs.controls, inputs.law)

    def outputs(
        self, gs: GraphState, moved: PyTree, tables: Tables, messages: Mapping[str, PyTree], record: str
    ) -> PyTree:
        """Return a node's outputs in an episode, leaves ``(K, ...)``; traceable.

        Args:
            moved: What ``step`` returned for this episode.
        """
        world = self._world
        sent = jax.vmap(lambda *at: world.message(gs.state[world.name], *at))(*moved)
        return self._graph.run(gs, tables, messages, record, {world.name: sent})


class Rollouts:
    """Simulates segments with the recorded commands and timing.

    Attributes:
        prior: Shape ``(2 * channels,)``: standard deviation of the prior of an initial state around the state that the
            log shows. It is wide: with a narrow prior, the bias of that state would seem to separate the delays.
        fields: The columns of the residuals: field, deviation, and a function that takes the channel's entry.
        programs: The compiled programs by name; all problems of a model share them.
    """

    def __init__(
        self,
        model: IdentifiableModel,
        nodes: Mapping[str, BaseNode],
        table: ParameterTable,
        config: FitConfig,
        engine: Engine,
    ) -> None:
        self.model, self.table, self.config, self.engine = model, table, config, engine
        self.graph = OpenLoopGraph(nodes, model.sensor, model.given)
        self._on_c = GraphOnC(self.graph, engine.model) if engine.name == "c" else None
        sigmas = [c.position_sigma for c in model.channels] + [c.velocity_sigma for c in model.channels]
        self.prior = 30.0 * np.array(sigmas, np.float64)
        self.fields = [(field, sigma, c.of) for c in model.channels for field, sigma in c.fields]
        self.programs: dict[str, Any] = {}
        self._late = [p.name for p in table if p.side == "measurement"]

    def errors(
        self,
        values: Mapping[str, np.ndarray],
        segment: np.ndarray,
        shift: np.ndarray,
        data: Data,
    ) -> np.ndarray:
        """Return prediction minus measurement ``(N, K, F)``, in standard deviations; 0 where none is compared.

        Args:
            values: Parameters by name, ``(N, ...)``.
            segment: Shape ``(N,)``: numbers of the segments.
            shift: Shape ``(N, 2 * channels)``: distance of the initial state from the state that the log shows, in
                units of ``prior``.
        """
        sizes = _ON_C if self._on_c else _COMPILED
        found = np.empty((len(segment), data.ts.shape[1], len(self.fields)))
        most = sizes[-1] if len(segment) > 2 * sizes[-1] else sizes[-2]
        for first in range(0, len(segment), most):
            rows = slice(first, first + most)
            count = len(segment[rows])
            arguments = ({n: v[rows] for n, v in values.items()}, segment[rows], shift[rows] * self.prior)
            copies = padded(_single(arguments), next(size for size in sizes if count <= size))
            if self._on_c is None:
                program = self._program("errors", self._compared_graph, (0, 0, 0, None))
                errors = program(*copies, data)
            else:
                before = self._program("inputs", self._physics_inputs, (0, 0, 0, None))
                inputs = jax.tree_util.tree_map(lambda a, n=count: np.asarray(a)[:n], before(*copies, data))
                moved = padded(_single(self._on_c.step(inputs)), len(copies[1]))
                errors = self._program("errors", self._compared_on_c, (0, 0, 0, 0, None))(*copies, moved, data)
            found[rows] = np.asarray(errors)[:count]
        return found

    def starts(
        self, values: Mapping[str, np.ndarray], segment: np.ndarray, shift: np.ndarray, data: Data
    ) -> np.ndarray:
        """Return initial states ``(N, 2 * channels)``: positions, then velocities; arguments as in ``errors``."""
        program = self._program("starts", lambda v, e, s, data: self._started(v, e, s, data)[1], (0, 0, 0, None))
        size = -(-len(segment) // _ON_C[1]) * _ON_C[1]
        copies = padded(_single((dict(values), segment, shift * self.prior)), size)
        return np.asarray(program(*copies, data), np.float64)[: len(segment)]

    def _program(self, name: str, function: Callable[..., PyTree], axes: tuple[int | None, ...]) -> Any:
        if name not in self.programs:
            self.programs[name] = jitted(jax.vmap(function, axes))
        return self.programs[name]

    # -- one copy, traced

    def _started(
        self, values: Mapping[str, Array], eps: Array, shift: Array, data: Data
    ) -> tuple[dict[str, PyTree], jax.Array]:
        """Return the nodes' parameters, and the initial state of a segment."""
        return dict(values), self._estimated_start(eps, sum(values[n] for n in self._late), data) + shift

    def _estimated_start(self, eps: Array, delay_s: Scalar, data: Data) -> jax.Array:
        """Return the initial state ``(2 * channels,)`` from samples around the start, which are ``delay_s`` late."""
        cubic = jnp.moveaxis(data.starts[eps], -1, 0)
        if self.config.initial_state == "rest":
            return jnp.concatenate([cubic[0], jnp.zeros_like(cubic[0])], axis=-1)
        t = jnp.asarray(delay_s, jnp.float32)[..., None]
        position = cubic[0] + t * (cubic[1] + t * (cubic[2] + t * cubic[3]))
        velocity = cubic[1] + t * (2 * cubic[2] + t * 3 * cubic[3])
        return jnp.concatenate([position, velocity], axis=-1)

    def _begun(
        self, values: Mapping[str, Array], eps: Array, shift: Array, data: Data
    ) -> tuple[dict[str, PyTree], GraphState, PyTree, PyTree]:
        """Return parameters of the nodes, first state, timing and commands of a segment."""
        values_, start = self._started(values, eps, shift, data)
        tables, messages = jax.tree_util.tree_map(lambda rows: rows[eps], (data.tables, data.messages))
        first = jax.tree_util.tree_map(lambda rows: rows[0], messages)
        params = self.model.params(values_, start)
        if isinstance(self.model, CarriesPayload):
            params = self.model.loaded(params, first)
        # Assume that the first recorded command also held before it was recorded.
        return params, self.graph.begin(params, first, jnp.asarray(eps, jnp.int32)), tables, messages

    def _physics_inputs(self, values: Mapping[str, Array], eps: Array, shift: Array, data: Data) -> PhysicsInputs:
        params, gs, tables, messages = self._begun(values, eps, shift, data)
        return self._c.inputs(gs, params, tables, messages)

    def _compared_on_c(self, values: Mapping[str, Array], eps: Array, shift: Array, moved: PyTree, data: Data) -> Array:
        _, gs, tables, messages = self._begun(values, eps, shift, data)
        return self._compared(self._c.outputs(gs, moved, tables, messages, self.model.sensor), eps, data)

    def _compared_graph(self, values: Mapping[str, Array], eps: Array, shift: Array, data: Data) -> Array:
        _, gs, tables, messages = self._begun(values, eps, shift, data)
        return self._compared(self.graph.run(gs, tables, messages, self.model.sensor), eps, data)

    def _compared(self, predicted: PyTree, eps: Array, data: Data) -> Array:
        counts, columns = data.ts[eps] >= 0.0, []
        for field, sigma, entry in self.fields:
            error = entry(getattr(predicted, field)) - entry(data.measured[field][eps])
            columns.append(jnp.where(counts, error / sigma, 0.0))
        return jnp.stack(columns, axis=-1)

    @property
    def _c(self) -> GraphOnC:
        if self._on_c is None:
            raise UsageError(f"the engine is not C MuJoCo: {self.engine}")
        return self._on_c


def _single(tree: PyTree) -> PyTree:
    """Return arrays of single precision, and of 32-bit integers."""
    return jax.tree_util.tree_map(
        lambda a: np.asarray(a, np.int32 if np.issubdtype(np.asarray(a).dtype, np.integer) else np.float32), tree
    )
