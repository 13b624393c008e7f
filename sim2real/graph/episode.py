"""The record of a graph's run: steps, messages and outputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, is_dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import numpy as np

from sim2real.arrays import is_jax
from sim2real.errors import UsageError
from sim2real.later import jax
from sim2real.types import Json, PyTree

if TYPE_CHECKING:
    from sim2real.graph.base import StepState

TICKS_PER_S = 1_000_000
"""All times of schedules and logs are whole ticks: microseconds."""


class StepRecord(NamedTuple):
    """One finished step of a node; times in ticks [us] from the episode's start.

    Attributes:
        seq: Number of the step, from 0.
        scheduled: The step's slot (timing rule 2).
        start: Start by the timing rules.
        woken: Time at which the thread began to run it.
        ts_overwrite: The start that the step has set; -1 if it has set none.
        end: End of the step, at which its output was sent.
        drift: Shift of the node's schedule by earlier overruns.
    """

    node: str
    seq: int
    scheduled: int
    start: int
    woken: int
    ts_overwrite: int
    end: int
    drift: int


class MessageRecord(NamedTuple):
    """One message of a connection; times in ticks [us] from the episode's start.

    Attributes:
        node: The reader's name.
        seq_out: Number of the sender's step.
        seq_in: Number of the reader's step that consumed it; -1 if none did.
    """

    node: str
    input: str
    seq_out: int
    seq_in: int
    sent: int
    received: int


class Recorder(Protocol):
    """Receives the records of a running graph. Implementations return at once: control loops call them."""

    def start(self, epoch_ns: int, monotonic_ns: int) -> None:
        """Take an episode's start, on the wall clock [ns since 1970] and on the monotonic clock [ns]."""

    def step(self, record: StepRecord, output: PyTree) -> None:
        """Take a step that has ended, and its output: a pytree of numpy arrays or numbers."""

    def message(self, record: MessageRecord) -> None:
        """Take a message that was consumed, or that no step will consume any more."""


@runtime_checkable
class StepStateRecorder(Recorder, Protocol):
    """A recorder that also receives the step state of each step."""

    @property
    def keep(self) -> frozenset[str]:
        """Parts of the step state that it keeps; empty: none."""
        ...

    def given(self, node: str, step_state: StepState) -> None:
        """Take the step state that a node's step gets, before the record of the step."""


PARTS_OF_STEPS = ("state", "params", "inputs")
"""Parts of a step state that a recorder may keep."""


@dataclass(frozen=True)
class Steps:
    """All steps of one node, by seq; every array has shape ``(N,)``, int64 ticks [us]."""

    scheduled: np.ndarray
    start: np.ndarray
    woken: np.ndarray
    ts_overwrite: np.ndarray
    end: np.ndarray
    drift: np.ndarray

    def __len__(self) -> int:
        return len(self.start)

    @property
    def begun(self) -> np.ndarray:
        """Begin of each step, ``(N,)`` ticks [us]: the time that the step has set, else its start.

        A sensor sets the time at which its sample was taken, so these are the samples' times.
        """
        return np.where(self.ts_overwrite >= 0, self.ts_overwrite, self.start)

    @property
    def begun_s(self) -> np.ndarray:
        """Begin of each step, ``(N,)`` [s]; see ``begun``."""
        return self.begun / TICKS_PER_S


@dataclass(frozen=True)
class Messages:
    """All messages of one connection, by seq_out; every array has shape ``(M,)``, int64 (times in ticks [us])."""

    seq_out: np.ndarray
    seq_in: np.ndarray
    sent: np.ndarray
    received: np.ndarray

    def __len__(self) -> int:
        return len(self.seq_out)


