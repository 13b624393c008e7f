"""The result of check."""

from __future__ import annotations

from dataclasses import dataclass

from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.types import Json


@dataclass(frozen=True, repr=False)
class Checked(Shown):
    """Which parameters recordings, or a planned one, determine.

    Attributes:
        source: ``log``, or ``planned excitation``.
        recordings: Sampling, joints and commands of each recording.
        segment_s: Length of a segment [s].
        determined: Whether every parameter is determined; of the delays the sum suffices.
        undetermined: Groups of parameters; only combinations of the parameters in a group are determined.
        only_sum_of_delays: Whether only the sum of the delays is determined.
    """

    pipeline: str
    source: str
    recordings: list[dict[str, Json]]
    segments: int
    segment_s: float
    condition: float
    determined: bool
    undetermined: list[list[str]]
    only_sum_of_delays: bool
    messages: list[str]
    parameters: list[dict[str, Json]]
    recommendation: list[str]

    def about(self) -> dict[str, Json]:
        """Return name -> value of the main figures."""
        figures = {"pipeline": self.pipeline, "source": self.source, "determined": "yes" if self.determined else "no"}
        return figures | {"why": "; ".join(self.messages), "next": "; ".join(self.recommendation)}

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter."""
        names = ("name", "nominal", "standard_error_per_minute", "unit", "determined")
        headers = ("parameter", "nominal", "s.e. from a minute", "unit", "determined")
        return ArtifactTable(headers, [[p[name] for name in names] for p in self.parameters])
