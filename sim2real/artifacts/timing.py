"""How long everything took on the robot: what training draws its timing from, so that it needs no log.

``timing.npz`` has every node's computation times and bus transfers, and every connection's transport times, in order.
``timing.json`` has their quantiles for people, and what else the session counted: lost answers, overruns, the clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.files import check, made, malformed, read_arrays, read_json, write_arrays, write_json
from sim2real.artifacts.summary import Rows, Shown
from sim2real.errors import Sim2RealError
from sim2real.graph.delays import DelayDistribution
from sim2real.graph.episode import TICKS_PER_S, Episode
from sim2real.graph.fitting import resample
from sim2real.log.ages import input_ages

FORMAT = 2
_READ = (1, FORMAT)  # 1: without the times of the bus
TIMING, SAMPLES = "timing.json", "timing.npz"
_ARRAYS = ("steps_s", "bus_s", "transport_s")
_AGAIN = "record again, or run `sim2real identify` again on the log"


@dataclass(frozen=True)
class Spread:
    """Median, 99 % quantile and maximum of times [s]; None without any sample."""

    p50: float | None
    p99: float | None
    max: float | None

    @staticmethod
    def of(seconds: np.ndarray) -> Spread:
        """Return the spread of times ``(N,)`` [s]; NaN does not count."""
        there = seconds[np.isfinite(seconds)]
        return Spread(*np.quantile(there, [0.5, 0.99, 1.0]).tolist()) if there.size else Spread(None, None, None)


NONE = Spread(None, None, None)


@dataclass(frozen=True)
class NodeTiming:
    """The timing of one node.

    Attributes:
        steps: How many steps it made.
        period: From one step's awakening to the next.
        lateness: From a step's start to when its thread really ran.
        computation: From a step's start to its end, the thread's awakening and the bus included.
        bus: The part of it from getting the bus to having the device's answer, questions asked again included; without
            any sample for a node that talks to no device, and where that was not recorded.
        bus_wait: How long a step waited before for another node's use of the bus.
        age: Input -> how long before a step's start the newest message that it used was sent.
        overruns: Steps that ended after the next was due; None where they were not counted.
    """

    steps: int
    period: Spread
    lateness: Spread
    computation: Spread
    age: Mapping[str, Spread]
    overruns: int | None = None
    bus: Spread = NONE
    bus_wait: Spread = NONE


@dataclass(frozen=True)
class ConnectionTiming:
    """What became of the messages of one connection.

    Attributes:
        reader: The node that reads.
        input: Name of its input.
        messages: How many were sent.
        unread: How many no step used, because newer ones had come or the episode had ended.
        transport: From a message's sending to its receipt.
    """

    reader: str
    input: str
    messages: int
    unread: int
    transport: Spread


@dataclass(frozen=True)
class BusTiming:
    """Transactions, losses and late answers on a device's bus.

    Attributes:
        transactions: Questions asked.
        lost: Answers that never came.
        retries: Questions asked again.
        late: Answers whose sample's time is uncertain, or that came after their question had been repeated.
        lateness: By how much answers took longer than their bytes.
    """

    transactions: int
    lost: int
    retries: int
    late: int
    lateness: Spread


@dataclass(frozen=True, repr=False)
class Timing(Shown):
    """The timing of one session.

    Attributes:
        nodes: Node -> its timing.
        connections: What became of the messages of each connection.
        bus: The bus; None where there is none, such as in a log that was imported.
        stamps: Node -> ``recorded`` or, in a log that was imported, ``generated`` from a rate.
        monotonic_ns: Time 0 of the session on the computer's monotonic clock [ns]; None where it is not known.
        steps_s: Node -> how long each of its steps took ``(N,)`` [s], in their order.
        bus_s: Node -> how long each of its transactions on the bus took ``(T,)`` [s], in their order.
        transport_s: (reader, input) -> how long each message was under way ``(M,)`` [s], in their order.
        format: Version of the files.
    """

    nodes: Mapping[str, NodeTiming]
    connections: tuple[ConnectionTiming, ...]
    bus: BusTiming | None = None
    stamps: Mapping[str, str] = field(default_factory=dict)
    monotonic_ns: int | None = None
    steps_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    bus_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    transport_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    format: int = FORMAT

    @staticmethod
    def of(episode: Episode) -> Timing:
        """Return the timing of a log, its own account of the session included."""
        end: Mapping[str, Any] = episode.metadata.get("log", {}).get("session_end") or {}
        counted: Mapping[str, Any] = end.get("timing", {})
        # A session's own summary has the nodes in their graph's order, with overruns; other logs lack only that.
        names = [*(n for n in counted if n in episode.steps), *(n for n in episode.steps if n not in counted)]
        stamps = episode.metadata.get("stamps", {})
        bus = {
            n: {kind: np.asarray(us, np.float64) * 1e-6 for kind, us in use.items()}
            for n, use in end.get("bus", {}).items()
            if n in episode.steps
        }
        return Timing(
            nodes={n: _node(episode, n, counted.get(n, {}).get("overruns"), bus.get(n, {})) for n in names},
            connections=tuple(_connection(episode, *key) for key in episode.messages),
            bus=_bus(end) if "transactions" in end else None,
            stamps={n: stamps.get(n, "recorded") for n in names},
            monotonic_ns=end.get("monotonic_ns"),
            steps_s={n: (s.end - s.start) / TICKS_PER_S for n, s in episode.steps.items()},
            bus_s={n: use["transfer_us"] for n, use in bus.items()},
            transport_s={f"{r}/{i}": (m.received - m.sent) / TICKS_PER_S for (r, i), m in episode.messages.items()},
        )

    def computation(self, longest_s: float = math.inf) -> tuple[dict[str, DelayDistribution], dict[str, int]]:
        """Return how long each node's steps take, as training and simulation draw it.

        Args:
            longest_s: Longer steps are left out [s]: hiccups, which would put a pause into every timeline.

        Returns:
            The distributions by node, and how many steps were left out, for those nodes that had some.

        Raises:
            Sim2RealError: When that would be most steps of a node.
        """
        delays: dict[str, DelayDistribution] = {}
        dropped: dict[str, int] = {}
        for name, took in self.steps_s.items():
            usual = took[took <= longest_s]
            if usual.size < 2 or usual.size < took.size / 2:
                raise Sim2RealError(
                    f"only {usual.size} of {took.size} steps of node {name!r} took less than {1e3 * longest_s:g} ms",
                    hint="record on a less busy machine, or lower the rates of the pipeline",
                )
            delays[name] = resample(usual)
            if usual.size < took.size:
                dropped[name] = int(took.size - usual.size)
        return delays, dropped

    def about(self) -> Mapping[str, Any]:
        """Return what to say about it: name -> value."""
        return {"nodes": ", ".join(f"{name} {own.steps} steps" for name, own in self.nodes.items())}

    def rows(self) -> Rows:
        """Return a row for each node."""
        own = [[n, t.steps, t.computation.p50, t.computation.p99, t.overruns] for n, t in self.nodes.items()]
        return ("node", "steps", "computation p50 [s]", "p99 [s]", "overruns"), own

    def save(self, folder: Path | str, name: str = "timing") -> dict[str, str]:
        """Write it into a folder.

        Returns:
            Output -> name of the file in the folder.
        """
        folder = made(folder)
        document, samples = f"{name}.json", f"{name}.npz"
        write_json(folder / document, {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS})
        write_arrays(folder / samples, {f"{kind}/{n}": v for kind in _ARRAYS for n, v in getattr(self, kind).items()})
        return {name: document, f"{name}_samples": samples}

    @staticmethod
    def load(path: Path | str) -> Timing:
        """Read what ``save`` wrote.

        Args:
            path: The JSON file, or the folder with ``timing.json``.

        Raises:
            Sim2RealError: When it is missing, of another format, or not as it should be.
        """
        path = Path(path)
        file = path / TIMING if path.is_dir() else path
        with malformed(file, _AGAIN):
            found = read_json(file, Timing)
            if found.format not in _READ:
                raise Sim2RealError(f"{file} has format {found.format}, this version reads {FORMAT}", hint=_AGAIN)
        samples = file.with_suffix(".npz")
        with malformed(samples, _AGAIN):
            kinds: dict[str, dict[str, np.ndarray]] = {kind: {} for kind in _ARRAYS}
            for name, values in read_arrays(samples).items():
                kind, _, of = name.partition("/")
                check(kind in kinds and values.ndim == 1 and values.dtype.kind == "f", f"{name} is no list of times")
                kinds[kind][of] = values
            check(set(kinds["steps_s"]) == set(found.nodes), "its nodes are others than those of the JSON file")
            check(set(kinds["bus_s"]) <= set(found.nodes), "a node on the bus is none of the JSON file's")
        return replace(found, format=FORMAT, **kinds)


def _node(episode: Episode, name: str, overruns: int | None, bus: Mapping[str, np.ndarray]) -> NodeTiming:
    steps = episode.steps[name]
    return NodeTiming(
        steps=len(steps),
        period=Spread.of(np.diff(steps.woken) / TICKS_PER_S),
        lateness=Spread.of((steps.woken - steps.start) / TICKS_PER_S),
        computation=Spread.of((steps.end - steps.start) / TICKS_PER_S),
        age={n: Spread.of(ages) for n, ages in input_ages(episode, name).items()},
        overruns=overruns,
        bus=Spread.of(bus["transfer_us"]) if bus else NONE,
        bus_wait=Spread.of(bus["wait_us"]) if bus else NONE,
    )


def _connection(episode: Episode, reader: str, name: str) -> ConnectionTiming:
    messages = episode.messages[reader, name]
    transport = Spread.of((messages.received - messages.sent) / TICKS_PER_S)
    return ConnectionTiming(reader, name, len(messages), int((messages.seq_in < 0).sum()), transport)


def _bus(end: Mapping[str, Any]) -> BusTiming:
    return BusTiming(
        transactions=int(end.get("transactions", 0)),
        lost=int(end.get("lost_replies", 0)),
        retries=int(end.get("retries", 0)),
        late=int(end.get("late_replies", 0)),
        lateness=Spread(*(end.get("late_s") or (None, None, None))),
    )
