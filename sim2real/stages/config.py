"""What each stage can be told; every field is a flag. Imports no JAX, so that ``--help`` stays instant."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from sim2real.errors import UsageError
from sim2real.hardware.config import GateLimits as GateLimits
from sim2real.identify.config import FitConfig
from sim2real.stages.train_config import TrainConfig as TrainConfig
from sim2real.stages.train_config import check_seed


@dataclass(frozen=True)
class RecordConfig:
    """Record the robot under an excitation."""

    port: str = "embedded"
    """Serial port of the servo bus, or 'embedded' for the emulated robot."""
    duration_s: float = 40.0
    """Length of the recording [s]."""
    excitation: Literal["multisine", "chirp", "steps"] = "multisine"
    """Command signal."""
    amplitude: float = 1.8
    """Largest command of the excitation [the actuator's unit; V for the pendulum]."""
    low_hz: float = 0.2
    """Lowest frequency of the excitation [Hz]."""
    high_hz: float = 3.0
    """Highest frequency of the excitation [Hz]."""
    seed: int = 0
    """Seed of the excitation, and of the embedded robot."""
    dry_run: bool = False
    """Do everything but move the robot: no torque, no goals; what would have been sent is logged and summed up."""
    strict_timing: bool = False
    """End with code 5 when more than 1 % of the steps miss their deadline."""
    gate: GateLimits = field(default_factory=GateLimits)
    """Limits on every command."""

    def __post_init__(self) -> None:
        """Check what can be checked before anything moves."""
        check_seed(self.seed)
        if not 1.0 <= self.duration_s <= 3600.0:
            raise UsageError(f"duration_s must lie in [1, 3600] s, got {self.duration_s}")
        if not 0.0 < self.low_hz < self.high_hz:
            raise UsageError(f"the excitation needs 0 < low_hz < high_hz, got {self.low_hz} and {self.high_hz} Hz")
        if not 0.0 < self.amplitude <= self.gate.limit:
            raise UsageError(
                f"the amplitude must lie in (0, {self.gate.limit}], got {self.amplitude}",
                hint="raise --gate.limit only if the robot bears it",
            )


@dataclass(frozen=True)
class IdentifyConfig(FitConfig):
    """Identify dynamics, delays and initial states from logs."""

    log: Annotated[tuple[str, ...], UseAppendAction] = ()
    """MCAP log to identify from, one flag a log; default: the newest finished recording of the pipeline."""
    begin: str | None = None
    """Where the search begins: the parameters.json or partial.json of an earlier one; default: at the data sheet."""
    hold_out: Annotated[tuple[str, ...], UseAppendAction] = ()
    """MCAP log that is held out: only predicted, not fitted; one flag a log."""
    force: bool = False
    """Take a log that is given twice all the same: held out and fitted, or fitted two times."""
    settle_s: float = 0.3
    """First part of a held-out segment, to which its initial state is fitted; the rest is predicted [s]."""
    horizon_s: float = 1.0
    """Rest of a segment: how far ahead it is predicted [s]."""
    spacing_s: float = 0.0
    """Distance between the starts of fitted segments [s]; 0 puts them side by side."""
    held_out: float = 0.25
    """Share of each log, at its end, that is held out; 0 where whole logs are."""
    free_run_s: float = 10.0
    """Longest simulation of held-out data from a single initial state [s]."""
    folds: int = 5
    """Parts that are left out of the fit one at a time, to say how far off it is on what it never saw: each log where
    there are several, else so many blocks of the one there is; 0 leaves that out."""
    terms: str = "own"
    """Optional terms of the model: 'own' takes the pipeline's, 'auto' those without which what is left out is predicted
    worse, 'all' or 'none' say it, else names with commas between."""
    each: bool = True
    """Where there are several logs, identify each by itself as well, and report the spread between them."""
    bounds: Annotated[dict[str, tuple[float, float]], UseAppendAction] = field(default_factory=dict)
    """Bounds of a parameter instead of the pipeline's: NAME LOW HIGH, one flag a parameter."""
    fix: Annotated[dict[str, float], UseAppendAction] = field(default_factory=dict)
    """Value of a parameter that is not to be identified: NAME VALUE, one flag a parameter."""
    world: str | None = None
    """World of an installed package to identify in; default: the robot's own."""
    links: bool = False
    """Find how delays of the measurements are distributed, which were lost, and the drift of their clock, as well."""
    reveal: bool = True
    """Show the embedded robot's true parameters beside the estimates; the search never sees them."""

    def __post_init__(self) -> None:
        """Check what can be checked before the log is read."""
        super().__post_init__()
        if not 0.0 <= self.held_out <= 0.8:
            raise UsageError(f"held_out must lie in [0, 0.8], got {self.held_out}")
        if self.held_out == 0.0 and not self.hold_out:
            raise UsageError(
                "nothing is held out: an identification that nothing checks is worth nothing",
                hint="set --held-out to a share of the log, or name a log with --hold-out",
            )
        if not (0.0 <= self.settle_s <= 10.0 and 0.2 <= self.horizon_s <= 600.0):
            raise UsageError(
                "settle_s must lie in [0, 10] s and horizon_s in [0.2, 600] s, "
                f"got {self.settle_s} and {self.horizon_s}"
            )
        if self.spacing_s < 0.0:
            raise UsageError(f"spacing_s must not be negative, got {self.spacing_s}")
        if not 0.0 <= self.free_run_s <= 3600.0:
            raise UsageError(f"free_run_s must lie in [0, 3600] s, got {self.free_run_s}")
        if self.folds < 0 or self.folds == 1 or (self.terms == "auto" and not self.folds):
            raise UsageError(
                f"folds must be 0, or 2 and more, got {self.folds} with terms {self.terms!r}",
                hint="terms are chosen by what is left out: --terms auto needs --folds",
            )


@dataclass(frozen=True)
class LatencyConfig(RecordConfig):
    """Find out where the milliseconds go: play steps, and judge clocks, bus and motion."""

    identify: IdentifyConfig = field(default_factory=IdentifyConfig)
    """How the device's share is found from the motion."""

    @staticmethod
    def of(record: RecordConfig, identify: IdentifyConfig) -> LatencyConfig:
        """Return the defaults for a robot: 30 s of steps, and no more of an identification than the delay needs."""
        own = {f.name: getattr(record, f.name) for f in fields(record)}
        steps = {"duration_s": 30.0, "excitation": "steps"}
        return LatencyConfig(**own | steps, identify=replace(identify, folds=0, free_run_s=0.0))


@dataclass(frozen=True)
class DeployConfig:
    """Run the policy on the robot and compare with the simulation."""

    port: str = "embedded"
    """Serial port of the servo bus, or 'embedded' for the emulated robot."""
    bundle: str | None = None
    """Folder of the policy bundle; default: the newest training of the pipeline."""
    episodes: int = 2
    """How many times to deploy."""
    duration_s: float = 10.0
    """Length of a deployment [s]."""
    settle_s: float = 20.0
    """Longest wait for the robot to come to rest before a deployment [s]."""
    seed: int = 0
    """Seed of the embedded robot."""
    backend: Literal["numpy", "onnx"] | None = None
    """What runs the policy: numpy, or onnxruntime; default: numpy, but onnxruntime for a network of your own."""
    blend_s: float = 0.0
    """Time in which the policy's action grows from none to all of it, for a first try on a robot [s]."""
    measure_delay: bool = True
    """Measure the delay with a few small steps, where the robot says how, before the policy moves it."""
    delay_tolerance_s: float = 0.008
    """How far the measured delay may lie outside of those that the policy was trained with [s]."""
    force: bool = False
    """Deploy, with a warning, though the delay is not what the policy was trained with."""
    hold: bool = False
    """Hold the robot where an episode or Ctrl-C ends it, until Enter is pressed: for one that falls without torque."""
    dry_run: bool = False
    """Do everything but move the robot: no torque, no goals; what would have been sent is logged and summed up."""
    strict_timing: bool = False
    """End with code 5 when more than 1 % of the steps miss their deadline."""
    max_tilt_rad: float | None = None
    """How far the robot may lean before it is stopped, of one that sees its tilt; default: not checked [rad]."""
    gate: GateLimits = field(default_factory=GateLimits)
    """Limits on every command."""

    def __post_init__(self) -> None:
        """Check what can be checked before anything moves."""
        check_seed(self.seed)
        if self.max_tilt_rad is not None and not 0.0 < self.max_tilt_rad <= math.pi:
            raise UsageError(f"max_tilt_rad must lie in (0, pi] rad, got {self.max_tilt_rad}")
        if not (0.0 <= self.blend_s <= 60.0 and 0.0 < self.delay_tolerance_s <= 1.0):
            raise UsageError(
                "blend_s must lie in [0, 60] s and delay_tolerance_s in (0, 1] s, "
                f"got {self.blend_s} and {self.delay_tolerance_s}"
            )
        if self.episodes < 1:
            raise UsageError(f"episodes must be at least 1, got {self.episodes}")
        if not 1.0 <= self.duration_s <= 3600.0:
            raise UsageError(f"duration_s must lie in [1, 3600] s, got {self.duration_s}")
        if not 0.0 < self.settle_s <= 600.0:
            raise UsageError(f"settle_s must lie in (0, 600] s, got {self.settle_s}")


@dataclass(frozen=True)
class ImportConfig:
    """Turn files of other recorders into logs, one for each file."""

    files: Annotated[Positional[tuple[Path, ...]], arg(metavar="FILE...")] = ()
    """Files of other recorders: npz, JSON, CSV, MCAP or the folder of a ROS 2 bag, or a LeRobot data set."""
    mapping: Path | None = None
    """TOML file that says which signal is which field; default: the pipeline's import.toml, or one is proposed."""
    mjcf: Path | None = None
    """Model of the robot (MJCF or URDF), for the names and ranges of its joints."""
    joints: tuple[str, ...] = ()
    """Joints that were recorded, in the order of the columns; default: all of the model's, in its order."""
    rate_hz: float | None = None
    """Samples per second, where a file has no time stamps [Hz]."""
    together: bool = False
    """All files are of one recording: a log of all of them instead of one for each."""
    as_told: bool = False
    """Keep names, order and signs of the file or the mapping where the data contradicts them, or cannot tell."""
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
        """The files, at least one.

        Raises:
            UsageError: When none was named.
        """
        if not self.files:
            raise UsageError("import needs a file of another recorder", hint="sim2real import FILE... --pipeline NAME")
        return self.files

    @property
    def selection(self) -> slice | None:
        """The range of samples; None: all."""
        return slice(*(int(end) if end else None for end in self.samples.split(":"))) if self.samples else None


@dataclass(frozen=True)
class RobotFlags:
    """A robot that no pipeline describes: its model, and what else there is to say of it."""

    mjcf: Annotated[Path | None, arg(metavar="FILE")] = None
    """Model of the robot: MJCF or URDF."""
    joints: tuple[str, ...] = ()
    """Joints that were recorded, in the order of the columns; default: all of the model's, in its order."""
    parameter: Annotated[tuple[str, ...], UseAppendAction] = ()
    """What is identified: WHAT[:each][@PATTERN][=VALUE], one flag a quantity, such as frictionloss:each or
    kp@.*_calf_joint; with =VALUE it is held. An unknown WHAT is refused, with a list."""
    mapping: Annotated[Path | None, arg(metavar="FILE")] = None
    """Mapping of the log, if it is of another recorder; default: one is proposed."""
    rate_hz: float | None = None
    """Samples per second, where the log has no time stamps [Hz]."""
    velocity: bool = False
    """Compare measured velocities, too."""
    step_s: float = 0.0
    """Time step of the simulation [s]; 0: the model's own, between 0.5 and 5 ms."""
    fix_base: bool = False
    """Hold a floating base where the model has it, as on a stand."""
    contacts: bool = False
    """Simulate contacts."""
    hold: Annotated[tuple[str, ...], UseAppendAction] = ()
    """Where joints that were not recorded are held: JOINT=VALUE [rad or m], or a keyframe; default: keyframe home."""
    as_told: bool = False
    """Keep names, order and signs of the file or the mapping where the data contradicts them, or cannot tell."""


MODEL_IDENTIFY = IdentifyConfig(
    initial_state="measured",
    settle_s=0.0,
    horizon_s=1.0,
    generations=0,
    refine=1,
    jacobian="finite",
    max_delay_s=0.05,
)
"""How a robot of a model is identified: rough values are known, so there is no search; starts are read off the log."""


@dataclass(frozen=True)
class NewConfig:
    """Write the files of a pipeline for a robot that was recorded."""

    name: Annotated[Positional[str], arg(metavar="NAME")] = ""
    """Name of the pipeline."""
    model: Annotated[Positional[Path | None], arg(metavar="ROBOT.xml")] = None
    """Model of the robot: MJCF or URDF."""
    log: Annotated[str | None, arg(metavar="FILE")] = None
    """A log of it, which says what was commanded and measured, and how fast."""
    drive: Literal["position", "velocity", "torque", "duty", "mit"] = "position"
    """What drives are told, where no log says so."""
    robot: Annotated[RobotFlags, arg(name="")] = field(default_factory=RobotFlags)
    folder: Path = Path("pipelines")
    """Folder of pipelines."""


@dataclass(frozen=True)
class RecoverConfig:
    """Write what is readable of a damaged MCAP file into a new one."""

    log: Annotated[Positional[Path | None], arg(metavar="FILE")] = None
    """The damaged file; it is left as it is."""
    out: Annotated[Path | None, arg(metavar="FILE")] = None
    """The new file; default: beside the damaged one, as NAME.recovered.mcap."""

    @property
    def source(self) -> Path:
        """The damaged file.

        Raises:
            UsageError: When none was named.
        """
        if self.log is None:
            raise UsageError("log recover needs a file", hint="sim2real log recover FILE")
        return self.log


@dataclass(frozen=True)
class ExportConfig:
    """Write what was identified in the terms of another simulator."""

    source: Annotated[Positional[str | None], arg(metavar="RUN|PIPELINE|FILE")] = None
    """A run folder, a pipeline, whose newest identification is taken, or a parameters.json."""
    to: Literal["mjcf", "mjlab", "isaaclab", "json"] = "mjcf"
    """What to write: a model for MuJoCo, a Python file for mjlab or for Isaac Lab, or everything as JSON."""
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
class CheckConfig:
    """Judge what a recording, or a planned one, can tell about the parameters, before anything is searched."""

    log: Annotated[tuple[str, ...], UseAppendAction] = ()
    """MCAP log to judge, one flag a log; default: the newest recording, and without one the planned excitation."""
    plan: bool = False
    """Judge the planned excitation even where there is a recording."""
    bounds: Annotated[dict[str, tuple[float, float]], UseAppendAction] = field(default_factory=dict)
    """Bounds of a parameter instead of the pipeline's: NAME LOW HIGH, one flag a parameter."""
    fix: Annotated[dict[str, float], UseAppendAction] = field(default_factory=dict)
    """Value of a parameter that is not to be identified: NAME VALUE, one flag a parameter."""
    world: str | None = None
    """World of an installed package whose parameters are judged; default: the robot's own."""
    json: bool = False
    """Print JSON instead of tables."""
    runs: Path = Path("runs")
    """Folder of all runs."""
    record: RecordConfig = field(default_factory=RecordConfig)
    """The excitation that is planned."""

    def __post_init__(self) -> None:
        """Check what can be checked before a log is read."""
        if self.plan and self.log:
            raise UsageError("plan and log exclude each other: a plan is judged without a log")
