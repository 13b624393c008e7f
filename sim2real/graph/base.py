"""The step state of a node, and the state of a graph."""

from __future__ import annotations

import dataclasses
import operator
from typing import TYPE_CHECKING, Self, TypeAlias, TypeVar

from sim2real import pytree
from sim2real.types import PyTree

if TYPE_CHECKING:
    from collections.abc import Callable

    import jax
    import numpy as np

    Array: TypeAlias = jax.Array | np.ndarray
    """JAX's arrays in a compiled program, numpy's if nodes run on a clock."""
    Number: TypeAlias = Array | np.number | np.bool_ | float
    """A scalar of JAX, numpy or Python."""
    Value: TypeAlias = jax.Array | float
    """A quantity in a compiled program: one number, or an array with a number for each joint."""
else:
    Array = Number = Value = PyTree

T = TypeVar("T", bound="Base")


class Base:
    """Arithmetic, indexing and ``replace`` for a flax dataclass.

    ``a + b``, ``a * 2.0`` and the like act leaf by leaf; the other operand is a tree of the same structure or a scalar.
    ``a[i]`` indexes the leading axis of every leaf.
    """

    def replace(self, **changes: PyTree) -> Self:
        """Return a copy with other values in some fields."""
        # flax adds this method at run time; type checkers find it here.
        instance: PyTree = self
        return dataclasses.replace(instance, **changes)

    def _map(self: T, op: Callable[..., PyTree], other: PyTree) -> T:
        same = pytree.structure(self) == pytree.structure(other)
        if same:
            return pytree.map(op, self, other)
        return pytree.map(lambda leaf: op(leaf, other), self)

    def __add__(self: T, other: PyTree) -> T:
        return self._map(operator.add, other)

    def __sub__(self: T, other: PyTree) -> T:
        return self._map(operator.sub, other)

    def __mul__(self: T, other: PyTree) -> T:
        return self._map(operator.mul, other)

    def __truediv__(self: T, other: PyTree) -> T:
        return self._map(operator.truediv, other)

    def __neg__(self: T) -> T:
        return pytree.map(operator.neg, self)

    def __getitem__(self: T, index: PyTree) -> T:
        return pytree.map(lambda leaf: leaf[index], self)


@pytree.dataclass
class Empty(Base):
    """No parameters, no state or no output."""


@pytree.dataclass
class InputState(Base):
    """The last W consumed messages of one input, oldest first.

    Attributes:
        seq: Shape ``(W,)``, int32: number of the sender's step of each message; -1 marks an empty slot.
        ts_sent: Shape ``(W,)``: time at which each message was sent [s from the episode's start]; 0 in an empty slot.
        ts_recv: Shape ``(W,)``: time at which each message was received [s].
        data: The messages; leaves of shape ``(W, ...)``.
        delay_dist: The connection's ``TrainableDist``, None if its delay is not trainable; not indexed.
    """

    seq: Array
    ts_sent: Array
    ts_recv: Array
    data: PyTree
    delay_dist: PyTree = None

    def __getitem__(self, index: PyTree) -> InputState:
        take = pytree.map(lambda leaf: leaf[index], (self.seq, self.ts_sent, self.ts_recv, self.data))
        return InputState(*take, delay_dist=self.delay_dist)


@pytree.dataclass
class StepState(Base):
    """The data that ``BaseNode.step`` may read and replace.

    Attributes:
        rng: The node's JAX key; a step that uses it splits it and returns the new one.
        inputs: Input name -> InputState.
        eps: int32: index of the timeline that is played.
        seq: int32: number of this step of the node, from 0.
        ts: float32: start of the step [s from the episode's start].
    """

    rng: jax.Array | None = None
    state: PyTree = None
    params: PyTree = None
    inputs: dict[str, InputState] = pytree.field(default_factory=dict)
    eps: Number = 0
    seq: Number = 0
    ts: Number = 0.0


@pytree.dataclass
class GraphState(Base):
    """The state of a whole graph; dictionaries are keyed by node name.

    Attributes:
        eps: int32: index of the timeline that is played.
        step: int32: position in the timeline: the row in a compiled graph, the supervisor's step elsewhere; -1 before
            the start.
        seq: int32: each node's number of steps. In a compiled graph it is empty, except after ``reset``, ``step`` and
            ``observe``: then it has the number of the supervisor's step that the caller makes next.
        delays: Node -> input name -> trainable delay, for the connections that have one.
        buffer: The last outputs of each node, oldest first; compiled graphs only.
        aux: For the user; the graph passes it on unchanged.
    """

    eps: Number = 0
    step: Number = -1
    rng: dict[str, jax.Array] = pytree.field(default_factory=dict)
    params: dict[str, PyTree] = pytree.field(default_factory=dict)
    state: dict[str, PyTree] = pytree.field(default_factory=dict)
    seq: dict[str, Number] = pytree.field(default_factory=dict)
    delays: dict[str, dict[str, PyTree]] = pytree.field(default_factory=dict)
    buffer: dict[str, PyTree] = pytree.field(default_factory=dict)
    aux: dict[str, PyTree] = pytree.field(default_factory=dict)
