"""Flags of import. Imports no JAX, so that ``--help`` stays instant."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sim2real.errors import UsageError
from sim2real.stages.flag import Flag, check_rate


@dataclass(frozen=True)
class ImportConfig:
    """Turn files of other recorders into logs, one for each file."""

    files: Annotated[tuple[Path, ...], Flag("FILE...", positional=True, needed=True)] = ()
    """Files of other recorders: npz, JSON, CSV, MCAP or the folder of a ROS 2 bag, or a LeRobot data set."""
    mapping: Path | None = None
    """TOML file that maps signals to fields; default: the pipeline's import.toml; without one, a mapping is proposed.
    """
    pipeline: Annotated[str | None, Flag(also="--like")] = None
    """Pipeline of the recorded robot, which has its joints; default: the mapping's pipeline, or the model's name."""
    mjcf: Path | None = None
    """Model of the robot (MJCF or URDF), for the names and ranges of its joints."""
    joints: tuple[str, ...] = ()
    """Joints that were recorded, by their names in the file, or in the order of columns without names."""
    unit: str | None = None
    """Unit of positions and goals in the file, if their names have no unit: rad, deg, rev, mrad, m, mm, counts:N (N per
    turn), or hundredths of LeRobot's calibrated ranges.
    """
    calibration: Path | None = None
    """LeRobot's calibration of the arm, written by lerobot-calibrate."""
    rate_hz: float | None = None
    """Samples per second, if a file has no time stamps [Hz]."""
    together: bool = False
    """All files belong to one recording: write one log of all files instead of one for each."""
    as_told: bool = False
    """Keep order, signs and units of the file or the mapping, even if the data contradict them or fit others."""
    episode: int | None = None
    """Episode of a LeRobot data set; default: all."""
    samples: Annotated[str | None, Flag("A:B")] = None
    """Take the samples from A to just before B, counted from 0; default: all."""
    out: Path | None = None
    """Log to write; default: a log in a new run folder, as record makes it."""
    runs: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        """Check what can be checked before a file is read."""
        check_rate(self.rate_hz)
        if self.samples is not None and not re.fullmatch(r"(-?\d+)?:(-?\d+)?", self.samples):
            raise UsageError(
                f"samples must be a range A:B of whole numbers, got {self.samples!r}", hint="such as 0:20000 or 500:"
            )
        if self.out is not None and len(self.files) > 1 and not self.together:
            raise UsageError(f"out names one log, but there are {len(self.files)} files", hint="import them one by one")
        if self.unit is not None:
            from sim2real.log.importing.mapping import LENGTHS_AND_ANGLES  # imported late: --help needs no numpy

            if not re.fullmatch(f"{'|'.join(LENGTHS_AND_ANGLES)}|counts:[1-9][0-9]*|hundredths", self.unit):
                raise UsageError(
                    f"unknown unit {self.unit!r}. Available: {', '.join(LENGTHS_AND_ANGLES)}, counts:N, hundredths",
                    hint="counts:4096 for an encoder with 4096 counts a turn",
                )

    @property
    def selection(self) -> slice | None:
        """The range of samples; None: all."""
        return slice(*(int(end) if end else None for end in self.samples.split(":"))) if self.samples else None
