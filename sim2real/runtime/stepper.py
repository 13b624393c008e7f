"""Calls a node's step, compiled ahead of time or in plain Python, with the same checks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from sim2real import pytree
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.base import InputState, StepState
from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode, to_ticks
from sim2real.later import jax, jnp
from sim2real.runtime.data import NodeData
from sim2real.runtime.match import matched
from sim2real.types import PyTree

if TYPE_CHECKING:
    from sim2real.graph.base import Array, Number

_CARRIED = ("rng", "params", "state")


T = TypeVar("T")


class Result(NamedTuple):
    """The results of a step.

    Attributes:
        changed: The replaced ones of ``rng``, ``params`` and ``state``.
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
    """Runs the steps of one node, for any number of episodes; compiles when the first is prepared."""

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
            if not traced.jaxpr.effects:  # no side effects: a first call, whose result is dropped, fills caches
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
    """Return the fields that a step replaced; the others need not be outputs of the compiled program."""
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
