"""The result of validate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sim2real.artifacts.identification import FREE_RUN, Promise, promises_table
from sim2real.artifacts.summary import ArtifactTable, Shown
from sim2real.types import Json

ACCEPTED = "accepted"


@dataclass(frozen=True, repr=False)
class Validation(Shown):
    """Errors of an identification on logs that were not fitted.

    Attributes:
        horizon_s: Horizon of the predictions [s].
        positions: Position -> its errors, the baselines with smaller errors, the promised error.
        ledger: Each error of each log beside its bound.
        drawn: For each log and column the 95 % interval of the error of a free run over draws of the posterior.
        beyond: Sentences about signals outside the range of the fitted data: there the bounds do not hold.
        better: Whether the identification predicts every position better than every baseline.
        promise_kept: Whether no error exceeds its bound by more than ``MAX_ERROR_RATIO``; None without a bound.
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
    ledger: Sequence[Promise] = ()
    beyond: Sequence[str] = ()
    drawn: Sequence[Mapping[str, Json]] = ()

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

    def promises_table(self) -> ArtifactTable:
        """Return the ledger: a row for each error with a bound."""
        return promises_table(self.ledger)
