"""What is refused as a robot: all that it misses is named at once, before anything is made of it."""

import pytest
from small_robot import PairRobot

from sim2real.errors import UsageError
from sim2real.robots.contract import RecordedRobot, Robot, checked
from sim2real.robots.roles import Roles


class Bare(Robot):
    rate_hz = -50.0
    command = "goal"
    action = ("speed",)


def test_all_that_is_missing_or_wrong_is_named_at_once():
    with pytest.raises(UsageError) as caught:
        Bare()
    said = str(caught.value)
    for name in ("connect", "prepare", "recording_nodes", "deployment_nodes", "training", "nominal", "score"):
        assert f"has no {name}()" in said
    for part in ("has no units: field -> unit", "has rate_hz = -50.0", "has action = ('speed',)", "has no observation"):
        assert part in said
    assert "has command" not in said
    assert caught.value.hint == "sim2real.robots.contract.Robot says what each of them is"


def test_a_recorded_robot_needs_less():
    with pytest.raises(UsageError, match=r"has no identifiable.*has no units") as caught:
        type("Little", (RecordedRobot,), {})()
    assert "connect" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"training": None}, r"has training = None, which does not take \(values, draws, computation, delays\)"),
        ({"score": lambda self, t_s: {}}, r"has score = .* does not take \(t_s, states\)"),
        ({"units": property(lambda self: {"position": 3})}, r"has units = \{'position': 3\}, which is not field"),
    ],
)
def test_what_only_an_object_shows_is_refused_when_it_is_loaded(changes, said):
    robot = type("Odd", (PairRobot,), changes)()
    with pytest.raises(UsageError, match=said):
        checked(robot, "here")


def test_two_nodes_cannot_have_one_name():
    with pytest.raises(UsageError, match="four different names"):
        type("Twice", (PairRobot,), {"roles": Roles(sensor="agent")})()


def test_a_robot_that_is_one_is_returned(pair):
    assert checked(pair, "here") is pair
