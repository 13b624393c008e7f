"""What describes a robot beside its model and log; every field is a flag of ``new``. Imports no JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sim2real.stages.flag import Flag, check_rate


@dataclass(frozen=True)
class RobotFlags:
    """A robot that its model, a log and flags describe."""

    mjcf: Annotated[Path | None, Flag("FILE")] = None
    """Model of the robot: MJCF or URDF."""
    joints: tuple[str, ...] = ()
    """Joints that were recorded, in the order of the columns; default: all of the model's, in its order."""
    parameter: tuple[str, ...] = ()
    """Identified quantity: WHAT[:each][@PATTERN][=VALUE], one flag a quantity, such as frictionloss:each or
    kp@.*_calf_joint; with =VALUE it is held. An unknown WHAT is refused; the error lists the available ones."""
    mapping: Annotated[Path | None, Flag("FILE")] = None
    """Mapping of the log, if it is of another recorder; default: one is proposed."""
    rate_hz: float | None = None
    """Samples per second, where the log has no time stamps [Hz]."""
    unit: str | None = None
    """Unit of positions and goals in the log, where names have none: rad, deg, rev, mrad or counts:N (N a turn)."""
    velocity: bool = False
    """Compare measured velocities, too."""
    step_s: float = 0.0
    """Time step of the simulation [s]; 0: the model's own, between 0.5 and 5 ms."""
    fix_base: bool = False
    """Hold a floating base at its position in the model, as on a stand."""
    contacts: bool = False
    """Simulate contacts."""
    hold: tuple[str, ...] = ()
    """Positions of joints that were not recorded: JOINT=VALUE [rad or m], or a keyframe; default: keyframe home."""
    payload_body: str = ""
    """Body that holds the payload of each log, if the logs have a field payload [kg]; default: that of the last
    joint."""
    as_told: bool = False
    """Keep names, order and signs of the file or the mapping, even if the data contradicts them or is ambiguous."""

    def __post_init__(self) -> None:
        """Check the flags."""
        check_rate(self.rate_hz)
