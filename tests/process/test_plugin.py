"""A package of somebody else's, installed as pip does: its robot, device and world are found, kept to, and used."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.emulation.truth import Kind
from sim2real.hardware.device import OperatingMode

pytestmark = [pytest.mark.process, pytest.mark.night, pytest.mark.timeout(900)]  # a busy machine compiles for minutes

TESTS = Path(__file__).parents[1]
IDENTIFY = """
from dataclasses import replace
from pathlib import Path

import sim2real

turntable = sim2real.load_robot("turntable")
brief = replace(turntable.defaults.identify, settle_s=0.2, horizon_s=0.4, folds=0, free_run_s=0.0)
tiny = replace(brief, generations=0, refine_steps=3)
recording = sim2real.Recording.load(Path({log!r}))
found = sim2real.identify(turntable, recording, replace(tiny, world="oiled", fix={{"drag": 0.0}}))
folder = Path("found")
folder.mkdir()
found.save(folder)
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the installed package; built offline, by the setuptools that dm-control brings."""
    folder = tmp_path_factory.mktemp("plugin")
    shutil.copytree(TESTS / "plugin", folder / "source")  # building writes beside the source
    offline = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "install", "--quiet", *offline, "--target", folder / "site"]
    subprocess.run([*command, folder / "source"], check=True, timeout=300)
    return folder / "site"


@pytest.fixture(scope="module")
def call(site, tmp_path_factory):
    """Run Python where the package is installed; return stdout."""
    folder = tmp_path_factory.mktemp("elsewhere")

    def run(*arguments):
        command = [sys.executable, *map(str, arguments)]
        ours = {"PYTEST_ADDOPTS"}  # options of this suite, which the package's own tests do not know
        env = {name: value for name, value in os.environ.items() if name not in ours} | {"PYTHONPATH": str(site)}
        done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, f"{arguments} ended with {done.returncode}:\n{done.stdout}\n{done.stderr}"
        return done.stdout

    run.folder = folder
    return run


def test_what_it_brings_has_names(call):
    said = call("-m", "sim2real.cli", "info")
    assert re.search(r"^turntable +A turntable on an ODrive.* entry point turntable$", said, re.MULTILINE)
    assert re.search(r"^odrive +entry point turntable.odrive:ODrive$", said, re.MULTILINE)
    assert re.search(r"^oiled +entry point turntable.oiled:OiledTable$", said, re.MULTILINE)


def test_its_own_tests_pass(call):
    """They are the conformance suites of devices and robots, and have nothing else."""
    tests = [TESTS / "plugin" / name for name in ("test_odrive.py", "test_turntable.py")]
    said = call("-m", "pytest", "-q", "-p", "no:cacheprovider", "--noconftest", "--rootdir", call.folder, *tests)
    assert re.search(r"\b1[5-9] passed", said)
    assert "failed" not in said


@pytest.fixture(scope="module")
def log(call):
    """A short recording on the emulated board."""
    call("-m", "sim2real.cli", "record", "turntable", "--duration-s", "4")
    (path,) = call.folder.glob("runs/turntable/*/record/session.mcap")
    return path


def test_it_is_recorded_by_its_device(log):
    recording = Recording.load(log)
    assert recording.units == {"position": "rad", "velocity": "rad/s", "command": "rad/s", "goal": "rad/s"}
    assert np.ptp(recording.episode.outputs["actuator"]["goal"]) > 5.0
    assert np.ptp(recording.episode.outputs["sensor"]["velocity"]) > 5.0
    effects = recording.truth.of(Kind.EFFECT)
    assert OperatingMode.VELOCITY in effects["values"][:, 0]
    assert effects["values"][-1, 0] == OperatingMode.OFF


def test_it_is_identified_in_a_world_of_its_own(call, log):
    call("-c", IDENTIFY.format(log=str(log)))
    found = Identification.load(call.folder / "found")
    assert (found.pipeline, found.internal.world) == ("turntable", "oiled")
    by_name = {p.name: p for p in found.parameters}
    assert {"loop", "friction", "drag", "round_trip_delay"} <= set(by_name)
    loop = by_name["loop"]
    assert (loop.truth, loop.nominal) == (20.0, 25.0)
    assert loop.estimate == pytest.approx(loop.truth, rel=0.1)
