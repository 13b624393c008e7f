"""`sim2real new --like so101` on the port of an emulated arm that a person moves: one question, then the twin."""

import io
import json

import pytest
import so101_person

from sim2real import cli
from sim2real.emulation.bus import VirtualRobot
from sim2real.emulation.truth import Kind
from sim2real.hardware.device import OperatingMode
from sim2real.stages.load import load_module, load_robot

SO101 = load_robot("so101")
QUESTION = "press Enter"


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """An arm whose person begins 60 s after its start."""
    hand = tmp_path / "hand.npz"
    so101_person.write_motion(hand, begin_s=60.0)
    embedded = load_module(SO101.name, "robot").embedded()
    monkeypatch.setenv("SO101_CALIBRATION", str(SO101.folder / "calibration.json"))
    monkeypatch.chdir(tmp_path)
    with VirtualRobot(so101_person.GuidedArm(hand), embedded.emulator, tmp_path / "truth.bin") as robot:
        yield robot


def new(arm, answer, capsys, monkeypatch):
    """Run the command with an answer on stdin; return its exit code and what it said."""
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    code = cli.main(["new", "my_arm", "--like", "so101", "--port", arm.port])
    captured = capsys.readouterr()
    return code, captured.out + captured.err


@pytest.mark.night  # `make test` calibrates by hand in test_so101_calibration.py
def test_without_an_answer_nothing_moves_and_the_pipeline_is_there(arm, tmp_path, capsys, monkeypatch):
    code, told = new(arm, "", capsys, monkeypatch)
    assert (code, told.count(QUESTION)) == (2, 1), told
    assert "Enter was not pressed, so the arm was not recorded" in told
    made = tmp_path / "pipelines" / "my_arm"
    assert json.loads((made / "calibration.json").read_text()) == json.loads(
        (SO101.folder / "calibration.json").read_text()
    )
    # The new pipeline is an arm of the same name on the same port, with the new file.
    assert cli.main(["record", "my_arm", "--duration-s", "1", "--dry-run"]) == 0
    assert f"on {arm.port}" in capsys.readouterr().err
    assert set(arm.truth().of(Kind.EFFECT)["values"][:, 0].tolist()) <= {OperatingMode.OFF}


@pytest.mark.night
@pytest.mark.timeout(900)
def test_an_answer_gives_an_accepted_twin(arm, tmp_path, capsys, monkeypatch):
    code, told = new(arm, "\n", capsys, monkeypatch)
    assert (code, told.count(QUESTION)) == (0, 1), told
    (page,) = tmp_path.glob("runs/my_arm/*/report.html")
    assert "accepted" in page.read_text()
