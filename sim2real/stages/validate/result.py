"""The result of validate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.types import Json

FREE_RUN = "free run"
ACCEPTED = "accepted"
MAX_ERROR_RATIO = 1.25
"""Largest ratio of the error to the promised one at which the promise is kept."""


@dataclass(frozen=True, repr=False)
class Validation(Shown):
    """Errors of an identification on logs that were not fitted.

    Attributes:
        horizon_s: Horizon of the predictions [s].
        positions: Position -> its errors, the baselines with smaller errors, the promised error.
        better: Whether the identification predicts every position better than every baseline.
        promise_kept: Whether the errors are as small as promised; None without a promise.
        rmse: Root mean square error of all positions at the horizon.
        free_run_rmse: The same in free runs.
        identified: The verdict of the identification.
        why: Reasons of the verdict.
        fitted: Sentences about fitted logs, which test nothing.
    """

    pipeline: str
    horizon_s: float
    positions: dict[str, dict[str, Json]]
    better: bool
    promise_kept: bool | None
    rmse: float
    free_run_rmse: float
    identified: str = ACCEPTED
    why: Sequence[str] = ()
    fitted: Sequence[str] = ()

    def about(self) -> dict[str, Json]:
        """Return name -> value of the main figures."""
        promise = {None: "none was made", True: "yes", False: "no"}[self.promise_kept]
        figures = {
            "pipeline": self.pipeline,
            "identification": self.identified,
            "better than baselines": "yes" if self.better else "no",
        }
        figures |= {"fitted": "; ".join(self.fitted)} if self.fitted else {}
        return figures | {"promise kept": promise, f"rmse {self.horizon_s:g} s ahead": self.rmse}

    def rows(self) -> ArtifactTable:
        """Return a row for each position."""
        rows = [
            [name, row["rmse"]["identified"], row["promised"], row[FREE_RUN], row["unit"]]
            for name, row in self.positions.items()
        ]
        return ArtifactTable(("position", "off", "promised", FREE_RUN, "unit"), rows)
