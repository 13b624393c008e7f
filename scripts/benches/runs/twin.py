"""From an empty environment to an accepted twin of the embedded SO-101, which a person moves by hand as asked.

Installs this checkout into a new environment, then runs ``sim2real new my_arm --like so101`` at the arm's port.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benches.figures import Report, row
from benches.provenance import ROOT

from sim2real.hardware.emulation.embedded import EmbeddedRobot
from sim2real.stages.pipeline.pipeline import load_pipeline

QUICK = {"no_install": True, "no_record": True, "begin_s": 12.0}


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of this bench."""
    parser.add_argument("--no-install", action="store_true", help="use this environment instead of an empty one")
    parser.add_argument("--no-record", action="store_true", help="stop at the question, before the arm moves")
    parser.add_argument("--begin-s", type=float, default=30.0, help="when the person begins [s after the command]")


def run(options: argparse.Namespace) -> Report:
    """Install, make the twin, and return the times of both."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        install_s, install_cpu_s, python = (0.0, 0.0, sys.executable) if options.no_install else _install(folder)
        wall_s, cpu_s, code, messages = _twin(folder, python, options)
    rows = [
        row("twin/wall", round(install_s + wall_s, 1), "s", "", "<= 600"),
        row("twin/install", round(install_s, 1), "s"),
        row("twin/processor", round(install_cpu_s + cpu_s, 1), "s"),
        row("twin/questions", messages.count("press Enter"), "1", "", "<= 1"),
        row("twin/accepted", int(code == 0), "1", "", "1"),
    ]
    return {"rows": rows, "messages": messages.replace(f"{ROOT}/", "").splitlines()}


def _install(folder: Path) -> tuple[float, float, str]:
    """Install this checkout into a new environment; return wall and processor time [s], and its interpreter."""
    python, cpu_s, begun_s = folder / "env" / "bin" / "python", _children_s(), time.monotonic()
    subprocess.run([sys.executable, "-m", "venv", folder / "env"], check=True)
    subprocess.run([python, "-m", "pip", "install", "--quiet", ROOT], check=True)
    return time.monotonic() - begun_s, _children_s() - cpu_s, str(python)


def _twin(folder: Path, python: str, options: argparse.Namespace) -> tuple[float, float, int, str]:
    """Run the command; return wall and processor time [s], the exit code and the messages."""
    so101, hand = load_pipeline("so101"), folder / "hand.npz"
    so101.load("person").write_motion(hand, begin_s=options.begin_s)
    embedded = so101.load("robot").embedded()
    environment = os.environ | {"SO101_CALIBRATION": str(so101.folder / "calibration.json")}
    with EmbeddedRobot(embedded.plant, embedded.emulator, {"hand": str(hand)}) as robot:
        command = [python, "-P", "-m", "sim2real.cli", "new", "my_arm", "--like", "so101", "--port", robot.port]
        cpu_s, begun_s = _children_s(), time.monotonic()
        answer = "" if options.no_record else "\n"
        done = subprocess.run(command, input=answer, capture_output=True, text=True, cwd=folder, env=environment)
        wall_s, cpu_s = time.monotonic() - begun_s, _children_s() - cpu_s
    return wall_s, cpu_s, done.returncode, done.stderr


def _children_s() -> float:
    """Return the processor time of the processes that have ended [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
