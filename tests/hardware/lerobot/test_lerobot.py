"""Units and refusals of robots of LeRobot, without LeRobot; `test_lerobot_conformance.py` drives its follower."""

import math
from types import SimpleNamespace

import pytest

from sim2real.errors import UsageError
from sim2real.hardware.lerobot.device import LerobotSettings, _unit, servos
from sim2real.hardware.registry import load_device


def test_without_lerobot_its_package_is_named():
    with pytest.raises(UsageError, match=r"cannot import .*lerobot[\s\S]*pip install 'sim2real\[lerobot\]'"):
        LerobotSettings().make("/dev/null")


def test_the_device_has_a_name():
    assert load_device("lerobot") is servos


@pytest.mark.parametrize(
    ("mode", "value", "angle"),
    [
        ("DEGREES", 90.0, math.pi / 2),
        ("RANGE_M100_100", 100.0, math.pi / 4),
        ("RANGE_0_100", 0.0, -math.pi / 4),
        ("RANGE_0_100", 50.0, 0.0),
    ],
)
def test_units_of_lerobot(mode, value, angle):
    unit_rad, zero_rad, low, high = _unit(mode, SimpleNamespace(range_min=1024, range_max=2048, drive_mode=0))
    assert value * unit_rad + zero_rad == pytest.approx(angle, abs=5e-4)
    assert (low, high) == pytest.approx((-math.pi / 4, math.pi / 4))


def test_a_mirrored_joint_in_degrees_is_refused():
    """LeRobot mirrors its other units alone."""
    with pytest.raises(UsageError, match="drive_mode 1"):
        _unit("DEGREES", SimpleNamespace(range_min=1024, range_max=2048, drive_mode=1))


def test_a_robot_without_a_bus_of_feetech_servos_is_refused():
    robot = SimpleNamespace(make=lambda port: SimpleNamespace(bus=None, calibration={}))
    with pytest.raises(UsageError, match="no FeetechMotorsBus, so no guardian"):
        servos("/dev/null", (1,), robot, baud_rate=1_000_000, silence_s=0.5).open()
