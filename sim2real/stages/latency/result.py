"""The parts of the delay between a motion and the motion that answers it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from sim2real.artifacts.files import read_versioned, write_json
from sim2real.artifacts.identification import ROUND_TRIP, Estimate, Identification
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.timing import Spread
from sim2real.graph.node import TICKS_PER_S

FORMAT = 1
LATENCY = "latency.json"
_AGAIN = "run `sim2real latency` again"
Where = Literal["host", "bus"]


@dataclass(frozen=True)
class Part:
    """One part of the way from a motion to the motion that answers it.

    Attributes:
        where: ``host`` (this computer), ``bus`` (the wire, the adapter and its driver).
        took: Distribution of its duration [s].
        counted: Whether it is part of the sum; the sensor's request on the bus comes before the sample.
    """

    name: str
    where: Where
    took: Spread
    counted: bool = True


@dataclass(frozen=True)
class DeviceShare:
    """Delays that no clock of this computer measures: from a motion to its sample, and from a command to the motion.

    Attributes:
        estimate: The sum of both [s], from the motion.
        low95: Lower end of its 95 % interval [s].
        high95: Upper end [s].
        verdict: ``accepted``, ``not identifiable`` or ``at a bound``.
        about: Names of the delays in this sum.
    """

    estimate: float
    low95: float
    high95: float
    verdict: str
    about: str


@dataclass(frozen=True)
class Latency:
    """The parts of the delay.

    Attributes:
        hidden: The device's share; None without motion.
        transactions: Number of transactions on the bus; None without a bus.
    """

    parts: tuple[Part, ...]
    hidden: DeviceShare | None = None
    transactions: int | None = None
    lost: int = 0
    late: int = 0
    format: int = FORMAT

    @property
    def total_s(self) -> float:
        """Sum of the medians and of the device's share [s]."""
        return sum(p.took.p50 or 0.0 for p in self.parts if p.counted) + (self.hidden.estimate if self.hidden else 0.0)

    @staticmethod
    def of(recording: Recording, chain: Sequence[str], identification: Identification | None) -> Latency:
        """Return the parts of a session.

        Args:
            chain: The nodes from the sensor to the actuator, in the order of the messages.
            identification: From the session's log; None without motion.
        """
        parts = tuple(Part(name, where, Spread.of(s), on) for name, where, s, on in measured(recording, chain))
        timing = recording.timing
        bus = timing.bus
        counted = (bus.transactions, bus.lost, bus.late) if bus else (None, 0, 0)
        return Latency(parts, None if identification is None else _hidden(identification.parameters), *counted)

    def save(self, folder: Path) -> dict[str, str]:
        """Write it into a folder; return output -> name of the file in the folder."""
        write_json(folder / LATENCY, vars(self))
        return {"latency": LATENCY}

    @staticmethod
    def load(path: Path) -> Latency:
        """Read a latency from its file or folder."""
        return read_versioned(path / LATENCY if path.is_dir() else path, Latency, _AGAIN, FORMAT)


def measured(recording: Recording, chain: Sequence[str]) -> Iterator[tuple[str, Where, np.ndarray, bool]]:
    """Yield the parts of the way through a chain of nodes, and the time of each node on the bus.

    Yields:
        Name, place, times ``(N,)`` [s], and whether it is part of the sum, as in `Part`.
    """
    timing, sensor = recording.timing, chain[0]
    steps = recording.episode.steps[sensor]
    yield f"{sensor}, from the sample to its message", "host", (steps.end - steps.begun) / TICKS_PER_S, True
    if (bus := timing.bus_s.get(sensor)) is not None and bus.size:
        yield f"{sensor} on the bus, question and answer", "bus", bus, False
    for before, name in pairwise(chain):
        if (under_way := timing.transport_s.get(f"{name}/{before}")) is not None:
            yield f"message from {before} to {name}", "host", under_way, True
        whole, bus = timing.steps_s[name], timing.bus_s.get(name)
        if bus is None or not bus.size:
            yield f"{name} wakes and computes", "host", whole, True
        elif bus.size == whole.size:
            yield f"{name} wakes and computes", "host", whole - bus, True
            yield f"{name} on the bus", "bus", bus, True
        else:
            yield f"{name}, its transactions included", "bus", whole, True


def _hidden(rows: tuple[Estimate, ...]) -> DeviceShare | None:
    """Return the sum of the delays, or the only one."""
    delays = [r for r in rows if r.kind == "delay"]
    total = next((r for r in rows if r.name == ROUND_TRIP), delays[0] if len(delays) == 1 else None)
    if total is None or total.low95 is None or total.high95 is None:
        return None
    return DeviceShare(total.estimate, total.low95, total.high95, total.verdict, total.about)
