"""What the episodes of training are drawn from, beside what was recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from sim2real.artifacts.estimation.noise import Noise
from sim2real.artifacts.files import check, malformed, read_arrays, read_json, write_arrays, write_json
from sim2real.errors import Sim2RealError

FORMAT = 1
EPISODES, DRAWS = "episodes.json", "episodes.npz"
_ARRAYS = ("draws", "recorded_s", "drawn_s", "off")
_AGAIN = "run `sim2real train` again"


@dataclass(frozen=True)
class Varied:
    """A parameter that differs between episodes.

    Attributes:
        name: Its name.
        unit: Its unit.
        value: The value that was identified, or the data sheet's.
        low95: Lower end of the 95 % interval that was identified; None: there is none.
        high95: Its upper end.
        open: Whether the recordings left it open, so that it is drawn from all of its bounds.
    """

    name: str
    unit: str
    value: float
    low95: float | None = None
    high95: float | None = None
    open: bool = False


@dataclass(frozen=True)
class Episodes:
    """What the episodes of a training are drawn from.

    Attributes:
        parameters: What differs between episodes, in the order of the table; pushes and starts too.
        widening: Factor on the deviations of the posterior for what the model leaves unexplained.
        noise: What the sensor's readings have on top of the motion.
        timelines: How many timelines the episodes share.
        cut: How many of them end before a pause that a program cannot hold.
        again: How many were drawn again, as such a pause came in their first half.
        longest_pause_s: Longest time between two policy steps [s].
        push_hz: Pushes of each joint in a second [Hz]; 0: none.
        curriculum: Share of all differences between episodes at the first and at the last update.
        draws: Parameter -> what was drawn ``(K,)``.
        recorded_s: Node -> what its steps took on the robot ``(N,)`` [s].
        drawn_s: Node -> what they take in the timelines ``(M,)`` [s].
        off: Column of ``noise`` -> how far measurements lay off the identified model ``(N,)``, in its unit.
        format: Version of the files.
    """

    parameters: tuple[Varied, ...]
    widening: float = 1.0
    noise: tuple[Noise, ...] = ()
    timelines: int = 0
    cut: int = 0
    again: int = 0
    longest_pause_s: float = 0.0
    push_hz: float = 0.0
    curriculum: tuple[float, float] = (1.0, 1.0)
    draws: Mapping[str, np.ndarray] = field(default_factory=dict)
    recorded_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    drawn_s: Mapping[str, np.ndarray] = field(default_factory=dict)
    off: Mapping[str, np.ndarray] = field(default_factory=dict)
    format: int = FORMAT

    def save(self, folder: Path) -> dict[str, str]:
        """Write it into a folder.

        Returns:
            Output -> name of the file in the folder.
        """
        write_json(folder / EPISODES, {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS})
        write_arrays(folder / DRAWS, {f"{kind}/{n}": v for kind in _ARRAYS for n, v in getattr(self, kind).items()})
        return {"episodes": EPISODES, "episodes_draws": DRAWS}

    @staticmethod
    def load(path: Path) -> Episodes:
        """Read what ``save`` wrote into a folder.

        Raises:
            Sim2RealError: When it is missing, of another format, or not as it should be.
        """
        with malformed(path / EPISODES, _AGAIN):
            found = read_json(path / EPISODES, Episodes)
            if found.format != FORMAT:
                raise Sim2RealError(f"{path} has format {found.format}, this version reads {FORMAT}", hint=_AGAIN)
        with malformed(path / DRAWS, _AGAIN):
            kinds: dict[str, dict[str, np.ndarray]] = {kind: {} for kind in _ARRAYS}
            for name, values in read_arrays(path / DRAWS).items():
                kind, _, of = name.partition("/")
                check(kind in kinds and values.ndim == 1 and values.dtype.kind == "f", f"{name} is no list of numbers")
                kinds[kind][of] = values
            check(set(kinds["draws"]) == {p.name for p in found.parameters}, "draws of other parameters")
        return replace(found, **kinds)
