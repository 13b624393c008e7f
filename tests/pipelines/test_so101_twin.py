"""`sim2real new --like so101` on the port of an embedded arm that a person moves: one question, then the twin."""

import json
import subprocess
import sys

import pytest

from sim2real.emulation.process import EmbeddedRobot
from sim2real.emulation.truth import Kind
from sim2real.hardware.device import OperatingMode
from sim2real.stages.pipeline.pipeline import load_pipeline

SO101 = load_pipeline("so101")
QUESTION = "press Enter"


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """An embedded arm, whose person begins 60 s after its start."""
    hand = tmp_path / "hand.npz"
    SO101.load("person").write_motion(hand, begin_s=60.0)
    embedded = SO101.load("robot").embedded()
    monkeypatch.setenv("SO101_CALIBRATION", str(SO101.folder / "calibration.json"))
    with EmbeddedRobot(embedded.plant, embedded.emulator, {"hand": str(hand)}, tmp_path / "truth.bin") as robot:
        yield robot


def new(arm, folder, answer):
    """Run the command with an answer on stdin; return its exit code and stderr."""
    command = [sys.executable, "-m", "sim2real.cli", "new", "my_arm", "--like", "so101", "--port", arm.port]
    done = subprocess.run(command, input=answer, capture_output=True, text=True, cwd=folder, timeout=900)
    return done.returncode, done.stderr


@pytest.mark.night  # `make test` calibrates by hand in test_so101_calibration.py, without the minute of waiting
@pytest.mark.process
def test_without_an_answer_nothing_moves_and_the_pipeline_is_there(arm, tmp_path):
    code, told = new(arm, tmp_path, "")
    assert (code, told.count(QUESTION)) == (2, 1), told
    assert "there was no answer, so the arm was not recorded" in told
    made = tmp_path / "pipelines" / "my_arm"
    assert json.loads((made / "calibration.json").read_text()) == json.loads(
        (SO101.folder / "calibration.json").read_text()
    )
    # The new pipeline is an arm of the same name on the same port, with the new file.
    command = [sys.executable, "-m", "sim2real.cli", "record", "my_arm", "--duration-s", "1", "--dry-run"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0, done.stderr
    assert f"on {arm.port}" in done.stderr
    arm.stop()
    assert set(arm.truth().of(Kind.EFFECT)["values"][:, 0].tolist()) <= {OperatingMode.OFF}


@pytest.mark.night
@pytest.mark.process
def test_an_answer_gives_an_accepted_twin(arm, tmp_path):
    code, told = new(arm, tmp_path, "\n")
    assert (code, told.count(QUESTION)) == (0, 1), told
    (page,) = tmp_path.glob("runs/my_arm/*/report.html")
    assert "accepted" in page.read_text()
