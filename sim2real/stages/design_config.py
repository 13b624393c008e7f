"""What the design of an excitation can be told; every field is a flag. Imports no JAX."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from sim2real.errors import UsageError
from sim2real.stages.config import RecordConfig
from sim2real.stages.train_config import check_seed


@dataclass(frozen=True)
class DesignConfig:
    """Design the commands of the next recording for what is still uncertain; nothing moves."""

    parameters: Annotated[Path | None, arg(metavar="FILE")] = None
    """parameters.json, or the folder of an identification, to start from; default: the newest identification of the
    pipeline, and without any the data sheet with its bounds."""
    forget: bool = False
    """Take the identified values, but not that they are certain: for a robot that has changed since."""
    duration_s: float = 40.0
    """Length of the recording [s]."""
    motion_s: float = 8.0
    """About the length of a motion; the design is a row of motions [s]."""
    motions: int = 100
    """Motions that are drawn by chance, and simulated; those are chosen that together tell most."""
    margin: float = 0.9
    """Share of the gate's limits that goals of joints, slew and the predicted motion may use; other commands, such as
    voltages, may use all."""
    seed: int = 0
    """Seed of the motions."""
    record: RecordConfig = field(default_factory=RecordConfig)
    """The excitation that it is compared with, whose band is widened by a factor of two, and the gate's limits."""

    def __post_init__(self) -> None:
        """Check what can be checked before anything is simulated."""
        check_seed(self.seed)
        if not 1.0 <= self.motion_s <= self.duration_s <= 3600.0:
            raise UsageError(
                "the design needs 1 s <= motion_s <= duration_s <= 3600 s, "
                f"got {self.motion_s:g} and {self.duration_s:g} s"
            )
        if self.motions * self.motion_s < self.duration_s:
            raise UsageError(
                f"{self.motions} motions of {self.motion_s:g} s are too few to choose {self.duration_s:g} s from",
                hint="raise --motions",
            )
        if self.record.excitation == "designed":
            raise UsageError(
                "a design is compared with an excitation that is none", hint="--record.excitation multisine, or another"
            )
        if not 0.1 <= self.margin <= 1.0:
            raise UsageError(f"margin must lie in [0.1, 1], got {self.margin}")
