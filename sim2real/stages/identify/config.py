"""Configuration of an identification; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from dataclasses import dataclass, field
from typing import Annotated

from sim2real.errors import UsageError
from sim2real.identification.config import FitConfig
from sim2real.stages.flag import Flag


@dataclass(frozen=True)
class IdentifyConfig(FitConfig):
    """Identify dynamics, delays and initial states from logs."""

    log: Annotated[tuple[str, ...], Flag("FILE ...")] = ()
    """Logs to identify from; default: the newest finished recording of the pipeline."""
    begin: Annotated[str | None, Flag("FILE")] = None
    """File at whose values the search begins: parameters.json or partial.json of an identification; default: data
    sheet."""
    hold_out: Annotated[tuple[str, ...], Flag("FILE ...")] = ()
    """Logs that are held out: predicted, not fitted."""
    standing: Annotated[str | None, Flag("FILE")] = None
    """Log of a robot on its feet (`record --excitation standing`), from which its load is estimated."""
    settle_s: float = 0.3
    """Length of the first part of a held-out segment, to which its initial state is fitted [s]."""
    horizon_s: float = 1.0
    """Horizon of predictions: length of a held-out segment after its first part [s]."""
    spacing_s: float = 0.0
    """Distance between the starts of fitted segments [s]; 0 puts them side by side."""
    after_s: float = 0.0
    """Length of the first part of each log that is not used, such as the way to the start of the excitation [s]."""
    held_out: float = 0.25
    """Share of each log, at its end, that is held out; 0 if whole logs are held out."""
    free_run_s: float = 10.0
    """Longest free run: a prediction of a held-out part from one initial state [s]."""
    folds: int = 5
    """Number of parts that are held out of a refit, one at a time, to measure errors on new data: each log is a part, a
    single log is cut into this many; 0 skips the refits.
    """
    terms: str = "own"
    """Optional terms: 'own' (the pipeline's, and one that halves the errors on held-out parts), 'auto' (chosen on
    held-out parts), 'all', 'none', or names separated by commas."""
    bounds: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Bounds of a parameter instead of the pipeline's; repeat the flag for each parameter."""
    fix: dict[str, float] = field(default_factory=dict)
    """Value at which a parameter is fixed; repeat the flag for each parameter."""
    world: str | None = None
    """World of an installed package in which to identify; default: the robot's."""
    links: bool = False
    """Also estimate the distribution of the measurements' delay, and the share of lost messages."""

    def __post_init__(self) -> None:
        """Check the values before a log is read."""
        super().__post_init__()
        if not 0.0 <= self.held_out <= 0.8:
            raise UsageError(f"held_out must lie in [0, 0.8], got {self.held_out}")
        if self.held_out == 0.0 and not self.hold_out:
            raise UsageError(
                "held_out is 0 and no log is held out: an identification must be checked on a held-out part",
                hint="set --held-out to a share of the log, or name a log with --hold-out",
            )
        if not (0.0 <= self.settle_s <= 10.0 and 0.2 <= self.horizon_s <= 600.0):
            raise UsageError(
                "settle_s must lie in [0, 10] s and horizon_s in [0.2, 600] s, "
                f"got {self.settle_s} and {self.horizon_s}"
            )
        if min(self.spacing_s, self.after_s) < 0.0:
            raise UsageError(f"spacing_s and after_s must not be negative, got {self.spacing_s} and {self.after_s}")
        if not 0.0 <= self.free_run_s <= 3600.0:
            raise UsageError(f"free_run_s must lie in [0, 3600] s, got {self.free_run_s}")
        if self.folds < 0 or self.folds == 1 or (self.terms == "auto" and not self.folds):
            raise UsageError(
                f"folds must be 0, or 2 and more, got {self.folds} with terms {self.terms!r}",
                hint="--terms auto chooses terms on held-out parts and needs --folds",
            )
