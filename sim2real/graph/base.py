"""What a node sees when it steps, and what a graph carries between steps."""

from __future__ import annotations

import dataclasses
import operator
from typing import Any, Self, TypeVar, cast

import jax
from flax import struct

T = TypeVar("T", bound="Base")


class Base:
    """Arithmetic, indexing and ``replace`` for a flax dataclass.

    ``a + b``, ``a * 2.0`` and the like act leaf by leaf; the other operand is a tree of the same structure or a scalar.
    ``a[i]`` indexes the leading axis of every leaf.
    """

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values in some fields."""
        # flax gives each of its dataclasses this very method, where no type checker sees it.
        return dataclasses.replace(cast(Any, self), **changes)

    def _map(self: T, op: Any, other: Any) -> T:
        same = jax.tree_util.tree_structure(self) == jax.tree_util.tree_structure(other)
        if same:
            return jax.tree_util.tree_map(op, self, other)
        return jax.tree_util.tree_map(lambda leaf: op(leaf, other), self)

    def __add__(self: T, other: Any) -> T:
        return self._map(operator.add, other)

    def __sub__(self: T, other: Any) -> T:
        return self._map(operator.sub, other)

    def __mul__(self: T, other: Any) -> T:
        return self._map(operator.mul, other)

    def __truediv__(self: T, other: Any) -> T:
        return self._map(operator.truediv, other)

    def __neg__(self: T) -> T:
        return jax.tree_util.tree_map(operator.neg, self)

    def __getitem__(self: T, index: Any) -> T:
        return jax.tree_util.tree_map(lambda leaf: leaf[index], self)


@struct.dataclass
class Empty(Base):
    """No parameters, no state or no output."""


@struct.dataclass
class InputState(Base):
    """The last W consumed messages of one input, oldest first.

    Attributes:
        seq: Shape ``(W,)``, int32: the sender's step that made each message; -1 marks an empty slot.
        ts_sent: Shape ``(W,)``: when each message was sent [s from the episode's start]; 0 in an empty slot.
        ts_recv: Shape ``(W,)``: when each message was received [s].
        data: The messages; leaves of shape ``(W, ...)``.
        delay_dist: The connection's ``TrainableDist``, None if its delay is not trainable; indexing leaves it whole.
    """

    seq: Any
    ts_sent: Any
    ts_recv: Any
    data: Any
    delay_dist: Any = None

    def __getitem__(self, index: Any) -> InputState:
        take = jax.tree_util.tree_map(lambda leaf: leaf[index], (self.seq, self.ts_sent, self.ts_recv, self.data))
        return InputState(*take, delay_dist=self.delay_dist)


@struct.dataclass
class StepState(Base):
    """Everything that ``BaseNode.step`` may read and replace.

    Attributes:
        rng: The node's JAX key; a step that uses it splits it and returns the new one.
        state: The node's state.
        params: The node's parameters.
        inputs: Input name -> InputState.
        eps: int32: index of the timeline that is played.
        seq: int32: number of this step of the node, from 0.
        ts: float32: when the step started [s from the episode's start].
    """

    rng: Any = None
    state: Any = None
    params: Any = None
    inputs: Any = struct.field(default_factory=dict)
    eps: Any = 0
    seq: Any = 0
    ts: Any = 0.0


@struct.dataclass
class GraphState(Base):
    """The state of a whole graph; dictionaries are keyed by node name.

    Attributes:
        eps: int32: index of the timeline that is played.
        step: int32: position in the timeline: the row in a compiled graph, the supervisor's step elsewhere; -1 before
            the start.
        rng: JAX keys.
        params: Parameters.
        state: States.
        seq: int32: number of steps that each node has made. In a compiled graph it is empty, except after ``reset``,
            ``step`` and ``observe``: then it has the number of the supervisor's step that the caller makes next.
        delays: Node -> input name -> trainable delay, for the connections that have one.
        buffer: The last outputs of each node, oldest first; compiled graphs only.
        aux: For the user; the graph passes it on unchanged.
    """

    eps: Any = 0
    step: Any = -1
    rng: Any = struct.field(default_factory=dict)
    params: Any = struct.field(default_factory=dict)
    state: Any = struct.field(default_factory=dict)
    seq: Any = struct.field(default_factory=dict)
    delays: Any = struct.field(default_factory=dict)
    buffer: Any = struct.field(default_factory=dict)
    aux: Any = struct.field(default_factory=dict)
