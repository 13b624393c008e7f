"""What check finds: what recordings, or a planned one, can tell about the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sim2real.artifacts.summary import Rows, Shown


@dataclass(frozen=True, repr=False)
class Checked(Shown):
    """What recordings, or a planned one, can tell.

    Attributes:
        pipeline: The robot.
        source: ``log``, or the planned excitation.
        recordings: How each was sampled, what its joints did, and what drove them.
        segments: How many segments were simulated.
        segment_s: Their length [s].
        condition: Condition number of the Jacobian.
        determined: Whether everything is determined, up to the time shift between delays.
        undetermined: Groups of parameters of which at most combinations are determined.
        only_sum_of_delays: Whether only the sum of the delays can be told.
        messages: The same in words.
        parameters: A row for each parameter.
        recommendation: What to do next, in words.
    """

    pipeline: str
    source: str
    recordings: list[dict[str, Any]]
    segments: int
    segment_s: float
    condition: float
    determined: bool
    undetermined: list[list[str]]
    only_sum_of_delays: bool
    messages: list[str]
    parameters: list[dict[str, Any]]
    recommendation: list[str]

    def about(self) -> dict[str, Any]:
        """Return what to say about it: name -> value."""
        found = {"pipeline": self.pipeline, "source": self.source, "determined": "yes" if self.determined else "no"}
        return found | {"why": "; ".join(self.messages), "next": "; ".join(self.recommendation)}

    def rows(self) -> Rows:
        """Return a row for each parameter."""
        names = ("name", "nominal", "standard_error_per_minute", "unit", "determined")
        headers = ("parameter", "nominal", "s.e. from a minute", "unit", "determined")
        return headers, [[p[name] for name in names] for p in self.parameters]
