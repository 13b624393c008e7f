"""The steps of one node on either clock: their data, their calls and their checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from sim2real import pytree
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import TICKS_PER_S, BaseNode, Connection, to_ticks
from sim2real.graph.windows import EMPTY_AGE_S
from sim2real.installation import has_jax
from sim2real.later import jax, jnp
from sim2real.runtime.init import default_output
from sim2real.types import PyTree

if TYPE_CHECKING:
    from jax.core import ShapedArray
    from jax.typing import ArrayLike

    from sim2real.graph.base import Array, Number
    from sim2real.graph.delays import DelayDistribution

T = TypeVar("T")
_CARRIED = ("rng", "params", "state")


class Message(NamedTuple):
    """A message that was sent; times in ticks [us], ``leaves`` as ``Format.pack`` returns them."""

    seq: int
    sent: int
    received: int
    leaves: list[np.ndarray]


class Format:
    """The structure, shapes and dtypes of a node's outputs, taken from its default output.

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
        carried: ``(rng, params, state, number of steps)``; replaced as a whole, so that other threads can read it at
            any time.
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
        """Return the ages of the messages [s] of each input whose trainable delay is applied; see ``Window.ages``."""
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
    """Drop as many entries at the start of ``old`` as ``entries`` has, at most all, and append ``entries``."""
    out = np.empty_like(old)
    count = len(entries)
    out[: len(old) - count] = old[count:]
    for i, entry in enumerate(entries):
        out[len(old) - count + i] = entry
    return out


def _seconds(ticks: np.ndarray) -> np.ndarray:
    return (ticks / TICKS_PER_S).astype(np.float32)


class Result(NamedTuple):
    """The results of a step.

    Attributes:
        changed: Those of ``rng``, ``params`` and ``state`` that the step replaced.
        ts: The start that the step has set [s], or None.
        leaves: The output, as ``Format.pack`` returns it.
    """

    changed: dict[str, PyTree]
    ts: Number | None
    leaves: list[np.ndarray]


class Reply(NamedTuple):
    """The caller's answer to an offered step state.

    Attributes:
        step_state: The step state after the step; None: unchanged.
        leaves: The step's output, as ``Format.pack`` returns it; None: the node's ``step`` is called.
    """

    step_state: StepState | None = None
    leaves: list[np.ndarray] | None = None

    @property
    def autonomous(self) -> bool:
        """Whether the node's ``step`` is called with ``step_state``."""
        return self.leaves is None


class Stepper:
    """Runs the steps of one node in any number of episodes; compiles before the first."""

    def __init__(self, node: BaseNode) -> None:
        self.node = node
        self._compiled: jax.stages.Compiled | None = None
        self._signature: tuple[object, ...] | None = None

    def prepare(self, data: NodeData, jit: bool) -> None:
        """Compile the step for data of this form, unless it is compiled already; a step with side effects is not run.

        Args:
            jit: Whether to compile; nodes with ``jittable = False`` are never compiled.

        Raises:
            UsageError: The step's results do not have the form of the node's state or default output.
        """
        jit = jit and self.node.jittable
        arguments = (data.step_state(0, 0), data.ages(0))
        # Keep the compiled step while the types of its arguments stay the same.
        leaves, tree = pytree.flatten((arguments, data.form.default))
        signature = (jit, tree, [(np.shape(x), jnp.result_type(x)) for x in leaves] if jit else None)
        if signature == self._signature:
            return
        self._compiled = None
        # Compile the step, and call it once.
        if jit:
            default = data.form.unpack(data.form.default)

            def call(step_state: StepState, ages: Mapping[str, Array]) -> tuple[dict[str, PyTree], PyTree]:
                return self._matched(step_state, *self._call(step_state, ages), default)

            traced = jax.jit(call).trace(*arguments)
            self._compiled = traced.lower().compile()
            if not traced.jaxpr.effects:  # without side effects: call it once to fill caches, and drop the result
                jax.block_until_ready(self._compiled(*arguments))
        self._signature = signature

    def run(self, data: NodeData, step_state: StepState, ages: Mapping[str, np.ndarray]) -> Result:
        """Run one step and wait for its results.

        Args:
            ages: Input name -> ages of its messages [s], shape ``(W,)``, for inputs whose trainable delay is applied.
        """
        if self._compiled is not None:
            changed, output = jax.block_until_ready(self._compiled(step_state, dict(ages)))
            leaves = [np.asarray(leaf) for leaf in pytree.leaves(output)]
        else:
            if self.node.jittable:  # eager JAX: steps may use `.at[...]` on their inputs
                step_state = pytree.map(jnp.asarray, step_state)
            changed, output = self._call(step_state, ages)
            leaves = data.form.pack(output)
        return Result(changed, changed.pop("ts", None), leaves)

    def answer(self, data: NodeData, offered: StepState, ages: Mapping[str, np.ndarray], reply: Reply) -> Result:
        """Return the results of a step after the caller's reply; the node runs if the reply has no output."""
        before = {} if reply.step_state is None else _changed(offered, reply.step_state)
        if reply.leaves is not None:
            return Result(before, before.pop("ts", None), reply.leaves)
        result = self.run(data, reply.step_state or offered, ages)
        return Result({**before, **result.changed}, result.ts, result.leaves)

    def _call(self, step_state: StepState, ages: Mapping[str, Array]) -> tuple[dict[str, PyTree], PyTree]:
        result = self.node.step(_with_delays(self.node, step_state, ages))
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[0], StepState)):
            raise UsageError(
                f"node {self.node.name!r}: step returned {type(result).__name__}",
                hint="return the new step state and the output: `return step_state.replace(...), output`",
            )
        return _changed(step_state, result[0]), result[1]

    def _matched(
        self, before: StepState, changed: dict[str, PyTree], output: T, default: object
    ) -> tuple[dict[str, PyTree], T]:
        """Return a step's results in the dtypes of the node's state and default output."""
        name = self.node.name
        for field in _CARRIED:
            if field in changed:
                what = f"the {field} that step returns"
                changed[field] = matched(name, what, changed[field], "the one it got", getattr(before, field))
        return changed, matched(name, "the output of step", output, "that of init_output", default)


