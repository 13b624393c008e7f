"""A designed excitation: ``excitation.json`` says what it is for, ``excitation.npz`` holds its commands."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim2real.artifacts.files import check, malformed, read_arrays, read_json, write_arrays, write_json
from sim2real.artifacts.run_folder import Source
from sim2real.errors import Sim2RealError

FORMAT = 1
DESIGN, COMMANDS = "excitation.json", "excitation.npz"
_AGAIN = "make it anew with `sim2real design PIPELINE`"


@dataclass(frozen=True)
class Expected:
    """How far a parameter's 95 % interval reaches, as a share of its value; of a delay, of its bounds' width.

    Attributes:
        name: The parameter.
        now: By what is known now.
        after_other: With one more recording of the usual excitation, of the same length.
        after: With one of the design.
    """

    name: str
    now: float
    after_other: float
    after: float


@dataclass(frozen=True)
class Design:
    """Commands that were designed for what is still uncertain.

    Attributes:
        pipeline: The robot.
        known: The identification that it was designed after; None: the data sheet alone.
        rate_hz: Commands per second [Hz].
        other: The usual excitation that it is compared with.
        expected: Intervals to expect.
        speed: Joint -> highest predicted speed [rad/s].
        commands: Shape ``(N, actions)``: one a step, as ``Robot.around`` returns them [the command's unit].
        rest: Shape ``(actions,)``: the command of a robot at rest, around which an excitation is played.
        low: Shape ``(actions,)``: lowest commands of the gate.
        high: Shape ``(actions,)``: highest.
        t_s: Shape ``(T,)``: times of the predicted motion [s].
        predicted: Shape ``(T, joints)``: positions [rad].
        format: Version of the file.
    """

    pipeline: str
    known: Source | None
    rate_hz: float
    other: str
    expected: tuple[Expected, ...]
    speed: dict[str, float]
    commands: np.ndarray = field(default_factory=lambda: np.zeros((0, 1)))
    rest: np.ndarray = field(default_factory=lambda: np.zeros(1))
    low: np.ndarray = field(default_factory=lambda: np.zeros(1))
    high: np.ndarray = field(default_factory=lambda: np.zeros(1))
    t_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    predicted: np.ndarray = field(default_factory=lambda: np.zeros((0, 1)))
    format: int = FORMAT

    @property
    def gain(self) -> float:
        """Median over the parameters of the interval to expect, as a share of that after the usual excitation."""
        return float(np.median([e.after / e.after_other for e in self.expected]))

    def save(self, folder: Path) -> dict[str, str]:
        """Write it into a folder; return output -> name of the file in the folder."""
        arrays = {n: getattr(self, n) for n in _ARRAYS}
        write_json(folder / DESIGN, {n: v for n, v in vars(self).items() if n not in arrays})
        write_arrays(folder / COMMANDS, arrays)
        return {"design": DESIGN, "commands": COMMANDS}

    @staticmethod
    def load(path: Path) -> Design:
        """Read what ``save`` wrote, from its folder or a file in it.

        Raises:
            Sim2RealError: When it is missing, of another format, or not as it should be.
        """
        folder = path if path.is_dir() else path.parent
        file = folder / DESIGN
        with malformed(file, _AGAIN):
            found = read_json(file, Design)
            if found.format != FORMAT:
                raise Sim2RealError(f"{file} has format {found.format}, this version reads {FORMAT}", hint=_AGAIN)
        with malformed(folder / COMMANDS, _AGAIN):
            arrays = read_arrays(folder / COMMANDS)
            known = {n: np.asarray(arrays[n], np.float64) for n in _ARRAYS}
            good = known["commands"].ndim == 2 and len(known["commands"]) > 1 and np.isfinite(known["commands"]).all()
            check(bool(good), "the commands are not one finite row a step")
        return Design(**{**vars(found), **known})


_ARRAYS = ("commands", "rest", "low", "high", "t_s", "predicted")
