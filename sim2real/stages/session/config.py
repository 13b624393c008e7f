"""How the robot is moved and recorded; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from sim2real.errors import UsageError
from sim2real.hardware.safety.gate import GateLimits
from sim2real.stages.flag import Flag, ViewFlag, check_seed, check_view

GENERATED, HAND, STANDING = ("multisine", "chirp", "steps"), "hand", "standing"
_FILES = (".mcap", ".csv", ".npz", ".json", ".parquet")


@dataclass(frozen=True)
class SessionConfig:
    """Settings of every session with the robot."""

    port: Annotated[str, Flag("PORT")] = "embedded"
    """Serial port of the servo bus, or 'embedded' for the emulated robot."""
    duration_s: float = 10.0
    """Length of an episode [s]."""
    seed: int = 0
    """Seed of the embedded robot, and of the excitation of a recording."""
    dry_run: bool = False
    """Do everything except move the robot: torque stays off, no goals are sent; the log has the withheld commands."""
    strict_timing: bool = False
    """End with code 5 when more than 1 % of the steps miss their deadline."""
    view: ViewFlag = None
    """Show the robot live in the Rerun viewer; 'web': on a page for browsers."""
    gate: GateLimits = field(default_factory=GateLimits)
    """Limits on every command."""

    def __post_init__(self) -> None:
        """Check what can be checked before anything moves."""
        check_seed(self.seed)
        check_view(self.view)
        if not 1.0 <= self.duration_s <= 3600.0:
            raise UsageError(f"duration_s must lie in [1, 3600] s, got {self.duration_s}")


@dataclass(frozen=True)
class RecordConfig(SessionConfig):
    """Record the robot under an excitation."""

    duration_s: float = 40.0
    """Length of the recording [s]."""
    excitation: Annotated[str, Flag("multisine|chirp|steps|hand|standing|FILE")] = "multisine"
    """Command signal, or a file with a motion: a log, or csv, npz or parquet with columns named by joint; 'hand':
    torque stays off, a person moves the robot; 'standing': a robot on legs stands up and bends its legs.
    """
    amplitude: float = 1.8
    """Largest command of the excitation [the actuator's unit; V for the pendulum]."""
    low_hz: float = 0.2
    """Lowest frequency of the excitation [Hz]."""
    high_hz: float = 3.0
    """Highest frequency of the excitation [Hz]."""

    @property
    def by_hand(self) -> bool:
        """Whether torque stays off and a person moves the robot."""
        return self.excitation == HAND

    @property
    def standing(self) -> bool:
        """Whether a robot on legs is recorded while it stands."""
        return self.excitation == STANDING

    @property
    def motion(self) -> Path | None:
        """The file whose motion is played; None for a generated excitation."""
        return Path(self.excitation) if Path(self.excitation).suffix in _FILES else None

    def __post_init__(self) -> None:
        """Check what can be checked before anything moves."""
        super().__post_init__()
        if self.excitation not in (*GENERATED, HAND, STANDING) and self.motion is None:
            raise UsageError(
                f"--excitation {self.excitation} is neither {', '.join(GENERATED)}, {HAND} nor {STANDING}, nor a file",
                hint="a motion is a log (.mcap), or a .csv, .npz, .json or .parquet file",
            )
        if not 0.0 < self.low_hz < self.high_hz:
            raise UsageError(f"the excitation needs 0 < low_hz < high_hz, got {self.low_hz} and {self.high_hz} Hz")
        if self.excitation in GENERATED and not 0.0 < self.amplitude <= self.gate.limit:
            raise UsageError(
                f"the amplitude must lie in (0, {self.gate.limit}], got {self.amplitude}",
                hint="the limit stands in the robot's file: gate.limit of its RecordConfig",
            )
