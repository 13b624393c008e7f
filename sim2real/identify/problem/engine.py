"""The engine of rollouts: the graph's program, or C MuJoCo between two programs without physics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode, BaseWorld
from sim2real.installation import has_jax
from sim2real.later import jax, jnp
from sim2real.runtime.compiled.open_loop import OpenLoopGraph, Tables
from sim2real.types import Array, MjModel, PyTree
from sim2real.worlds.rollouts import OpenLoop, Rollouts, Start, StepLaw

_NEEDED = ("open_loop", "fields", "start", "controls", "message")


@dataclass(frozen=True)
class Choice:
    """The selected engine.

    Attributes:
        why: The reason, as text.
    """

    name: Literal["c", "compiled"]
    why: str
    model: Any = None

    def __str__(self) -> str:
        """Return engine and reason in one line."""
        return f"{'C MuJoCo' if self.name == 'c' else 'compiled'}: {self.why}"


def choose(
    wanted: str, nodes: Mapping[str, BaseNode], messages: Mapping[str, PyTree], jacobian: str = "auto"
) -> Choice:
    """Choose an engine, and take the physics out of the world if it is C.

    Args:
        wanted: ``auto``, ``c`` or ``compiled``.
        jacobian: Kind of derivatives; only programs differentiate forward.
    """
    if wanted == "compiled":
        return Choice("compiled", "requested")
    # C needs a world of MuJoCo that runs without feedback, and no forward mode.
    try:
        if jacobian == "forward":
            raise UsageError("derivatives are taken in forward mode, which C MuJoCo does not have")
        world = _world(nodes, messages)
        model = world.open_loop()
    except UsageError as error:
        if wanted == "c":
            hint = error.hint or "take --engine compiled, or auto"
            raise UsageError(f"engine c: {error.args[0]}", hint=hint) from None
        return Choice("compiled", error.args[0])
    return Choice("c", "requested" if wanted == "c" else "the world is MuJoCo's", model)


def _world(nodes: Mapping[str, BaseNode], messages: Mapping[str, PyTree]) -> PyTree:
    worlds = [n for n in nodes.values() if isinstance(n, BaseWorld)]
    if len(worlds) != 1 or not all(hasattr(worlds[0], n) for n in _NEEDED):
        names = ", ".join(f"{n.name!r} ({type(n).__name__})" for n in worlds) or "there is none"
        raise UsageError(f"the world is not one of MuJoCo's: {names}")
    live = [c.output_node.name for c in worlds[0].inputs.values() if c.output_node.name not in messages]
    if live:
        raise UsageError(f"the world {worlds[0].name!r} has the input {live[0]!r}, which is not recorded")
    return worlds[0]


class Outside(NamedTuple):
    """Inputs of C MuJoCo for a rollout.

    Attributes:
        fields: Fields of the model that differ from the compiled one.
        start: Initial state of the physics.
        controls: Shape ``(ticks, substeps, nu)``, or the inputs of the law.
        law: Parameters of the law.
    """

    fields: Mapping[str, PyTree]
    start: Start
    controls: PyTree
    law: Mapping[str, PyTree]


def _swapped(rows: Array) -> Array:
    """Return rows of a graph with copies before time, or the other way; those of a program have no copies."""
    return rows if has_jax() else np.swapaxes(rows, 0, 1)


class CRollouts:
    """Rolls a graph's recorded commands out on C MuJoCo.

    One program computes the world's inputs in each tick, with their delays and averages. C steps all copies, each with
    its own parameters. A second program computes the sensor's outputs from the world's messages.
    """

    def __init__(self, graph: OpenLoopGraph, model: MjModel) -> None:
        self._graph, self._model = graph, model
        self._world: OpenLoop = graph.nodes[graph.world or ""]  # pyright: ignore[reportAttributeAccessIssue]
        self._law: StepLaw | None = getattr(self._world, "law", None)
        self._rollouts: dict[tuple[str, ...], Rollouts] = {}

    def inputs(
        self, gs: GraphState, params: Mapping[str, PyTree], tables: Tables, messages: Mapping[str, PyTree]
    ) -> Outside:
        """Return the inputs of C for an episode; traceable."""
        world = self._world
        state, world_params = gs.state[world.name], params[world.name]
        law = world.law_values(world_params) if self._law else {}  # pyright: ignore[reportAttributeAccessIssue]
        controls = _swapped(self._graph.drive(gs, tables, messages, world.controls))
        return Outside(dict(world.fields(world_params, state)), world.start(world_params, state), controls, law)

    def step(self, inputs: Outside) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions, velocities and accelerations ``(..., 1 + ticks, n)`` of copies, rolled out on C."""
        names = tuple(sorted(inputs.fields))
        if names not in self._rollouts:
            world = self._world
            self._rollouts[names] = Rollouts(self._model, world.substeps, names, world.derives, self._law)
        return self._rollouts[names](inputs.fields, inputs.start, inputs.controls, inputs.law)

    def outputs(
        self, gs: GraphState, moved: PyTree, tables: Tables, messages: Mapping[str, PyTree], record: str
    ) -> PyTree:
        """Return a node's outputs in an episode, leaves ``(K, ...)``; traceable."""
        world = self._world
        state = gs.state[world.name]
        if not has_jax():
            known = {world.name: world.message(state, *map(_swapped, moved))}
            return pytree.map(_swapped, self._graph.run(gs, tables, messages, record, known))
        world_messages = jax.vmap(lambda *at: world.message(state, *at))(*moved)
        return self._graph.run(gs, tables, messages, record, {world.name: world_messages})

    def rollout(
        self, gs: GraphState, params: Mapping[str, PyTree], tables: Tables, messages: Mapping[str, PyTree], record: str
    ) -> PyTree:
        """Return a node's outputs in an episode by a callback to C; no compilation cache holds such a program."""
        inputs = self.inputs(gs, params, tables, messages)
        dtype, count = jnp.result_type(float), inputs.controls.shape[0]
        widths = (self._model.nq, self._model.nv, self._model.nv)
        shapes = tuple(jax.ShapeDtypeStruct((1 + count, n), dtype) for n in widths)

        def outside(messages: PyTree) -> tuple[np.ndarray, ...]:
            return tuple(a.astype(dtype) for a in self.step(jax.tree_util.tree_map(np.asarray, messages)))

        moved = jax.pure_callback(outside, shapes, inputs, vmap_method="expand_dims")
        return self.outputs(gs, moved, tables, messages, record)
