"""Every robot here keeps what the stages ask of a robot; and the suite that says so notices who does not."""

import numpy as np
import pytest

from sim2real.identification.model import Channel
from sim2real.robots import testing
from sim2real.robots.robot import Judgement
from sim2real.stages.load import load_robot


@pytest.mark.parametrize(
    "name",
    ["pendulum", *(pytest.param(n, marks=pytest.mark.night) for n in ("arm", "so101")), "disk", "xl330", "so101_log"],
)
def test_every_pipeline_here_has_a_robot(name, tmp_path):
    pipeline = load_robot(name)
    testing.check_robot(pipeline, tmp_path, pipeline.defaults.record.gate)


def pendulum(part=None, **changes):
    """Return the pendulum with other attributes of itself or of one of its parts."""
    robot = load_robot("pendulum")
    if part is None:
        return type("Changed", (type(robot),), changes)()
    robot = type(robot)()
    setattr(robot, part, type("Changed", (type(getattr(robot, part)),), changes)())
    return robot


@pytest.mark.parametrize(
    ("part", "changes", "message"),
    [
        (None, {"units": {"action": "V"}}, "units: there are action, but not th, thdot"),
        (None, {"nominal": lambda _: {"gain": 1e9}}, "gain = 1000000000.0 is outside its bounds"),
        (None, {"nominal": lambda _: {"mass": 1.0}}, "parameters that can be identified: .* but not mass"),
        (
            "drive",
            {"channels": (Channel("angle", None, 0.002, 0.05),)},
            "fields that the sensor measures: there are th, thdot, but not angle",
        ),
        ("task", {"score": lambda _, t_s, states: {"success": np.nan}}, "success is nan, not a share"),
        (
            "task",
            {"judge": lambda _, state, action: Judgement({"voltage": action}, action[0] > 0)},
            r"reward 'voltage' of a state has shape \(1,\)",
        ),
        (
            "task",
            {"observation": load_robot("pendulum").task.observation[:2]},
            r"an observation has shape \(19,\), not \(15,\)",
        ),
    ],
)
def test_a_robot_that_does_not_fit_is_refused(part, changes, message):
    robot = pendulum(part, **changes)

    def check():
        testing.check_identification(robot)
        testing.check_simulation(robot)

    with pytest.raises(AssertionError, match=message):
        check()
