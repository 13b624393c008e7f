"""LeRobot's own follower of the SO-101 fulfils the contract of a device; run where LeRobot is importable."""

import json
import os
import re
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

# The follower imports the training library for names in annotations and for a progress bar: they take 5 GB, and no
# robot uses them. Everything that addresses the servos is LeRobot's own.
UNUSED = ("torch", "accelerate", "datasets", "datasets.utils", "datasets.utils.logging")
sys.modules |= {name: MagicMock() for name in UNUSED}
processor: Any = ModuleType("lerobot.processor")
processor.RobotAction = processor.RobotObservation = dict[str, Any]
sys.modules["lerobot.processor"] = processor
import lerobot.robots.so_follower  # noqa: E402, F401

for name in UNUSED:
    del sys.modules[name]  # SciPy looks for PyTorch's arrays

import numpy as np  # noqa: E402
import pytest  # noqa: E402

import sim2real  # noqa: E402
from pipelines.so101.robot import ROBOT, SERVOS  # noqa: E402
from sim2real import cli  # noqa: E402
from sim2real.errors import UsageError  # noqa: E402
from sim2real.hardware.emulation.embedded import EmbeddedRobot  # noqa: E402
from sim2real.hardware.feetech.emulation import StsEmulation  # noqa: E402
from sim2real.hardware.lerobot.device import LerobotServos, LerobotSettings  # noqa: E402
from sim2real.hardware.lerobot.link import LerobotConfig  # noqa: E402
from sim2real.hardware.testing import DeviceConformance  # noqa: E402
from sim2real.robots.servo.drive import ServoDrive  # noqa: E402

IDS = (1, 2, 3, 4, 5, 6)
NAMES = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
ENTRY = {"drive_mode": 0, "homing_offset": 0, "range_min": 0, "range_max": 4095}
FOLDER = Path(tempfile.mkdtemp(prefix=f"lerobot-{os.getpid()}-"))
(FOLDER / "arm.json").write_text(json.dumps({name: {"id": i, **ENTRY} for i, name in zip(IDS, NAMES, strict=True)}))


class TestLerobot(DeviceConformance):
    emulation = StsEmulation
    plant = f"{Path(__file__).parents[1] / 'plants.py'}:Joints"
    plant_args = {"ids": list(IDS), "start_rad": [0.0] * 6}  # noqa: RUF012
    patience_s = 2.0
    silent_after_s = 4.0  # LeRobot writes 70 registers when it connects

    def make_device(self, port):
        # Patient with lost answers: LeRobot reads all six servos again if one of their answers is lost.
        make = LerobotSettings("so101_follower", "arm", FOLDER).make
        return LerobotServos(LerobotConfig(port, max_silence_s=3.0, silence_s=0.8, make=make), IDS)


def test_the_guide_drives_the_arm(tmp_path, monkeypatch):
    """Directly, and as the device of a robot's file; the angles of both are the plant's."""
    monkeypatch.setattr("lerobot.robots.robot.HF_LEROBOT_CALIBRATION", tmp_path)
    folder = tmp_path / "robots" / "so_follower"
    folder.mkdir(parents=True)
    (folder / "my_arm.json").write_bytes((FOLDER / "arm.json").read_bytes())
    guide = (Path(__file__).parents[3] / "docs/guides/so101.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", guide.split("## Through LeRobot's own driver")[1], re.DOTALL)
    start = [0.1, -0.2, 0.3, 0.0, -0.1, 0.2]
    robot = EmbeddedRobot(TestLerobot.plant, StsEmulation(), {"ids": list(IDS), "start_rad": start}, tmp_path / "truth")
    try:
        names = {}
        exec(code.replace("/dev/ttyACM0", robot.port), names)
        with names["arm"] as arm:
            np.testing.assert_allclose(arm.measure().position_rad, start, atol=0.01)
            arm.enable()
            arm.command(np.array(start) + 0.05)
        drive = ServoDrive(replace(SERVOS, device="lerobot"))
        with drive.make_device(robot.port, names["settings"], 0.8) as arm:
            assert isinstance(arm, LerobotServos)
            assert len(arm.measure().position_rad) == len(IDS)
    finally:
        robot.stop()


def test_an_unknown_robot_is_refused():
    with pytest.raises(UsageError, match=r"no robot 'so99'. Available: .*so101_follower"):
        LerobotSettings("so99").make("/dev/null")


def test_an_so101_is_recorded_through_lerobot(tmp_path, monkeypatch):
    """The device `lerobot` in place of `feetech` in the robot's drive; its positions are those of the emulated arm."""
    calibration = Path(__file__).parents[3] / "pipelines/so101/calibration.json"
    (tmp_path / "arm.json").write_bytes(calibration.read_bytes())
    settings = LerobotSettings("so101_follower", "arm", tmp_path)
    monkeypatch.setattr(ROBOT.drive, "servos", replace(SERVOS, device="lerobot"))
    monkeypatch.setattr(ROBOT.drive, "_settings", lambda port: settings)
    assert not cli.main(["record", "so101", "--port", "embedded", "--duration-s", "2", "--runs", str(tmp_path)])
    (log,) = tmp_path.glob("so101/*/record/session.mcap")
    recording = sim2real.Recording.load(log)
    position = np.asarray(recording.episode.outputs["sensor"]["position"])
    assert (np.ptp(position, axis=0) > 0.1).all(), "every joint moves"
    assert (position >= np.array(SERVOS.low) - 0.1).all()
    assert (position <= np.array(SERVOS.high) + 0.1).all()
