"""A robot that flags describe instead of a pipeline; every field is a flag. Imports no JAX: ``--help`` is instant."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from sim2real.stages.identify.config import IdentifyConfig


@dataclass(frozen=True)
class RobotFlags:
    """A robot without a pipeline, described by its model and flags."""

    mjcf: Annotated[Path | None, arg(metavar="FILE")] = None
    """Model of the robot: MJCF or URDF."""
    joints: tuple[str, ...] = ()
    """Joints that were recorded, in the order of the columns; default: all of the model's, in its order."""
    parameter: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Identified quantity: WHAT[:each][@PATTERN][=VALUE], one flag a quantity, such as frictionloss:each or
    kp@.*_calf_joint; with =VALUE it is held. An unknown WHAT is refused; the error lists the available ones."""
    mapping: Annotated[Path | None, arg(metavar="FILE")] = None
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
    hold: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Positions of joints that were not recorded: JOINT=VALUE [rad or m], or a keyframe; default: keyframe home."""
    payload_body: str = ""
    """Body that holds the payload of each log, if the logs have a field payload [kg]; default: that of the last
    joint."""
    as_told: bool = False
    """Keep names, order and signs of the file or the mapping, even if the data contradicts them or is ambiguous."""


MODEL_IDENTIFY = IdentifyConfig(
    initial_state="measured",
    settle_s=0.0,
    horizon_s=1.0,
    generations=0,
    jacobian="finite",
    max_delay_s=0.05,
    long_s=None,
)
"""Defaults of identify for a model, which has rough values: no search, initial states from the measurements."""