def overwritten(ts: Number | None, begin: int, now: int, node: str) -> int:
    """Return the start that a step has set [ticks]; -1 if it has not changed its start (rule 4).

    Args:
        ts: The step's ``ts`` afterwards [s]; None if it was not replaced.
        begin: The step's start [ticks].
        now: The time after the step [ticks].

    Raises:
        Sim2RealError: Unless ``begin <= ts < now``, compared in float32, the type of ``StepState.ts``.
    """
    if ts is None:
        return -1
    ts_s, begin_s, now_s = float(ts), begin / 1e6, now / 1e6
    if np.float32(ts_s) == np.float32(begin_s):
        return -1
    if not np.float32(begin_s) < np.float32(ts_s) <= np.float32(now_s):
        raise Sim2RealError(
            f"node {node!r}: its step moved ts to {ts_s} s, outside of [{begin_s}, {now_s}) s, from its start to now",
            hint="set ts to a time of this step, from the node's now()",
        )
    return min(max(to_ticks(ts_s), begin), now - 1)


def _changed(before: StepState, new: StepState) -> dict[str, PyTree]:
    """Return the fields that a step replaced: only they must be outputs of the compiled program."""
    return {f: getattr(new, f) for f in (*_CARRIED, "ts") if getattr(new, f) is not getattr(before, f)}


def _with_delays(node: BaseNode, step_state: StepState, ages: Mapping[str, Array]) -> StepState:
    """Return the step state with trainable delays applied to the inputs that have ``ages``."""
    if not ages:
        return step_state
    inputs = dict(step_state.inputs)
    for name, age in ages.items():
        wide = inputs[name]
        dist = wide.delay_dist
        if isinstance(dist, TrainableDist):
            bare = InputState(wide.seq, wide.ts_sent, wide.ts_recv, wide.data)
            c = node.inputs[name]
            served = dist.apply(bare, age, c.window, 1.0 / node.rate, step_state.ts, c.skip)
            inputs[name] = served.replace(delay_dist=dist)
    return step_state.replace(inputs=inputs)


def matched(node: str, what: str, got: T, reference: str, like: object) -> T:
    """Return ``got`` with exactly the dtypes of ``like``, after ``check_match``, whose arguments it takes."""
    if not has_jax():
        return got
    check_match(node, what, got, reference, like)

    def cast(new: ArrayLike, old: ArrayLike) -> ArrayLike:
        dtype = jnp.result_type(old)
        return new if new is old or jnp.issubdtype(dtype, jax.dtypes.extended) else jnp.asarray(new, dtype)

    return jax.tree_util.tree_map(cast, got, like)


def check_match(node: str, what: str, got: object, reference: str, like: object) -> None:
    """Check that two trees have equal structures, shapes and dtypes.

    Dtypes may differ where JAX converts without loss: a Python number takes the dtype of ``like`` (``0`` may become a
    float, ``0.5`` not an integer), and float64 counts as float32 unless 64 bits are enabled.

    Raises:
        UsageError: They differ; the message names the first leaf that does.
    """
    # Structure first, then leaf by leaf.
    where = f"node {node!r}: {what} differs from {reference}"
    trees = [jax.tree_util.tree_structure(t) for t in (got, like)]
    if trees[0] != trees[1]:
        raise UsageError(f"{where}: {trees[0]} instead of {trees[1]}", hint="keep to the same fields everywhere")
    flat, _ = jax.tree_util.tree_flatten_with_path(like)
    for new, (path, old) in zip(jax.tree_util.tree_leaves(got), flat, strict=True):
        kind, wanted = _describe(new), jnp.result_type(old)
        weak = getattr(kind, "weak_type", False) and jnp.result_type(new, wanted) == wanted
        if new is old or (kind is not None and np.shape(old) == kind.shape and (weak or kind.dtype == wanted)):
            continue
        text = type(new).__name__ if kind is None else f"{kind.dtype}{list(kind.shape)}"
        raise UsageError(
            f"{where}: {jax.tree_util.keystr(path) or 'the value'} is {text} instead of {wanted}{list(np.shape(old))}",
            hint="keep shapes and dtypes fixed, e.g. jnp.float32(0.0) in init, x.astype(...) in step",
        )


def _describe(leaf: object) -> jax.ShapeDtypeStruct | ShapedArray | None:
    """Return shape and dtype of a leaf; None if it is neither an array nor a number."""
    if isinstance(leaf, jax.ShapeDtypeStruct):
        return leaf
    try:
        kind = jax.typeof(leaf)
    except TypeError:
        return None
    return kind if hasattr(kind, "weak_type") else None
