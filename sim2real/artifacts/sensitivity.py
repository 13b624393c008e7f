"""Success of a policy if one parameter of its model is wrong: ``sensitivity.json`` of the train stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim2real.artifacts.files import check, read_versioned, write_json
from sim2real.artifacts.summary import ArtifactTable

FORMAT = 1
SENSITIVITY = "sensitivity.json"
BROKEN = 0.8
"""A parameter breaks a policy if success falls below this share of the success on the identified model."""
_MIN_SUCCESS = 0.5
"""Below this success on the identified model, the policy needs more training first."""
_AGAIN = "run `sim2real train` again"


@dataclass(frozen=True)
class Moved:
    """Success with one parameter at several values; the others follow by their covariance.

    Attributes:
        estimate: The estimate [unit].
        half_width: Half the width of its 95 % interval [unit].
        values: Shape ``(M,)``: values within the bounds [unit].
        success: Shape ``(M,)``: mean success at these values.
    """

    name: str
    unit: str
    estimate: float
    half_width: float
    values: np.ndarray
    success: np.ndarray


@dataclass(frozen=True)
class Sensitivity:
    """A policy's success on models in which one parameter is wrong.

    Attributes:
        multiples: Shape ``(M,)``: distances from the estimate, in half-widths of the 95 % interval, ascending.
        success: Mean success on the identified model.
        episodes: Number of episodes of each mean; all values use the same episodes.
        parameters: The parameters, the most harmful first.
    """

    format: int
    multiples: np.ndarray
    success: float
    episodes: int
    parameters: tuple[Moved, ...]

    def __post_init__(self) -> None:
        """Check the sizes, because the curves may come from a file."""
        count = self.multiples.shape
        check(len(count) == 1 and count[0] > 0, "no multiples")
        check(all(p.values.shape == p.success.shape == count for p in self.parameters), "curves of mixed sizes")

    @staticmethod
    def of(multiples: np.ndarray, success: float, episodes: int, parameters: Sequence[Moved]) -> Sensitivity:
        """Return the sensitivity with its parameters sorted, the most harmful first."""
        unsorted = Sensitivity(FORMAT, multiples, success, episodes, tuple(parameters))
        worst = sorted(parameters, key=lambda p: (abs(unsorted.breaks_at(p) or np.inf), float(p.success.min())))
        return Sensitivity(FORMAT, multiples, success, episodes, tuple(worst))

    def breaks_at(self, moved: Moved) -> float | None:
        """Return the smallest multiple at which a parameter breaks the policy, with its sign; None if there is none."""
        broken = self.multiples[moved.success < BROKEN * self.success]
        return float(min(broken, key=abs)) if broken.size else None

    @property
    def advice(self) -> str:
        """The parameter that should be measured better, in one sentence."""
        largest = f"{np.abs(self.multiples).max():g}"
        if not self.parameters:
            return "No parameter has an interval, so none was moved."
        worst = self.parameters[0]
        lowest = float(worst.success.min())
        # A policy that fails on the identified model needs more training first.
        if self.success < _MIN_SUCCESS:
            return f"The success on the identified model is only {self.success:.2f}: train longer first."
        if (at := self.breaks_at(worst)) is None:
            unbroken = f"No parameter breaks this policy within {largest} half-widths of its 95 % interval"
            if lowest >= self.success:
                return f"{unbroken}: success stays {self.success:.2f}, whichever is moved."
            return (
                f"{unbroken}: success stays above {BROKEN:.0%} of {self.success:.2f}, and is lowest, {lowest:.2f}, "
                f"with {worst.name!r} moved."
            )
        # Name the smallest move that breaks the policy.
        i = int(np.flatnonzero(self.multiples == at)[0])
        return (
            f"Measure {worst.name!r} better: {abs(at):g} half-width{'s' if abs(at) != 1 else ''} of its 95 % interval "
            f"{'above' if at > 0 else 'below'} the estimate, at {worst.values[i]:.4g} {worst.unit}, success falls from "
            f"{self.success:.2f} to {worst.success[i]:.2f}."
        )

    def rows(self) -> ArtifactTable:
        """Return a row for each parameter: estimate, half-width, the multiple that breaks the policy, success."""
        headers = ("parameter", "unit", "estimate", "half-width", "breaks at", *(f"{m:+g}" for m in self.multiples))
        rows = []
        for p in self.parameters:
            at = self.breaks_at(p)
            success = [f"{s:.2f}" for s in p.success]
            rows.append([p.name, p.unit, p.estimate, p.half_width, None if at is None else f"{at:+g}", *success])
        return ArtifactTable(headers, rows)

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, self)

    @staticmethod
    def load(path: Path) -> Sensitivity:
        """Read the file, or the one in the folder of a train stage.

        Raises:
            Sim2RealError: When the file is missing, malformed, or of another format.
        """
        return read_versioned(path / SENSITIVITY if path.is_dir() else path, Sensitivity, _AGAIN, FORMAT)
