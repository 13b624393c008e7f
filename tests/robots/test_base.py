"""What is refused as a robot, before anything is made of it."""

import pytest
from small_robot import PairRobot

from sim2real.errors import UsageError
from sim2real.robots.robot import PARTS, RecordedRobot, Robot, RobotDrive, checked


class BareDrive(RobotDrive):
    """A drive without data."""

    def device(self, port, silence_s, embedded):
        """Do nothing."""

    def prepare(self, rig, settle_s):
        """Do nothing."""

    def read(self, reading):
        """Do nothing."""


class Bare(Robot):
    """A robot that has one part."""

    def __init__(self):
        self.drive = BareDrive()


def test_all_gaps_are_listed_at_once():
    with pytest.raises(UsageError) as caught:
        checked(Bare(), "here")
    for name in set(PARTS) - {"drive"}:
        assert f"its {name} is None, not a Robot{name.capitalize()}" in str(caught.value)
    for gap in ("rate_hz", "command", "units", "message"):
        assert f"its drive has no {gap}" in str(caught.value)


def test_a_recorded_robot_needs_units_alone():
    robot = type("Little", (RecordedRobot,), {"identifiable": lambda self, max_delay_s: None})()
    with pytest.raises(UsageError, match="it has no units"):
        checked(robot, "here")


def test_a_part_of_another_kind_is_refused(pair):
    robot = PairRobot()
    robot.task = pair.model
    with pytest.raises(UsageError, match=r"its task is .*, not a RobotTask"):
        checked(robot, "here")
