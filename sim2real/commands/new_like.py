"""``sim2real new NAME --like so101 --port PORT``: from the plug of an arm to its identified model."""

import os
import re
import shutil
import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import Any, Final

from sim2real.artifacts.identification import Identification
from sim2real.commands.command_kinds import run_stage
from sim2real.commands.config import NewConfig
from sim2real.errors import UsageError
from sim2real.hardware.feetech.calibrate import follow, write_calibration
from sim2real.hardware.feetech.calibration import CalibratedJoint
from sim2real.hardware.feetech.device import StsConfig, StsServos
from sim2real.hardware.feetech.find_servos import find_servos
from sim2real.hardware.feetech.hand_motion import HandMotion
from sim2real.stages.pipeline.pipeline import Pipeline, available, load_pipeline
from sim2real.stages.terminal.console import note, wrote
from sim2real.view.page.page import report

_CALIBRATION: Final = "calibration.json"
_SILENCE_S: Final = 1.0  # torque is off, so a lost answer is no danger
_INIT = '''"""A robot like {like}, with its own calibration."""

from dataclasses import replace

from sim2real.stages.pipeline.pipeline import load_pipeline

LIKE = load_pipeline("{like}")
PIPELINE = replace(
    LIKE,
    name="{name}",
    summary="a {like} of its own calibration",
    package=__name__,
    record=replace(LIKE.record, port={port!r}),
    deploy=replace(LIKE.deploy, port={port!r}),
)
'''
_ROBOT = '''"""The robot, with the calibration beside this file."""

from pathlib import Path

from sim2real.stages.pipeline.pipeline import load_pipeline

ROBOT = load_pipeline("{like}").load("guide").robot(Path(__file__).with_name("calibration.json"))
'''


def run(config: NewConfig) -> bool:
    """Check or make the calibration, write the pipeline, record, identify, and open the page.

    Returns:
        Whether the identification was accepted.

    Raises:
        UsageError: The flags do not fit, or the calibration file is refused.
        HardwareLost: The arm contradicts its calibration. No motor has moved.
    """
    like, port, folder = _checked(config)
    guide = like.load("guide")
    with tempfile.TemporaryDirectory() as temporary:
        # Find faults of the arm before a motor moves.
        calibration = Path(temporary) / _CALIBRATION
        calibrate(port, guide, calibration)
        folder.mkdir(parents=True)
        shutil.copy(calibration, folder / _CALIBRATION)
    wrote(folder / _CALIBRATION)
    for name, text in (("__init__.py", _INIT), ("robot.py", _ROBOT)):
        (folder / name).write_text(text.format(name=config.name, like=like.name, port=port), encoding="utf-8")
        wrote(folder / name)
    # The only question: from here on the arm moves.
    pipeline = load_pipeline(config.name)
    _ask(f"The arm moves next, for {pipeline.record.duration_s:g} s: let go of it, clear its table, and press Enter. ")
    recorded = run_stage("record", pipeline, pipeline.record, config.runs, None)
    run_dir = None if recorded is None else recorded.run_dir
    identified = run_stage("identify", pipeline, pipeline.identify, config.runs, run_dir)
    if identified is None:
        raise UsageError("identify has written no folder")
    # Print where everything is, and open the page if there is a screen.
    page = report(identified.run_dir)
    wrote(page)
    if sys.stdout.isatty() and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        webbrowser.open(page.resolve().as_uri())
    return Identification.load(identified.output("parameters")).verdict.status == "accepted"


def calibrate(port: str, guide: Any, path: Path) -> None:
    """Write the checked calibration of the arm on a port into a file.

    With a calibration of LeRobot's, a person's motion checks it; without one, the motion makes it.

    Args:
        guide: The module ``guide`` of the robot's pipeline.

    Raises:
        UsageError: LeRobot's file is refused.
        HardwareLost: A servo or the motion contradicts the calibration. No motor has moved.
    """
    # Find the servos, and the file that belongs to them.
    present: tuple[CalibratedJoint, ...] = find_servos(port, guide.IDS, guide.BAUD_RATE)
    note(f"{len(present)} servos answer on {port}", urgent=True)
    source: Path | None = guide.calibration_of(present)
    joints = present if source is None else guide.read(source)
    note(f"calibration: {source or 'none of LeRobot, so it is made now'}", urgent=True)
    # Opening compares models, homing offsets and limits with the calibration, and takes the torque off.
    with StsServos(StsConfig(port, guide.BAUD_RATE, max_silence_s=_SILENCE_S), joints) as servos:
        motion = HandMotion(joints, guide.NUDGES, calibrated=source is not None)
        note(f"torque is off. Move the arm by hand. Its middle pose: {guide.MIDDLE}", urgent=True)
        follow(servos, motion, lambda words: note(f"- {words}", urgent=True))
        if source is None:
            write_calibration(servos, motion, path)
        else:
            shutil.copy(source, path)
    guide.read(path)
    note("the calibration fits the arm", urgent=True)


def _checked(config: NewConfig) -> tuple[Pipeline, str, Path]:
    """Return the pipeline of the like robot, the port and the new folder; refuse flags that do not fit."""
    sources = available()
    able = sorted(n for n, s in sources.items() if isinstance(s, Path) and (s / "guide.py").is_file())
    if config.like not in able:
        raise UsageError(f"--like {config.like}: no such robot. Available: {', '.join(able)}")
    example = f"sim2real new my_arm --like {config.like} --port /dev/ttyACM0"
    if not re.fullmatch(r"[a-z]\w*", config.name):
        raise UsageError(
            f"new needs a name of small letters, digits and underscores, got {config.name!r}", hint=example
        )
    if config.port is None or config.model is not None or config.log is not None:
        raise UsageError("--like needs the --port of the robot, and neither a model nor a log", hint=example)
    if config.folder.resolve() != Path("pipelines").resolve() or config.name in sources:
        raise UsageError(
            f"the pipeline {config.name!r} exists already, or --folder is not ./pipelines",
            hint="choose another name, or delete it",
        )
    return load_pipeline(config.like), config.port, config.folder / config.name


def _ask(question: str) -> None:
    """Print a question on stderr, and wait for Enter.

    Raises:
        UsageError: stdin has ended before an answer.
    """
    print(question, end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        raise UsageError(
            "there was no answer, so the arm was not recorded", hint="sim2real record NAME records it later"
        )
