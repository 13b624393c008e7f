"""The data that one node's steps read and replace in an episode, on either clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.node import TICKS_PER_S, BaseNode, Connection
from sim2real.graph.windows import EMPTY_AGE_S
from sim2real.runtime.init import default_output
from sim2real.types import PyTree

if TYPE_CHECKING:
    from sim2real.graph.base import Array
    from sim2real.graph.delays import DelayDistribution


class Message(NamedTuple):
    """A message that was sent; times in ticks [us], ``leaves`` as ``Format.pack`` returns them."""

    seq: int
    sent: int
    received: int
    leaves: list[np.ndarray]


class Format:
    """The structure, shapes and dtypes of a node's output: those of its default output.

    Args:
        default: The default output.
    """

    def __init__(self, node: str, default: PyTree) -> None:
        self.node = node
        leaves, self.tree = pytree.flatten(default)
        self.default = [np.asarray(leaf) for leaf in leaves]

    def pack(self, output: PyTree) -> list[np.ndarray]:
        """Return copies of an output's leaves, as arrays that the node cannot change any more.

        Raises:
            UsageError: Structure, shapes or dtypes differ from those of the default output.
        """
        leaves, tree = pytree.flatten(output)
        if tree != self.tree:
            raise self._differs(f"{tree}, not {self.tree}")
        arrays = [np.array(leaf) for leaf in leaves]
        for i, (array, like) in enumerate(zip(arrays, self.default, strict=True)):
            if array.shape != like.shape or not np.can_cast(array.dtype, like.dtype, "same_kind"):
                raise self._differs(f"a leaf {array.dtype}{array.shape}, not {like.dtype}{like.shape}")
            arrays[i] = array.astype(like.dtype, copy=False)
            if array.dtype.kind in "iu" and array.dtype != like.dtype and not np.array_equal(array, arrays[i]):
                raise self._differs(f"{array.tolist()}, which does not fit into {like.dtype}")
        return arrays

    def unpack(self, leaves: Sequence[Array]) -> PyTree:
        """Return the output that has these leaves."""
        return pytree.unflatten(self.tree, leaves)

    def _differs(self, how: str) -> UsageError:
        return UsageError(
            f"node {self.node!r}: an output differs from the default output: it has {how}",
            hint="return the same fields, shapes and dtypes from step and init_output",
        )


class Window:
    """The last messages that one input consumed.

    New messages make new arrays, and arrays are never overwritten: a step may keep its inputs, and JAX may use the
    memory of a numpy argument without copying it.

    Args:
        delay_dist: The trainable delay that steps see in ``InputState.delay_dist``, or None.
    """

    def __init__(self, connection: Connection, form: Format, size: int, delay_dist: DelayDistribution | None) -> None:
        self.connection, self.size, self._form, self._dist = connection, size, form, delay_dist
        self._leaves = [np.broadcast_to(d, (size, *d.shape)).copy() for d in form.default]
        self._seq = np.full(size, -1, np.int32)
        self.sent = np.zeros(size, np.int64)
        self._received = np.zeros(size, np.int64)
        self.state = self._build()

    def push(self, messages: Sequence[Message]) -> None:
        """Append consumed messages, oldest first."""
        last = messages[-self.size :]
        if not last:
            return
        self._seq = _shift(self._seq, [m.seq for m in last])
        self.sent = _shift(self.sent, [m.sent for m in last])
        self._received = _shift(self._received, [m.received for m in last])
        self._leaves = [_shift(old, [m.leaves[i] for m in last]) for i, old in enumerate(self._leaves)]
        self.state = self._build()

    def ages(self, tick: int) -> np.ndarray:
        """Return how long before ``tick`` each message was sent [s], shape ``(size,)``; large in empty slots."""
        ages = ((tick - self.sent) / TICKS_PER_S).astype(np.float32)
        return np.where(self._seq >= 0, ages, np.float32(EMPTY_AGE_S))

    def _build(self) -> InputState:
        sent, received = (_seconds(t) for t in (self.sent, self._received))
        return InputState(self._seq, sent, received, self._form.unpack(self._leaves), self._dist)


class NodeData:
    """The windows, random key, parameters and state of one node.

    Args:
        emulate_delays: Whether trainable delays are applied to the windows, which are then longer. False on the wall
            clock, where the messages' delays are real.

    Attributes:
        carried: ``(rng, params, state, number of steps)``; replaced as a whole, so other threads can read it any time.
    """

    def __init__(self, node: BaseNode, graph_state: GraphState, emulate_delays: bool) -> None:
        self.node = node
        self.form = Format(node.name, default_output(graph_state, node.name))
        self.windows: dict[str, Window] = {}
        self._eps = np.int32(graph_state.eps)
        self._emulated = [n for n, c in node.inputs.items() if c.trainable and emulate_delays]
        # One window for each input, long enough for emulated delays.
        for name, c in node.inputs.items():
            sender = c.output_node.name
            form = Format(sender, default_output(graph_state, sender))
            dist = graph_state.delays.get(node.name, {}).get(name, c.delay_dist) if c.trainable else None
            size = c.total_window if name in self._emulated else c.window
            self.windows[name] = Window(c, form, size, dist)
        try:
            # The random numbers, parameters and state at the start.
            parts = [getattr(graph_state, field)[node.name] for field in ("rng", "params", "state")]
        except KeyError:
            raise UsageError(
                f"the graph state has nothing for node {node.name!r}", hint="make graph states with init()"
            ) from None
        self.carried: tuple[PyTree, PyTree, PyTree, int] = (parts[0], parts[1], parts[2], 0)

    def step_state(self, seq: int, tick: int) -> StepState:
        """Return the step state of step ``seq``, which starts at ``tick``."""
        rng, params, state, _ = self.carried
        inputs = {name: window.state for name, window in self.windows.items()}
        ts = np.float32(tick / TICKS_PER_S)
        return StepState(rng, state, params, inputs, self._eps, np.int32(seq), ts)

    def ages(self, tick: int) -> dict[str, np.ndarray]:
        """Return the ages of the messages, for inputs with a trainable delay that is applied; see ``Window.ages``."""
        return {name: self.windows[name].ages(tick) for name in self._emulated}

    def keep(self, changed: dict[str, PyTree]) -> None:
        """Store the fields that a step replaced, and count the step."""
        rng, params, state, steps = self.carried
        self.carried = (changed.get("rng", rng), changed.get("params", params), changed.get("state", state), steps + 1)


def snapshot(graph_state: GraphState, data: dict[str, NodeData], supervisor: str) -> GraphState:
    """Return the graph's state after the last finished step of each node."""
    carried = {name: d.carried for name, d in data.items()}
    return graph_state.replace(
        step=np.int32(carried[supervisor][3]),
        rng={n: c[0] for n, c in carried.items()},
        params={n: c[1] for n, c in carried.items()},
        state={n: c[2] for n, c in carried.items()},
        seq={n: np.int32(c[3]) for n, c in carried.items()},
    )


def _shift(old: np.ndarray, entries: Sequence[int | np.ndarray]) -> np.ndarray:
    """Return ``old`` with new entries at its end and as many dropped at its start; at most ``len(old)`` new ones."""
    out = np.empty_like(old)
    count = len(entries)
    out[: len(old) - count] = old[count:]
    for i, entry in enumerate(entries):
        out[len(old) - count + i] = entry
    return out


def _seconds(ticks: np.ndarray) -> np.ndarray:
    return (ticks / TICKS_PER_S).astype(np.float32)
