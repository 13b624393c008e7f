"""``sim2real new``: the files of a pipeline for a robot that has a model, or for an arm like a shipped one."""

import os
import re
import shlex
import shutil
import sys
import tempfile
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from sim2real.commands import flags
from sim2real.commands.stages import run_stage
from sim2real.errors import ERROR, UsageError
from sim2real.runtime import compilation_cache
from sim2real.stages.flag import Flag
from sim2real.stages.load import available, defaults_of, load_module, load_robot
from sim2real.stages.shared.robot_flags import RobotFlags

_COMMANDS = {
    "position": ("goal",),
    "velocity": ("goal_velocity",),
    "torque": ("torque",),
    "duty": ("duty",),
    "mit": ("goal", "goal_velocity", "torque", "kp", "kd"),
}
_PIPELINES = Path("pipelines")
_SILENCE_S = 1.0  # torque is off, so lost answers are no danger
_OF_MODEL = {
    "__init__.py": '''"""Recorded robot of {joints}, identified from its model."""

from dataclasses import replace

from sim2real.stages.config import MODEL_IDENTIFY, Defaults

DEFAULTS = Defaults(
    # Every field of sim2real.stages.config.IdentifyConfig may stand here: how long segments are, which delays may be.
    identify=replace(MODEL_IDENTIFY, horizon_s={horizon_s:g}, max_delay_s={max_delay_s:g}),
)
''',
    "robot.py": '''"""The robot: robot.toml has the recorded joints, their drives, and the parameters to identify."""

from pathlib import Path

from sim2real.robots.model.robot import MjcfRobot, ROBOT_FILE, RobotConfig

ROBOT = MjcfRobot(RobotConfig.load(Path(__file__).with_name(ROBOT_FILE)))
''',
}
_OF_LIKE = {
    "__init__.py": '''"""A robot like {like}, with its own calibration."""

from dataclasses import replace

from sim2real.stages.load import defaults_of

LIKE = defaults_of("{like}")
DEFAULTS = replace(
    LIKE,
    record=replace(LIKE.record, port={port!r}),
    deploy=replace(LIKE.deploy, port={port!r}),
)
''',
    "robot.py": '''"""The robot, with the calibration beside this file."""

from pathlib import Path

from sim2real.stages.load import load_module

ROBOT = load_module("{like}", "guide").robot(Path(__file__).with_name("calibration.json"))
''',
}
"""Templates of a pipeline's files: for a robot with a model, and for a robot like another one."""


@dataclass(frozen=True)
class NewConfig:
    """Write the files of a pipeline for a robot that has a model."""

    name: Annotated[str, Flag("NAME", positional=True)] = ""
    """Name of the pipeline: small letters, digits and underscores."""
    robot: Annotated[RobotFlags, Flag(flat=True)] = field(default_factory=RobotFlags)
    log: Annotated[str | None, Flag("FILE")] = None
    """Log of the robot, from which commands, measurements and rate are taken."""
    drive: Literal["position", "velocity", "torque", "duty", "mit"] = "position"
    """Kind of command of the drives, if there is no log."""
    like: Annotated[str | None, Flag("PIPELINE")] = None
    """Instead of a model: pipeline of the same kind of robot. Checks the calibration of the robot on --port, then
    records and identifies it.
    """
    port: Annotated[str | None, Flag("PORT")] = None
    """Serial port of the robot, for --like."""
    runs: Path = Path("runs")
    """Folder of all runs, for --like."""


def new(command: str, arguments: list[str]) -> None:
    """``sim2real new NAME --mjcf ROBOT.xml [--log FILE]``, or ``sim2real new NAME --like PIPELINE --port PORT``."""
    examples = ("new go2 --mjcf go2.xml --log run.csv", "new my_arm --like so101 --port /dev/ttyACM0")
    config = flags.parse(NewConfig(), arguments, f"sim2real {command}", *examples)
    compilation_cache.enable()
    if config.like is None:
        _from_model(config)
    elif not _run_like(config, config.like):
        sys.exit(ERROR)


def _from_model(config: NewConfig) -> None:
    """Write a pipeline's folder for a model.

    Raises:
        UsageError: The name is not allowed, the folder exists, or the model has no joint that can be driven.
    """
    import msgspec

    from sim2real.log.importing.mapping import MAPPING, to_toml
    from sim2real.robots.model.drives import joints_of
    from sim2real.robots.model.file import read_model
    from sim2real.robots.model.parameters import expand
    from sim2real.robots.model.robot import RobotConfig
    from sim2real.stages.config import MODEL_IDENTIFY
    from sim2real.stages.shared.from_model import describe, describe_robot, files_of, note_held
    from sim2real.stages.terminal.console import note

    example = "sim2real new go2 --mjcf go2.xml --log run.csv"
    _check_name(config.name, example)
    if config.robot.mjcf is None:
        raise UsageError("new needs a model of the robot: --mjcf", hint=example)
    folder = _PIPELINES / config.name
    if folder.exists():
        raise UsageError(f"{folder} exists", hint="choose another name, or delete it")
    # Describe the robot by its log; without one, by the flags alone.
    mapping = None
    if config.log is not None:
        found = describe_robot(config.robot, [config.log])
        robot, mapping = found.robot, found.mapping
    else:
        joints = config.robot.joints or joints_of(read_model(config.robot.mjcf))
        rate_hz, step_s = config.robot.rate_hz or RobotConfig.rate_hz, config.robot.step_s or RobotConfig.step_s
        robot = describe(config.robot, joints, _COMMANDS[config.drive], rate_hz, step_s, config.drive == "mit")
        note_held(robot)
    # Refuse a robot that cannot run before a file is written.
    expand(robot.terms, robot.joints, robot.driven(), read_model(robot.model))
    usual = {"horizon_s": MODEL_IDENTIFY.horizon_s, "max_delay_s": MODEL_IDENTIFY.max_delay_s}
    count = "one joint" if len(robot.joints) == 1 else f"{len(robot.joints)} joints"
    texts = {name: text.format(joints=count, **usual) for name, text in _OF_MODEL.items()}
    texts |= files_of(robot)
    if mapping is not None:
        texts[MAPPING] = to_toml(msgspec.structs.replace(mapping, pipeline=config.name))
    if config.name in available():
        note(f"from this folder, {config.name!r} is now the new pipeline, and no longer the one that is installed")
    _write(folder, texts)
    if config.log:
        log = f"{config.name} --log {shlex.quote(str(config.log))}"
        note(f"next: sim2real check {log}; sim2real identify {log}")


