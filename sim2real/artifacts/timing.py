"""The timing of one session, from which training draws delays without the log.

``timing.npz`` has every node's computation times and bus transfers, and every connection's transport times, in order.
``timing.json`` has quantiles for each node, for people to read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.files import (
    check,
    make_folder,
    malformed,
    read_grouped,
    read_versioned,
    write_grouped,
    write_json,
)
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.errors import Sim2RealError
from sim2real.graph.delays import DelayDistribution, EmpiricalDist
from sim2real.graph.episode import TICKS_PER_S, Episode
from sim2real.log.session import input_ages
from sim2real.types import Json

FORMAT = 2
TIMING, SAMPLES = "timing.json", "timing.npz"
_ARRAYS = ("steps_s", "bus_s", "transport_s")
_AGAIN = "record again, or run `sim2real identify` again on the log"


@dataclass(frozen=True)
class Spread:
    """Median, 99 % quantile and maximum of times [s]; None without samples."""

    p50: float | None
    p99: float | None
    max: float | None

    @staticmethod
    def of(seconds: np.ndarray) -> Spread:
        """Return the spread of times ``(N,)`` [s] without NaN."""
        finite = seconds[np.isfinite(seconds)]
        return Spread(*np.quantile(finite, [0.5, 0.99, 1.0]).tolist()) if finite.size else Spread(None, None, None)


NONE = Spread(None, None, None)


@dataclass(frozen=True)
class NodeTiming:
    """The timing of one node.

    Attributes:
        period: Time between the wake-ups of two steps.
        lateness: Time from a step's start to the wake-up of its thread.
        computation: Time from a step's start to its end, with wake-up and bus.
        bus: Part of the computation from the lock of the bus to the device's answer, with retries; no samples for a
            node without a device.
        age: Input -> time from the sending of its newest message to the step's start.
        overruns: Number of steps that ended after the start of the next slot; None if they were not counted.
    """

    steps: int
    period: Spread
    lateness: Spread
    computation: Spread
    age: Mapping[str, Spread]
    overruns: int | None = None
    bus: Spread = NONE


@dataclass(frozen=True, repr=False)
class Timing(Shown):
    """The timing of one session.

    Attributes:
        steps_s: Node -> duration of each step ``(N,)`` [s], in order.
        bus_s: Node -> duration of each bus transaction ``(T,)`` [s], in order.
        transport_s: ``reader/input`` -> transport time of each message ``(M,)`` [s], in order.
    """

    nodes: Mapping[str, NodeTiming]
    steps_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    bus_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    transport_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    format: int = FORMAT

    @staticmethod
    def of(episode: Episode) -> Timing:
        """Return the timing of a log, with the counts that the session wrote at its end."""
        end: Mapping[str, Json] = episode.metadata.get("log", {}).get("session_end") or {}
        counted: Mapping[str, Json] = end.get("timing", {})
        # A session's summary has the nodes in the graph's order, and overruns, which other logs lack.
        names = [*(n for n in counted if n in episode.steps), *(n for n in episode.steps if n not in counted)]
        # The times on the bus, in seconds, of the log's nodes.
        used: Mapping[str, Json] = end.get("bus", {})
        bus = {n: np.asarray(use["transfer_us"], np.float64) * 1e-6 for n, use in used.items() if n in episode.steps}
        return Timing(
            nodes={n: _node(episode, n, counted.get(n, {}).get("overruns"), bus.get(n)) for n in names},
            steps_s={n: (s.end - s.start) / TICKS_PER_S for n, s in episode.steps.items()},
            bus_s=bus,
            transport_s={f"{r}/{i}": (m.received - m.sent) / TICKS_PER_S for (r, i), m in episode.messages.items()},
        )

    def computation(self, longest_s: float = math.inf) -> tuple[dict[str, DelayDistribution], dict[str, int]]:
        """Return the distribution of each node's computation time, from which training and simulation draw.

        Args:
            longest_s: Longer steps are dropped [s], because such hiccups would put a pause into every timeline.

        Returns:
            The distributions by node, and the number of dropped steps of each node that has dropped steps.

        Raises:
            Sim2RealError: When most steps of a node would be dropped.
        """
        delays: dict[str, DelayDistribution] = {}
        dropped: dict[str, int] = {}
        for name, took in self.steps_s.items():
            # Drop steps that took much longer than usual, if they are few.
            usual = took[took <= longest_s]
            if usual.size < 2 or usual.size < took.size / 2:
                raise Sim2RealError(
                    f"only {usual.size} of {took.size} steps of node {name!r} took less than {1e3 * longest_s:g} ms",
                    hint="record on a less busy machine, or lower the rates of the pipeline",
                )
            delays[name] = EmpiricalDist.fit(usual)
            if usual.size < took.size:
                dropped[name] = int(took.size - usual.size)
        return delays, dropped

    def about(self) -> Mapping[str, Json]:
        """Return the nodes and their numbers of steps."""
        return {"nodes": ", ".join(f"{name} {node.steps} steps" for name, node in self.nodes.items())}

    def rows(self) -> ArtifactTable:
        """Return a row for each node, with times in ms."""
        in_ms = lambda seconds: None if seconds is None else 1e3 * seconds  # noqa: E731
        rows = []
        for name, t in self.nodes.items():
            oldest = max((age.max for age in t.age.values() if age.max is not None), default=None)
            took = (t.computation.p50, t.computation.p99, t.computation.max)
            times = (t.period.p50, t.lateness.p99, t.lateness.max, *took, t.bus.p50, t.bus.max, oldest)
            rows.append([name, t.steps, *map(in_ms, times), t.overruns])
        heads = ("period [ms]", "late p99", "late max", "computation", "comp. p99", "comp. max", "bus p50", "bus max")
        return ArtifactTable(("node", "steps", *heads, "oldest input", "overruns"), rows)

    def save(self, folder: Path | str, name: str = "timing") -> dict[str, str]:
        """Write it into a folder.

        Returns:
            Output -> name of the file in the folder.
        """
        folder = make_folder(folder)
        document, samples = f"{name}.json", f"{name}.npz"
        write_json(folder / document, self, without=_ARRAYS)
        write_grouped(folder / samples, self, _ARRAYS)
        return {name: document, f"{name}_samples": samples}

    @staticmethod
    def load(path: Path | str) -> Timing:
        """Read what ``save`` wrote.

        Args:
            path: The JSON file, or the folder with ``timing.json``.

        Raises:
            Sim2RealError: When a file is missing, malformed, or of another format.
        """
        path = Path(path)
        file = path / TIMING if path.is_dir() else path
        timing = read_versioned(file, Timing, _AGAIN, FORMAT)
        # Read the samples, and check that they belong to the nodes of the document.
        samples = file.with_suffix(".npz")
        with malformed(samples, _AGAIN):
            kinds = read_grouped(samples, _ARRAYS)
            check(set(kinds["steps_s"]) == set(timing.nodes), "its nodes differ from those of the JSON file")
            check(set(kinds["bus_s"]) <= set(timing.nodes), "the JSON file lacks a node that is on the bus")
        return replace(timing, **kinds)


def _node(episode: Episode, name: str, overruns: int | None, bus_s: np.ndarray | None) -> NodeTiming:
    steps = episode.steps[name]
    return NodeTiming(
        steps=len(steps),
        period=Spread.of(np.diff(steps.woken) / TICKS_PER_S),
        lateness=Spread.of((steps.woken - steps.start) / TICKS_PER_S),
        computation=Spread.of((steps.end - steps.start) / TICKS_PER_S),
        age={n: Spread.of(ages) for n, ages in input_ages(episode, name).items()},
        overruns=overruns,
        bus=NONE if bus_s is None else Spread.of(bus_s),
    )
