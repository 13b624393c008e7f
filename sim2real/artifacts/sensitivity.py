"""How well a policy does when one parameter of its model is wrong: ``sensitivity.json`` of the train stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim2real.artifacts.files import check, malformed, read_json, write_json
from sim2real.errors import Sim2RealError

FORMAT = 1
SENSITIVITY = "sensitivity.json"
BROKEN = 0.8
"""A policy counts as broken where its success is below this share of what it is on the model as identified."""
_TRAINED = 0.5
"""Least success of a policy of which it makes sense to ask what breaks it."""
_AGAIN = "run `sim2real train` again"


@dataclass(frozen=True)
class Moved:
    """One parameter, moved; the others follow as the recording ties them together.

    Attributes:
        name: Its name.
        unit: Its unit.
        estimate: The value found [unit].
        half_width: Half the width of its 95 % interval [unit].
        values: Shape ``(M,)``: what it was moved to, within its bounds [unit].
        success: Shape ``(M,)``: mean success there.
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
        format: Of the file.
        multiples: Shape ``(M,)``: by how many half-widths of its 95 % interval each parameter was moved, ascending.
        success: Mean success on the model as identified.
        episodes: Episodes of which each success is the mean; the same ones for all.
        parameters: The parameters, the worst first.
    """

    format: int
    multiples: np.ndarray
    success: float
    episodes: int
    parameters: tuple[Moved, ...]

    def __post_init__(self) -> None:
        """Check that the sizes fit: it may come from a file."""
        count = self.multiples.shape
        check(len(count) == 1 and count[0] > 0, "no multiples")
        check(all(p.values.shape == p.success.shape == count for p in self.parameters), "curves of mixed sizes")

    @staticmethod
    def of(multiples: np.ndarray, success: float, episodes: int, parameters: Sequence[Moved]) -> Sensitivity:
        """Return the parameters in the order in which they break the policy.

        Args:
            multiples: Shape ``(M,)``.
            episodes: Episodes of which each success is the mean.
            parameters: The parameters, in any order.
        """
        found = Sensitivity(FORMAT, multiples, success, episodes, tuple(parameters))
        worst = sorted(found.parameters, key=lambda p: (abs(found.breaks_at(p) or np.inf), float(p.success.min())))
        return Sensitivity(FORMAT, multiples, success, episodes, tuple(worst))

    def breaks_at(self, moved: Moved) -> float | None:
        """Return the smallest multiple at which a parameter breaks the policy, with its sign; None: at none."""
        broken = self.multiples[moved.success < BROKEN * self.success]
        return float(min(broken, key=abs)) if broken.size else None

    @property
    def said(self) -> str:
        """What to measure better, in one sentence."""
        most = f"{np.abs(self.multiples).max():g}"
        if not self.parameters:
            return "No parameter has an interval to be moved by."
        worst = self.parameters[0]
        lowest = float(worst.success.min())
        if self.success < _TRAINED:
            return f"The policy does badly on the model as identified already ({self.success:.2f}): train longer first."
        if (at := self.breaks_at(worst)) is None:
            return (
                f"Nothing within {most} half-widths of the 95 % intervals breaks this policy: success stays above "
                f"{BROKEN:.0%} of {self.success:.2f}, and is lowest, {lowest:.2f}, with {worst.name!r} moved."
            )
        i = int(np.flatnonzero(self.multiples == at)[0])
        return (
            f"Measure {worst.name!r} better: {abs(at):g} half-width{'s' if abs(at) != 1 else ''} of its 95 % interval "
            f"{'above' if at > 0 else 'below'} the estimate, at {worst.values[i]:.4g} {worst.unit}, success falls from "
            f"{self.success:.2f} to {worst.success[i]:.2f}."
        )

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, self)

    @staticmethod
    def load(path: Path) -> Sensitivity:
        """Read what ``save`` wrote, or the one in the folder of a train stage.

        Raises:
            Sim2RealError: When it is missing, of another format, or not as it should be.
        """
        file = path / SENSITIVITY if path.is_dir() else path
        with malformed(file, _AGAIN):
            found = read_json(file, Sensitivity)
            if found.format != FORMAT:
                raise Sim2RealError(f"{file} has format {found.format}, this version reads {FORMAT}", hint=_AGAIN)
            return found
