"""What is refused as a robot: all that it misses is named at once, before anything is made of it."""

import re
from abc import ABC, abstractmethod

import pytest
from small_robot import PairRobot

from sim2real.errors import UsageError
from sim2real.robots.contract import RecordedRobot, Robot, RobotDrive
from sim2real.robots.from_model.recorded import LoggedRobot
from sim2real.robots.loading import PARTS, checked
from sim2real.robots.roles import Roles


class BareDrive(RobotDrive):
    """A drive with wrong data."""

    rate_hz, command, units = -50.0, "goal", {"goal": 3}

    def connect(self, port, limits):
        """Lack two arguments."""

    def prepare(self, session, settle_s):
        """Do nothing."""


class Bare(Robot):
    """A robot that has one part."""

    def __init__(self):
        self.drive = BareDrive()


def test_all_gaps_are_listed_at_once():
    with pytest.raises(UsageError) as caught:
        checked(Bare(), "here")
    message = str(caught.value)
    for name in set(PARTS) - {"drive"}:
        assert f"has no {name}: a sim2real.robots.contract.Robot{name.capitalize()}" in message
    for gap in ("has rate_hz = -50.0, which is not a number above 0 [Hz]", "has units = {'goal': 3}", "has no message"):
        assert f"has a drive that {gap}" in message
    assert re.search(r"drive that has connect = .* does not take \(port, limits, truth_path, seed\)", message)
    assert "has command" not in message
    assert caught.value.hint == "sim2real.robots.contract.Robot describes each of them"


@pytest.mark.parametrize("name", PARTS)
def test_a_part_without_its_methods_cannot_be_made(name):
    base = PARTS[name][0]
    with pytest.raises(UsageError, match="Mine is not complete: it has no ") as caught:
        type("Mine", (base,), {})()
    assert all(f"has no {method}()" in str(caught.value) for method in base.__abstractmethods__)
    assert caught.value.hint == f"sim2real.robots.contract.{base.__name__} describes each of them"


def test_a_recorded_robot_needs_less():
    with pytest.raises(UsageError, match=r"has no identifiable\(\)"):
        type("Little", (RecordedRobot,), {})()
    with pytest.raises(UsageError, match=r"has no dynamics\(\); it has no make_nodes\(\)") as caught:
        type("Logged", (LoggedRobot,), {})()
    assert caught.value.hint == f"{LoggedRobot.__module__}.LoggedRobot describes each of them"
    with pytest.raises(UsageError, match=r"has no identifiable\(\); it has no more\(\)") as caught:
        type("Mine", (RecordedRobot, ABC), {"more": abstractmethod(lambda self: None)})()
    assert caught.value.hint.startswith("sim2real.robots.contract.")
    robot = type("Little", (RecordedRobot,), {"identifiable": lambda self, max_delay_s: None})()
    with pytest.raises(UsageError, match="it has no units: field -> unit") as caught:
        checked(robot, "here")
    assert "drive" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"training": None}, r"has training = None, which does not take \(values, draws, computation, delays\)"),
        ({"nominal": lambda self, t_s: {}}, r"has nominal = .* does not take \(\)"),
        ({"units": property(lambda self: {"position": 3})}, r"has units = \{'position': 3\}, which is not field"),
        ({"roles": Roles(sensor="agent")}, "four different names"),
    ],
)
def test_an_incomplete_object_is_refused_when_it_is_loaded(changes, message):
    robot = type("Odd", (PairRobot,), changes)()
    with pytest.raises(UsageError, match=message):
        checked(robot, "here")


def test_a_part_of_another_kind_is_refused(pair):
    robot = PairRobot()
    robot.task = pair.model
    with pytest.raises(UsageError, match=r"has task = .*, which does not inherit from .*RobotTask"):
        checked(robot, "here")
