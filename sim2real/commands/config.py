"""The commands ``new``, ``export``, ``play``; each field is a flag. No JAX, for ``--help``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from sim2real.errors import UsageError
from sim2real.stages.live.config import ViewFlag, check_view
from sim2real.stages.pipeline.robot_flags import RobotFlags


@dataclass(frozen=True)
class NewConfig:
    """Write the files of a pipeline for a robot that was recorded."""

    name: Annotated[Positional[str], arg(metavar="NAME")] = ""
    """Name of the pipeline."""
    model: Annotated[Positional[Path | None], arg(metavar="ROBOT.xml")] = None
    """Model of the robot: MJCF or URDF."""
    log: Annotated[str | None, arg(metavar="FILE")] = None
    """Log of the robot; its commands, measurements and rate are taken over."""
    drive: Literal["position", "velocity", "torque", "duty", "mit"] = "position"
    """Command of the drives, if there is no log."""
    like: Annotated[str | None, arg(metavar="PIPELINE")] = None
    """Pipeline whose robot this one is too: checks or makes the calibration of the robot on --port, then records and
    identifies it."""
    port: Annotated[str | None, arg(metavar="PORT")] = None
    """Serial port of the robot, for --like."""
    robot: Annotated[RobotFlags, arg(name="")] = field(default_factory=RobotFlags)
    folder: Path = Path("pipelines")
    """Folder of pipelines."""
    runs: Path = Path("runs")
    """Folder of all runs, for --like."""


@dataclass(frozen=True)
class ExportConfig:
    """Write the estimates as a model of another simulator."""

    source: Annotated[Positional[str | None], arg(metavar="RUN|PIPELINE|FILE")] = None
    """A run folder, a pipeline, whose newest identification is taken, or a parameters.json."""
    to: Literal["mjcf", "mjlab", "isaaclab", "json", "card"] = "mjcf"
    """Format: a model for MuJoCo, a Python file for mjlab or for Isaac Lab, everything as JSON, or a model card: a
    folder with a page and a script that computes each figure again."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """The file to write; default: one in the working directory that is called after the pipeline."""
    runs: Path = Path("runs")
    """Folder of all runs."""


@dataclass(frozen=True)
class ShipConfig:
    """Write a policy bundle elsewhere, with an example that runs it on a machine that has numpy alone."""

    source: Annotated[Positional[str | None], arg(metavar="RUN|PIPELINE|BUNDLE")] = None
    """A bundle's folder, a run folder, or a pipeline, whose newest training is taken."""
    to: Annotated[Path | None, arg(metavar="DIR")] = None
    """The folder to write; default: one in the working directory."""
    runs: Path = Path("runs")
    """Folder of all runs."""


@dataclass(frozen=True)
class PlayConfig:
    """Let a policy walk on a twin in C MuJoCo, with delays and noise: in a window, with keys, or into a picture."""

    source: Annotated[Positional[str | None], arg(metavar="RUN|PIPELINE|BUNDLE")] = None
    """A bundle's folder, a run folder, or a pipeline, whose newest training is taken, or its shipped bundle."""
    command: tuple[float, float, float] = (0.6, 0.0, 0.0)
    """Velocity at the start: forwards, to the left [m/s], yaw rate [rad/s]."""
    seconds: float = 10.0
    """Length of the episode [s]."""
    push: float = 0.0
    """Size of a push every 5 s [m/s]."""
    seed: int | None = None
    """Seed of a twin with other friction, load, motors and delays; default: the nominal twin."""
    window: bool = False
    """Show it in a window; the arrow keys change forward velocity and yaw rate, comma and full stop the sideways one,
    the space bar stops."""
    view: ViewFlag = None
    """Show it in the Rerun viewer; 'web': on a page for browsers. The same keys steer in the terminal."""
    gamepad: Annotated[Path | None, arg(metavar="/dev/input/js0")] = None
    """Gamepad that steers: the left stick sets the velocity, the right one the yaw rate."""
    video: Annotated[Path | None, arg(metavar="FILE.gif|FILE.mp4")] = None
    """Moving picture to write, from the side; needs no display, and FFmpeg for .mp4."""
    runs: Path = Path("runs")
    """Folder of all runs."""

    def __post_init__(self) -> None:
        if not (0.0 < self.seconds <= 3600.0 and 0.0 <= self.push <= 10.0):
            raise UsageError(f"play takes up to 3600 s and pushes of 0 to 10 m/s, got {self.seconds} and {self.push}")
        check_view(self.view)
        if sum(map(bool, (self.window, self.view, self.video))) > 1:
            raise UsageError("play shows a window or a view, or writes a picture", hint="run it with one of them")
        if self.video and self.video.suffix not in (".gif", ".mp4"):
            raise UsageError(f"--video writes a .gif or a .mp4, got {self.video}", hint="--video walk.gif")
