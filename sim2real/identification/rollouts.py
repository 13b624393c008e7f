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
_ON_C, _COMPILED, _ACCELERATED = {1: (4, 24, 48, 128, 512)}, {1: (32,), 4: (32,)}, {1: (32, 1024), 4: (32, 1024)}
"""Copies of a segment in a row -> numbers of rows in one call of a program, each of which is a program: on C, compiled
for a CPU, and compiled for another device.

On C, a Jacobian of 20 logs took 24 s of processor time with at most 128 copies, 18 s with 512. Compiled, the copies in
a row share timing and messages, and a CPU's cache holds what 128 copies need: an arm's rollouts took 0.65 s instead of
1.23 s with 1,024 copies of any segments.
"""
_STARTS = 24
"""Initial states are computed in multiples of this number, so that few programs are compiled."""
_MANY = 256
"""Copies from which on rows are worth a program of their own."""


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
        """Return what MuJoCo's C functions need to simulate an episode; traceable."""
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
        found = np.empty((len(segment), data.ts.shape[1], len(self.fields)))
        rows, sizes = self._side_by_side(segment)
        most = sizes[-1] if len(rows) > 2 * sizes[-1] or len(sizes) == 1 else sizes[-2]
        for first in range(0, len(rows), most):
            copies = rows[first : first + most]
            count = len(copies)
            arguments = ({n: v[copies] for n, v in values.items()}, segment[copies[:, 0]], shift[copies] * self.prior)
            arguments = padded(_single(arguments), next(size for size in sizes if count <= size))
            if self._on_c is None:
                errors = self._program("errors", self._compared_graph)(*arguments, data)
            else:
                before = self._program("inputs", self._physics_inputs)
                inputs = jax.tree_util.tree_map(lambda a, n=count: np.asarray(a)[:n], before(*arguments, data))
                moved = padded(_single(self._on_c.step(inputs)), len(arguments[1]))
                errors = self._program("errors", self._compared_on_c, 0)(*arguments, data, moved)
            found[copies] = np.asarray(errors)[:count]
        return found

    def _side_by_side(self, segment: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
        """Return rows ``(R, width)`` of copies of one segment each, and the numbers of rows that have a program.

        A row that has fewer copies repeats its last one.
        """
        on_cpu = jax.default_backend() == "cpu"
        sizes: Mapping[int, tuple[int, ...]] = _ON_C if self._on_c else _COMPILED if on_cpu else _ACCELERATED
        counts, few = np.bincount(segment), len(segment) < _MANY
        width = 1 if few else max(w for w in sizes if w <= max(1, counts.max()))
        ends, padded_counts = np.cumsum(counts), -(-counts // width) * width
        # Number the places of each segment in its rows, and take its last copy where there is none left.
        places = np.arange(padded_counts.sum()) - np.repeat(np.cumsum(padded_counts) - padded_counts, padded_counts)
        taken = np.minimum(places + np.repeat(ends - counts, padded_counts), np.repeat(ends, padded_counts) - 1)
        return np.argsort(segment, kind="stable")[taken].reshape(-1, width), sizes[width]

    def starts(
        self, values: Mapping[str, np.ndarray], segment: np.ndarray, shift: np.ndarray, data: Data
    ) -> np.ndarray:
        """Return initial states ``(N, 2 * channels)``: positions, then velocities; arguments as in ``errors``."""
        program = self._program("starts", lambda v, e, s, data: self._started(v, e, s, data)[1])
        size = -(-len(segment) // _STARTS) * _STARTS
        copies = {n: v[:, None] for n, v in values.items()}, segment, (shift * self.prior)[:, None]
        return np.asarray(program(*padded(_single(copies), size), data), np.float64)[: len(segment), 0]

    def _program(self, name: str, function: Callable[..., PyTree], *more: int) -> Any:
        """Return the program of rows of copies, whose further arguments are those of each copy."""
        if name not in self.programs:
            in_row = jax.vmap(function, (0, None, 0, None, *more))
            self.programs[name] = jitted(jax.vmap(in_row, (0, 0, 0, None, *more)))
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

    def _compared_on_c(self, values: Mapping[str, Array], eps: Array, shift: Array, data: Data, moved: PyTree) -> Array:
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
