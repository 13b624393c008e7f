"""Flags of ``new`` that describe a robot with a model and a log. Imports no JAX."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from sim2real.stages.flag import Flag, check_rate


@dataclass(frozen=True)
class RobotFlags:
    """Description of a robot with a model and a log."""

    mjcf: Annotated[Path | None, Flag("FILE")] = None
    """Model of the robot: MJCF or URDF."""
    joints: tuple[str, ...] = ()
    """Joints that were recorded, in the order of the columns; default: all of the model's, in its order."""
    parameter: tuple[str, ...] = ()
    """Identified quantity: WHAT[:each][@PATTERN][=VALUE], such as frictionloss:each or kp@.*_calf_joint; =VALUE fixes
    it. Repeat the flag for each quantity. An unknown WHAT is refused, with a list of the available ones.
    """
    mapping: Annotated[Path | None, Flag("FILE")] = None
    """Mapping of a log of another recorder; default: one is proposed."""
    rate_hz: float | None = None
    """Samples per second, if the log has no time stamps [Hz]."""
    unit: str | None = None
    """Unit of positions and goals in the log, if names have none: rad, deg, rev, mrad or counts:N (N per turn)."""
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
    """Body that holds the payload, if the logs have a field payload [kg]; default: the last joint's body."""
    as_told: bool = False
    """Keep names, order and signs of the file or the mapping, even if the data contradicts them or is ambiguous."""

    def __post_init__(self) -> None:
        """Check the flags."""
        check_rate(self.rate_hz)
