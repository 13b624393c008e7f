"""Distributions of the training's episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.files import check, malformed, read_grouped, read_versioned, write_grouped, write_json
from sim2real.artifacts.identification import Noise
from sim2real.artifacts.summary import ArtifactTable, Interval

FORMAT = 3
EPISODES, DRAWS = "episodes.json", "episodes.npz"
_ARRAYS = ("draws", "drawn_s")
_AGAIN = "run `sim2real train` again"


@dataclass(frozen=True)
class Varied:
    """A parameter that differs between episodes.

    Attributes:
        value: The estimate, or the nominal value.
        low95: Lower end of the estimate's 95 % interval; None without an interval.
        open: Whether the recordings do not determine it, so that it is drawn from its bounds.
    """

    name: str
    unit: str
    value: float
    low95: float | None = None
    high95: float | None = None
    open: bool = False


@dataclass(frozen=True)
class Episodes:
    """The distributions of the episodes of a training.

    Attributes:
        parameters: Parameters that differ between episodes, with pushes and starts, in the order of the table.
        widening: Factor on the posterior's standard deviations that covers errors of the model.
        cut: Number of timelines that were cut before a pause that is too long for the program.
        again: Number of timelines that were drawn again, because such a pause was in their first half.
        longest_pause_s: Longest time between two policy steps [s].
        push_hz: Pushes of each joint per second [Hz]; 0 for none.
        curriculum: Share of all differences between episodes at the first and at the last update.
        follow: Success in training above which ``curriculum`` grows; 0: it grows with the updates.
        draws: Parameter -> drawn values ``(K,)``.
        drawn_s: Node -> durations of its steps in the timelines ``(M,)`` [s].
    """

    parameters: tuple[Varied, ...]
    widening: float = 1.0
    noise: tuple[Noise, ...] = ()
    timelines: int = 0
    cut: int = 0
    again: int = 0
    longest_pause_s: float = 0.0
    push_hz: float = 0.0
    curriculum: tuple[float, float] = (1.0, 1.0)
    follow: float = 0.0
    draws: Mapping[str, np.ndarray] = field(default_factory=dict)
    drawn_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    format: int = FORMAT

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter: value, interval of the estimate, and interval of the draws."""
        rows, some_open = [], any(p.open for p in self.parameters)
        for p in self.parameters:
            low, high = np.quantile(self.draws[p.name], [0.025, 0.975]).tolist()
            drawn, identified = Interval(low, high), Interval(p.low95, p.high95)
            rows.append([p.name, p.value, identified, drawn, p.unit, *["left open by the log" * p.open] * some_open])
        last = ("",) * some_open
        return ArtifactTable(("parameter", "value", "95 % identified", "95 % drawn", "unit", *last), rows)

    def noise_table(self) -> ArtifactTable:
        """Return a row for each reading with noise."""
        rows = [[n.field, n.deviation, n.resolution, n.offset, n.unit] for n in self.noise]
        return ArtifactTable(("reading", "deviation", "step", "bias", "unit"), rows)

    def save(self, folder: Path) -> dict[str, str]:
        """Write it into a folder.

        Returns:
            Output -> name of the file in the folder.
        """
        write_json(folder / EPISODES, self, without=_ARRAYS)
        write_grouped(folder / DRAWS, self, _ARRAYS)
        return {"episodes": EPISODES, "episodes_draws": DRAWS}

    @staticmethod
    def load(path: Path) -> Episodes:
        """Read what ``save`` wrote into a folder.

        Raises:
            Sim2RealError: When a file is missing, malformed, or of another format.
        """
        episodes = read_versioned(path / EPISODES, Episodes, _AGAIN, FORMAT)
        with malformed(path / DRAWS, _AGAIN):
            kinds = read_grouped(path / DRAWS, _ARRAYS)
            check(set(kinds["draws"]) == {p.name for p in episodes.parameters}, "draws of other parameters")
        return replace(episodes, **kinds)
