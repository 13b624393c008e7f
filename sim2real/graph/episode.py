"""The record of a graph's run: steps, messages and outputs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, is_dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from sim2real.types import Json, PyTree

if TYPE_CHECKING:
    pass

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
        """Take a message, once a step has consumed it or no step can consume it any more."""


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
        """Begin of each step, ``(N,)`` ticks [us]: the time that the step has set itself, otherwise its start.

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
    """

    steps: Mapping[str, Steps]
    messages: Mapping[tuple[str, str], Messages]
    outputs: Mapping[str, Mapping[str, np.ndarray]]
    metadata: Mapping[str, Json] = field(default_factory=dict)
    complete: bool = True
    units: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Episode({self.duration_s:.3f} s, steps: {', '.join(f'{n} {len(s)}' for n, s in self.steps.items())})"

    @property
    def duration_s(self) -> float:
        """End of the last step [s from the episode's start]; 0 without steps."""
        ends = [int(s.end[-1]) for s in self.steps.values() if len(s)]
        return max(ends, default=0) / TICKS_PER_S


class MemoryRecorder:
    """A recorder that keeps everything in memory and returns it as an ``Episode``."""

    def __init__(self) -> None:
        self._steps: dict[str, list[StepRecord]] = {}
        self._outputs: dict[str, list[PyTree]] = {}
        self._messages: dict[tuple[str, str], list[MessageRecord]] = {}

    def start(self, epoch_ns: int, monotonic_ns: int) -> None:
        """Drop the records of the episode before."""
        del epoch_ns, monotonic_ns
        self._steps, self._outputs, self._messages = {}, {}, {}

    def step(self, record: StepRecord, output: PyTree) -> None:
        """Keep a step and its output."""
        self._steps.setdefault(record.node, []).append(record)
        self._outputs.setdefault(record.node, []).append(output)

    def message(self, record: MessageRecord) -> None:
        """Keep a message."""
        self._messages.setdefault((record.node, record.input), []).append(record)

    def episode(self) -> Episode:
        """Return the records so far."""
        rows = {n: [named_leaves(o) for o in outputs] for n, outputs in self._outputs.items()}
        return Episode(
            steps={n: steps_from_records(r) for n, r in self._steps.items()},
            messages={k: messages_from_records(r) for k, r in self._messages.items()},
            outputs={n: {k: np.stack([np.asarray(row[k]) for row in of]) for k in of[0]} for n, of in rows.items()},
        )


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
