"""A recorded session: its log and, for an embedded robot, the file of its true states and latencies."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim2real.artifacts.paths import shown
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.artifacts.timing import Timing
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.log.reader import TruncatedLogWarning, read_log
from sim2real.types import Json

if TYPE_CHECKING:
    from sim2real.emulation.truth import Truth

LOG, TRUTH = "session.mcap", "truth.bin"


@dataclass(frozen=True, repr=False)
class Recording(Shown):
    """A recorded session.

    Attributes:
        truth_path: File of an embedded robot's true states and latencies; None for any other robot.
        warnings: Sentences about missing or unreadable parts of the log.
    """

    path: Path
    episode: Episode
    truth_path: Path | None = None
    warnings: tuple[str, ...] = ()

    @staticmethod
    def load(path: Path | str, truth: Path | None = None) -> Recording:
        """Read a log; a truncated log is read up to its end.

        Args:
            path: The log, or the folder of a record stage.
            truth: File of an embedded robot's true states; default: the file beside the log, if it exists.

        Raises:
            Sim2RealError: When the file is no log.
        """
        path = Path(path)
        log = path / LOG if path.is_dir() else path
        if path.is_dir() and not log.is_file():
            inside = path / "record"
            hint = f"name its record stage, {inside}" if inside.is_dir() else "name a log, or a record stage's folder"
            raise Sim2RealError(f"{path} is a folder without {LOG}", hint=hint)
        truth = truth or log.with_name(TRUTH)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", TruncatedLogWarning)
            episode = read_log(log)
        messages = tuple(str(w.message) for w in caught if issubclass(w.category, TruncatedLogWarning))
        return Recording(log, episode, truth if truth.is_file() else None, messages)

    @property
    def pipeline(self) -> str | None:
        """Name of the pipeline that recorded the log; None if the log has no name."""
        return self.episode.metadata.get("pipeline")

    @property
    def dry_run(self) -> bool:
        """Whether commands were computed but not sent."""
        return self.episode.metadata.get("dry_run") is True

    @property
    def units(self) -> Mapping[str, str]:
        """Field -> unit, from the log's channels; without fields whose unit differs between nodes."""
        pairs = {pair for fields in self.episode.units.values() for pair in fields.items()}
        fields = [field for field, _ in pairs]
        unique = {field: unit for field, unit in sorted(pairs) if fields.count(field) == 1}
        return {**self.episode.metadata.get("units", {}), **unique}  # older logs have units in the session's metadata

    @property
    def summary(self) -> Mapping[str, Json]:
        """Summary at the session's end: timing by node, losses, the gate's counts; empty after a crash."""
        return self.episode.metadata.get("log", {}).get("session_end") or {}

    def about(self) -> Mapping[str, Json]:
        """Return pipeline, log, duration, steps and warnings, by name."""
        steps = ", ".join(f"{name} {len(s)}" for name, s in self.episode.steps.items())
        facts = {"pipeline": self.pipeline, "log": shown(self.path), "duration": f"{self.episode.duration_s:.1f} s"}
        return {**facts, "steps": steps, **({"warnings": "; ".join(self.warnings)} if self.warnings else {})}

    def rows(self) -> ArtifactTable:
        """Return the timing of each node."""
        return self.timing.rows()

    @cached_property
    def timing(self) -> Timing:
        """Durations of steps, bus transfers and transports."""
        return Timing.of(self.episode)

    @cached_property
    def truth(self) -> Truth | None:
        """An embedded robot's true states and latencies; None for any other robot.

        Raises:
            Sim2RealError: When its file is damaged.
        """
        from sim2real.emulation.truth import read_truth  # imported late: training reads recordings without hardware

        return None if self.truth_path is None else read_truth(self.truth_path)

    def true_states(self) -> tuple[np.ndarray, dict[str, np.ndarray]] | None:
        """Return times ``(N,)`` [s] since the session's start and true states ``(N,)`` by name, within the session.

        None for a robot that is not embedded, or if the log lacks the start of its clock.
        """
        if self.truth is None or "monotonic_ns" not in self.summary:
            return None
        t_ns, states = self.truth.states()
        t_s = (t_ns - self.summary["monotonic_ns"]) / 1e9
        inside = (t_s >= 0) & (t_s <= self.episode.duration_s)
        return t_s[inside], {n: s[inside] for n, s in states.items()}
