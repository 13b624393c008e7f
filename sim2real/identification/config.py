"""Configuration of a fit; every field is a flag. Does not import JAX, to keep ``--help`` fast."""

from dataclasses import dataclass
from typing import Literal

from sim2real.errors import UsageError


@dataclass(frozen=True)
class FitConfig:
    """From segments of recordings to an estimate: search, then refine."""

    max_delay_s: float = 0.06
    """Longest delay of commands, and longest delay of measurements [s]; the round trip is at most twice as long."""
    initial_state: Literal["free", "measured", "rest"] = "free"
    """State at a segment's start: 'free' fits it, 'measured' estimates it from the samples, 'rest' sets the velocity to
    0.
    """
    skip_s: float = 0.0
    """First part of a segment that is simulated but not compared, so that unmeasured states settle [s]."""
    reach: float = 5.0
    """Residual above which the loss grows less than quadratically [standard deviations of the measurement]; inf:
    nowhere.
    """
    strategy: str = "CMA_ES"
    """Search algorithm: any name in evosax.algorithms."""
    population: int = 32
    """Candidates in each generation of the search."""
    generations: int = 0
    """Most generations of a global search before the refinement from its best candidate and the nominal values."""
    std: float = 0.7
    """Spread of the first generation; 1 covers about half of the range between the bounds."""
    refine_steps: int = 25
    """Largest number of Levenberg-Marquardt steps in a round; a descent has up to four rounds."""
    long_s: float | None = 0.0
    """Length of the segments of a last refinement [s]; 0, or a log shorter than two such segments, skips it. None: 0 if
    commands are goals of positions; else 5 s, as errors of a force add up over a long prediction.
    """
    engine: Literal["auto", "c", "compiled"] = "auto"
    """Simulator: C MuJoCo or the compiled graph; 'auto' takes C if the world is MuJoCo's."""
    difference: float = 1e-3
    """Step of finite differences, as a share of the range between the bounds. Large steps smooth the kinks of friction.
    """
    seed: int = 0
    """Seed of the search."""

    def __post_init__(self) -> None:
        """Check the values before a log is read."""
        if not 0.0 < self.max_delay_s <= 1.0:
            raise UsageError(f"max_delay_s must lie in (0, 1] s, got {self.max_delay_s}")
        if self.population < 4 or self.generations < 0:
            raise UsageError(
                "the search needs a population of 4 at least, and no negative number of generations, got "
                f"{self.population} and {self.generations}"
            )
        if not 1e-5 <= self.difference <= 0.2:
            raise UsageError(f"difference must lie in [0.00001, 0.2], got {self.difference}")
        if not (self.reach > 0.0 and self.std > 0.0):
            raise UsageError(f"reach and std must be above 0, got {self.reach} and {self.std}")
        if not 0.0 <= self.skip_s <= 10.0:
            raise UsageError(f"skip_s must lie in [0, 10] s, got {self.skip_s}")
        if self.refine_steps < 1 or (self.long_s or 0.0) < 0:
            raise UsageError(
                f"refine_steps must be 1 at least and long_s not negative, got {self.refine_steps} and {self.long_s}"
            )
        if not 0 <= self.seed < 2**31:
            raise UsageError(f"seed must lie in [0, 2**31), got {self.seed}")