def _write(folder: Path, texts: dict[str, str]) -> None:
    from sim2real.stages.terminal.console import wrote

    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
        wrote(folder / name)


def _check_name(name: str, example: str) -> None:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise UsageError(f"new needs a name of small letters, digits and underscores, got {name!r}", hint=example)


# -- a robot like a shipped one


def _run_like(config: NewConfig, like: str) -> bool:
    """Check the calibration, write the pipeline, record, identify, and open the page.

    Returns:
        Whether the identification was accepted.

    Raises:
        UsageError: The flags do not fit, or the calibration file is refused.
        HardwareLost: The arm contradicts its calibration. No motor has moved.
    """
    from sim2real.artifacts.identification import Identification
    from sim2real.stages.terminal.console import wrote

    sources = available()
    able = sorted(n for n, s in sources.items() if isinstance(s, Path) and (s / "guide.py").is_file())
    if like not in able:
        raise UsageError(f"--like {like}: no such robot. Available: {', '.join(able)}")
    example = f"sim2real new my_arm --like {like} --port /dev/ttyACM0"
    _check_name(config.name, example)
    if config.port is None or config.robot.mjcf is not None or config.log is not None:
        raise UsageError("--like needs the --port of the robot, and neither a model nor a log", hint=example)
    if config.name in sources:
        raise UsageError(f"the pipeline {config.name!r} exists already", hint="choose another name, or delete it")
    folder = _PIPELINES / config.name
    with tempfile.TemporaryDirectory() as temporary:
        # Find faults of the arm before a motor moves.
        calibration = Path(temporary) / "calibration.json"
        calibrate(config.port, load_module(like, "guide"), calibration)
        folder.mkdir(parents=True)
        shutil.copy(calibration, folder)
    wrote(folder / calibration.name)
    _write(folder, {name: text.format(like=like, port=config.port) for name, text in _OF_LIKE.items()})
    # Ask once, because the arm moves from here on.
    robot, defaults = load_robot(config.name), defaults_of(config.name)
    _ask(f"The arm moves next, for {defaults.record.duration_s:g} s: let go of it, clear its table, and press Enter. ")
    recorded = run_stage("record", robot, defaults.record, config.runs, None, page=False)
    run_dir = None if recorded is None else recorded.run_dir
    identified = run_stage("identify", robot, defaults.identify, config.runs, run_dir)
    if identified is None:
        raise UsageError("identify has written no folder")
    # Open the page if there is a screen.
    page = identified.run_dir / "report.html"
    if sys.stdout.isatty() and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        webbrowser.open(page.resolve().as_uri())
    return Identification.load(identified.output("parameters")).verdict.status == "accepted"


def calibrate(port: str, guide: Any, path: Path) -> None:
    """Write LeRobot's calibration of the arm on a port into a file, once a motion by hand has shown that it fits.

    Args:
        guide: The pipeline's module ``guide``: the bus (``BAUD_RATE``, ``IDS``), where LeRobot keeps calibrations
            (``calibration_of``, ``read``), and the motions to make by hand (``MIDDLE``, ``NUDGES``).

    Raises:
        UsageError: There is no calibration, or it is refused.
        HardwareLost: A servo or the motion contradicts the calibration. No motor has moved.
    """
    from sim2real.hardware.bus.port import BusConfig
    from sim2real.hardware.calibration import HandMotion, follow
    from sim2real.hardware.feetech import HOMING_OFFSET, StsServos
    from sim2real.stages.terminal.console import note

    # Find the servos, and the file that belongs to them.
    bus = BusConfig(port, guide.BAUD_RATE, max_silence_s=_SILENCE_S)
    with StsServos(bus, guide.IDS) as servos:
        note(f"{len(guide.IDS)} servos answer on {port}", urgent=True)
        source: Path = guide.calibration_of([servos.link.read(i, HOMING_OFFSET) for i in guide.IDS])
    joints = guide.read(source)
    note(f"calibration: {source}", urgent=True)
    # Opening the arm compares models, homing offsets and limits with the calibration, and takes the torque off.
    with StsServos(bus, joints) as servos:
        motion = HandMotion(joints, guide.NUDGES)
        note(f"torque is off. Move the arm by hand. Its middle pose: {guide.MIDDLE}", urgent=True)
        follow(servos, motion, lambda words: note(f"- {words}", urgent=True))
    shutil.copy(source, path)
    note("the calibration fits the arm", urgent=True)


def _ask(question: str) -> None:
    """Print a question on stderr, and wait for Enter.

    Raises:
        UsageError: stdin has ended before an answer.
    """
    print(question, end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        raise UsageError(
            "Enter was not pressed, so the arm was not recorded", hint="`sim2real record NAME` records it later"
        )
