"""How files of other recorders become logs; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from sim2real.errors import UsageError


@dataclass(frozen=True)
class ImportConfig:
    """Turn files of other recorders into logs, one for each file."""

    files: Annotated[Positional[tuple[Path, ...]], arg(metavar="FILE...")] = ()
    """Files of other recorders: npz, JSON, CSV, MCAP or the folder of a ROS 2 bag, or a LeRobot data set."""
    mapping: Path | None = None
    """TOML file that maps signals to fields; default: the pipeline's import.toml, or one is proposed."""
    mjcf: Path | None = None
    """Model of the robot (MJCF or URDF), for the names and ranges of its joints."""
    joints: tuple[str, ...] = ()
    """Joints that were recorded, in the order of the columns; default: all of the model's, in its order."""
    rate_hz: float | None = None
    """Samples per second, where a file has no time stamps [Hz]."""
    together: bool = False
    """All files are of one recording: a log of all of them instead of one for each."""
    as_told: bool = False
    """Keep names, order and signs of the file or the mapping, even if the data contradicts them or is ambiguous."""
    pipeline: str | None = None
    """Pipeline that the logs are for; default: the one that the mapping names, or the model's name."""
    format: Literal["npz", "json", "csv", "lerobot", "mcap"] | None = None
    """Format of the files; default: by their suffixes."""
    episode: int | None = None
    """Episode of a LeRobot data set; default: the only one."""
    samples: Annotated[str | None, arg(metavar="A:B")] = None
    """Take the samples from A to just before B, counted from 0; default: all."""
    out: Path | None = None
    """Log to write; default: one in a run folder of its own, as record makes it."""
    runs: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        """Check what can be checked before a file is read."""
        if self.samples is not None and not re.fullmatch(r"(-?\d+)?:(-?\d+)?", self.samples):
            raise UsageError(
                f"samples must be a range A:B of whole numbers, got {self.samples!r}", hint="such as 0:20000 or 500:"
            )
        if self.out is not None and len(self.files) > 1 and not self.together:
            raise UsageError(f"out names one log, but there are {len(self.files)} files", hint="import them one by one")

    @property
    def sources(self) -> tuple[Path, ...]:
        """The files, at least one."""
        if not self.files:
            raise UsageError("import needs a file of another recorder", hint="sim2real import FILE... --pipeline NAME")
        return self.files

    @property
    def selection(self) -> slice | None:
        """The range of samples; None: all."""
        return slice(*(int(end) if end else None for end in self.samples.split(":"))) if self.samples else None
