"""How an identification is made; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import UseAppendAction

from sim2real.errors import UsageError
from sim2real.identify.config import FitConfig


@dataclass(frozen=True)
class IdentifyConfig(FitConfig):
    """Identify dynamics, delays and initial states from logs."""

    log: Annotated[tuple[str, ...], UseAppendAction] = ()
    """MCAP log to identify from, one flag a log; default: the newest finished recording of the pipeline."""
    begin: str | None = None
    """Where the search begins: the parameters.json or partial.json of an earlier one; default: at the data sheet."""
    hold_out: Annotated[tuple[str, ...], UseAppendAction] = ()
    """MCAP log that is held out: only predicted, not fitted; one flag a log."""
    force: bool = False
    """Take a log that is given twice all the same: held out and fitted, or fitted two times."""
    settle_s: float = 0.3
    """First part of a held-out segment, to which its initial state is fitted; the rest is predicted [s]."""
    horizon_s: float = 1.0
    """Rest of a segment: how far ahead it is predicted [s]."""
    spacing_s: float = 0.0
    """Distance between the starts of fitted segments [s]; 0 puts them side by side."""
    held_out: float = 0.25
    """Share of each log, at its end, that is held out; 0 where whole logs are."""
    free_run_s: float = 10.0
    """Longest simulation of held-out data from a single initial state [s]."""
    folds: int = 5
    """Parts that are left out of the fit one at a time, to say how far off it is on what it never saw: each log where
    there are several, else so many blocks of the one there is; 0 leaves that out."""
    terms: str = "own"
    """Optional terms of the model: 'own' takes the pipeline's, 'auto' those without which what is left out is predicted
    worse, 'all' or 'none' say it, else names with commas between."""
    each: bool = True
    """Where there are several logs, identify each by itself as well, and report the spread between them."""
    bounds: Annotated[dict[str, tuple[float, float]], UseAppendAction] = field(default_factory=dict)
    """Bounds of a parameter instead of the pipeline's: NAME LOW HIGH, one flag a parameter."""
    fix: Annotated[dict[str, float], UseAppendAction] = field(default_factory=dict)
    """Value of a parameter that is not to be identified: NAME VALUE, one flag a parameter."""
    world: str | None = None
    """World of an installed package to identify in; default: the robot's own."""
    links: bool = False
    """Find how delays of the measurements are distributed, which were lost, and the drift of their clock, as well."""
    reveal: bool = True
    """Show the embedded robot's true parameters beside the estimates; the search never sees them."""

    def __post_init__(self) -> None:
        """Check what can be checked before the log is read."""
        super().__post_init__()
        if not 0.0 <= self.held_out <= 0.8:
            raise UsageError(f"held_out must lie in [0, 0.8], got {self.held_out}")
        if self.held_out == 0.0 and not self.hold_out:
            raise UsageError(
                "nothing is held out: an identification that nothing checks is worth nothing",
                hint="set --held-out to a share of the log, or name a log with --hold-out",
            )
        if not (0.0 <= self.settle_s <= 10.0 and 0.2 <= self.horizon_s <= 600.0):
            raise UsageError(
                "settle_s must lie in [0, 10] s and horizon_s in [0.2, 600] s, "
                f"got {self.settle_s} and {self.horizon_s}"
            )
        if self.spacing_s < 0.0:
            raise UsageError(f"spacing_s must not be negative, got {self.spacing_s}")
        if not 0.0 <= self.free_run_s <= 3600.0:
            raise UsageError(f"free_run_s must lie in [0, 3600] s, got {self.free_run_s}")
        if self.folds < 0 or self.folds == 1 or (self.terms == "auto" and not self.folds):
            raise UsageError(
                f"folds must be 0, or 2 and more, got {self.folds} with terms {self.terms!r}",
                hint="terms are chosen by what is left out: --terms auto needs --folds",
            )
