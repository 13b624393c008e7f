"""Flags of deploy. Imports no JAX, so that ``--help`` stays instant."""

import math
from dataclasses import dataclass
from typing import Annotated

from sim2real.errors import UsageError
from sim2real.stages.flag import Flag
from sim2real.stages.session.config import SessionConfig


@dataclass(frozen=True)
class DeployConfig(SessionConfig):
    """Run the policy on the robot and compare with the simulation."""

    bundle: Annotated[str | None, Flag("RUN|PIPELINE|BUNDLE")] = None
    """Policy: a bundle's folder, a run, or a pipeline; default: the newest training, or the bundle that the pipeline
    ships."""
    episodes: int = 2
    """Number of episodes."""
    settle_s: float = 20.0
    """Longest wait for the robot to come to rest before an episode [s]."""
    blend_s: float = 0.0
    """Time in which the policy's action grows from zero to full size, for a first try on a robot [s]."""
    measure_delay: bool = True
    """Measure the delay with a few small steps before the policy moves the robot, if the robot defines such steps."""
    delay_tolerance_s: float = 0.008
    """Largest distance of the measured delay from the delays of training [s]."""
    force: bool = False
    """Deploy, with a warning, even if the measured delay is outside of the delays of training, or if the policy was
    trained for the emulated robot and this is the real one, or the reverse.
    """
    hold: bool = False
    """Hold the robot at the end of an episode, or after Ctrl-C, until Enter is pressed: it may fall without torque."""
    command: Annotated[tuple[float, float, float] | None, Flag("X Y YAW")] = None
    """Commanded velocity of a walking robot: forwards, to the left [m/s], yaw rate [rad/s]; default: four commands for
    each episode.
    """
    max_tilt_rad: float | None = None
    """Largest tilt [rad]; a robot that measures its tilt stops above it. Default: no limit."""

    def __post_init__(self) -> None:
        """Check the fields, before the robot moves."""
        super().__post_init__()
        if self.max_tilt_rad is not None and not 0.0 < self.max_tilt_rad <= math.pi:
            raise UsageError(f"max_tilt_rad must lie in (0, pi] rad, got {self.max_tilt_rad}")
        if not (0.0 <= self.blend_s <= 60.0 and 0.0 < self.delay_tolerance_s <= 1.0):
            raise UsageError(
                "blend_s must lie in [0, 60] s and delay_tolerance_s in (0, 1] s, "
                f"got {self.blend_s} and {self.delay_tolerance_s}"
            )
        if self.episodes < 1:
            raise UsageError(f"episodes must be at least 1, got {self.episodes}")
        if not 0.0 < self.settle_s <= 600.0:
            raise UsageError(f"settle_s must lie in (0, 600] s, got {self.settle_s}")