@dataclass(frozen=True, repr=False)
class Episode:
    """A recorded run of a graph.

    Attributes:
        steps: Node -> its steps.
        messages: (node, input name) -> the messages on that connection.
        outputs: Node -> field name -> array with one row a step, shape ``(N, ...)``.
        metadata: Metadata of the session's log (pipeline, configuration, versions, ...).
        complete: Whether the session ended properly; False after a crash.
        units: Node -> field, or entry of one (``"aim[0]"``) -> unit, if the recording has it.
        states: Node -> field -> array with one row a step, the state before it; empty if states were not recorded.
        params: The same for parameters.
        inputs: (node, input name) -> ``seq``, ``ts_sent``, ``ts_recv`` and ``data.FIELD``, shape ``(N, W, ...)``: the
            window of each step; empty if inputs were not recorded.
    """

    steps: Mapping[str, Steps]
    messages: Mapping[tuple[str, str], Messages]
    outputs: Mapping[str, Mapping[str, np.ndarray]]
    metadata: Mapping[str, Json] = field(default_factory=dict)
    complete: bool = True
    units: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    states: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    params: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    inputs: Mapping[tuple[str, str], Mapping[str, np.ndarray]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Episode({self.duration_s:.3f} s, steps: {', '.join(f'{n} {len(s)}' for n, s in self.steps.items())})"

    @property
    def duration_s(self) -> float:
        """End of the last step [s from the episode's start]; 0 without steps."""
        ends = [int(s.end[-1]) for s in self.steps.values() if len(s)]
        return max(ends, default=0) / TICKS_PER_S


class MemoryRecorder:
    """A recorder that keeps everything in memory and returns it as an ``Episode``.

    Args:
        keep: Parts of the step state to keep beside the output: ``state`` (before the step), ``params``, ``inputs``.
            On the wall clock the copy takes time in each step.

    Raises:
        UsageError: ``keep`` has another name.
    """

    def __init__(self, keep: Sequence[str] = ()) -> None:
        self.keep = frozenset([keep] if isinstance(keep, str) else keep)
        if unknown := sorted(self.keep - set(PARTS_OF_STEPS)):
            raise UsageError(f"a recorder cannot keep {', '.join(unknown)}. Available: {', '.join(PARTS_OF_STEPS)}")
        self._offered: dict[str, list[StepState]] = {}
        self._steps: dict[str, list[StepRecord]] = {}
        self._outputs: dict[str, list[PyTree]] = {}
        self._messages: dict[tuple[str, str], list[MessageRecord]] = {}

    def start(self, epoch_ns: int, monotonic_ns: int) -> None:
        """Drop the records of the episode before."""
        del epoch_ns, monotonic_ns
        self._steps, self._outputs, self._messages, self._offered = {}, {}, {}, {}

    def given(self, node: str, step_state: StepState) -> None:
        """Keep parts of a step state."""
        parts = {part: getattr(step_state, part) if part in self.keep else None for part in PARTS_OF_STEPS}
        self._offered.setdefault(node, []).append(_copied(step_state.replace(rng=None, **parts)))

    def step(self, record: StepRecord, output: PyTree) -> None:
        """Keep a step and its output."""
        self._steps.setdefault(record.node, []).append(record)
        self._outputs.setdefault(record.node, []).append(output)

    def message(self, record: MessageRecord) -> None:
        """Keep a message."""
        self._messages.setdefault((record.node, record.input), []).append(record)

    def episode(self) -> Episode:
        """Return the records so far."""
        return Episode(
            steps={n: steps_from_records(r) for n, r in self._steps.items()},
            messages={k: messages_from_records(r) for k, r in self._messages.items()},
            outputs={n: _stack(o) for n, o in self._outputs.items()},
            states=self._part("state"),
            params=self._part("params"),
            inputs={
                (n, i): _stack([step.inputs[i].replace(delay_dist=None) for step in self._of_steps(n)])
                for n in (self._offered if "inputs" in self.keep else ())
                for i in self._offered[n][0].inputs
            },
        )

    def _part(self, part: str) -> dict[str, dict[str, np.ndarray]]:
        if part not in self.keep:
            return {}
        return {n: _stack([getattr(step, part) for step in self._of_steps(n)]) for n in self._offered}

    def _of_steps(self, node: str) -> list[StepState]:
        """Return the step states of finished steps: a step that failed has no record."""
        return self._offered[node][: len(self._steps.get(node, ()))]


def steps_from_records(records: list[StepRecord]) -> Steps:
    """Turn step records, in any order, into columns by seq."""
    records = sorted(records, key=lambda r: r.seq)
    return Steps(*(np.array([getattr(r, f) for r in records], np.int64) for f in Steps.__dataclass_fields__))


def messages_from_records(records: list[MessageRecord]) -> Messages:
    """Turn message records, in any order, into columns by seq_out."""
    records = sorted(records, key=lambda r: r.seq_out)
    return Messages(*(np.array([getattr(r, f) for r in records], np.int64) for f in Messages.__dataclass_fields__))


def named_leaves(tree: PyTree) -> dict[str, PyTree]:
    """Return the leaves of a message by dotted name (``th``, ``pose.x``), in a fixed order."""
    if isinstance(tree, Mapping) and not any(isinstance(v, Mapping) or is_dataclass(v) for v in tree.values()):
        return dict(tree)
    from sim2real import pytree  # imported late: a log of plain dictionaries is read without JAX

    flat, _ = pytree.flatten_with_path(tree)

    def label(path: tuple[object, ...]) -> str:
        return ".".join(str(getattr(p, "name", getattr(p, "key", getattr(p, "idx", p)))) for p in path) or "value"

    return {label(path): leaf for path, leaf in flat}


def _copied(tree: PyTree) -> PyTree:
    """Return a tree with numpy copies of its arrays; of a JAX key its numbers."""
    from sim2real import pytree

    def one(leaf: PyTree) -> np.ndarray:
        key = is_jax(leaf) and jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        return np.array(jax.random.key_data(leaf) if key else leaf)

    return pytree.map(one, tree)


def _stack(outputs: list[PyTree]) -> dict[str, np.ndarray]:
    """Return the outputs of N steps as one array per leaf, shape ``(N, ...)``."""
    rows = [named_leaves(o) for o in outputs]
    return {name: np.stack([np.asarray(row[name]) for row in rows]) for name in (rows[0] if rows else {})}
