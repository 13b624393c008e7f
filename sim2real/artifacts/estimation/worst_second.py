"""The second of the recordings in which the identified model explains a joint worst."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim2real.artifacts.run.run_folder import Source

_WINDOW_S = 1.0
_UNEXPLAINED = 0.5
"""Share of a joint's motion from which an error means that the model does not explain the second."""
_SMALLER = {"rad": "mrad", "m": "mm", "s": "ms"}
"""Unit -> a thousandth of it, for errors below 1."""


@dataclass(frozen=True)
class WorstSecond:
    """The worst second of the joint that the identified model explains worst.

    Attributes:
        column: Its position's name among the columns of the samples.
        begin_s: Start of the second in the recording [s].
        end_s: Its end [s]; a shorter segment has a shorter one.
        rmse: Root mean square of the residual in it; None if the model diverges.
        times_noise: The same in deviations of a measurement; None if the model diverges.
        of_motion: The same as a share of the motion, the deviation of all measured positions of the joint in the
            recording; None if the model diverges.
    """

    name: str
    column: str
    unit: str
    recording: int
    segment: int
    begin_s: float
    end_s: float
    rmse: float | None
    times_noise: float | None
    of_motion: float | None

    @property
    def unexplained(self) -> bool:
        """Whether the model does not explain this second: a fault of the log, of the robot or of the model."""
        return self.of_motion is None or self.of_motion >= _UNEXPLAINED

    @property
    def error(self) -> str:
        """The error with its unit."""
        return "the model diverges" if self.rmse is None else with_small_unit(self.rmse, self.unit)

    def text(self, logs: Sequence[Source]) -> str:
        """Return joint, time and error on one line; of several recordings with the name of its file."""
        log = logs[self.recording].path.replace("\\", "/").rsplit("/", 1)[-1] if len(logs) > 1 else ""
        at = f"{self.begin_s:.1f} s" + (f" of {log}" if log else "")
        return f"joint {self.name}, {at}, {self.error}"


def with_small_unit(value: float, unit: str) -> str:
    """Return an error with its unit, below 1 rad, m or s in thousandths."""
    if unit in _SMALLER and abs(value) < 1.0:
        value, unit = 1e3 * value, _SMALLER[unit]
    return f"{value:.{max(2, len(str(int(abs(value)))))}g} {unit}".rstrip()


def worst_window(t_s: np.ndarray, squares: np.ndarray) -> tuple[float, float, float]:
    """Return begin [s], end [s] and root mean square error of the worst second; infinite if an error is not finite.

    Args:
        t_s: Times ``(N,)`` [s].
        squares: Squared errors ``(N,)``.
    """
    if not np.isfinite(squares).all():
        bad = int(np.flatnonzero(~np.isfinite(squares))[0])
        last = np.searchsorted(t_s, t_s[bad] + _WINDOW_S, side="right") - 1
        return float(t_s[bad]), float(t_s[last]), math.inf
    sums = np.concatenate([[0.0], np.cumsum(squares)])
    # Windows begin at each sample that has a whole second after it, and at the first sample of shorter series.
    first = np.flatnonzero(t_s <= max(float(t_s[-1]) - _WINDOW_S, float(t_s[0])) + 1e-9)
    after = np.searchsorted(t_s, t_s[first] + _WINDOW_S + 1e-9, side="right")
    means = (sums[after] - sums[first]) / (after - first)
    worst = int(means.argmax())
    return float(t_s[first[worst]]), float(t_s[after[worst] - 1]), math.sqrt(max(float(means[worst]), 0.0))
