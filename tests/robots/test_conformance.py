"""Every robot here keeps what the stages ask of a robot; and the suite that says so notices who does not."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.robots import testing
from sim2real.robots.roles import Roles
from sim2real.stages.pipeline.pipeline import load_pipeline

pytestmark = pytest.mark.realtime


@pytest.mark.parametrize(
    "name", ["pendulum", "arm", pytest.param("so101", marks=pytest.mark.full), "disk", "xl330", "so101_log"]
)
def test_every_pipeline_here_has_a_robot(name, tmp_path):
    pipeline = load_pipeline(name)
    gate = replace(pipeline.record.gate, servo_watchdog_s=0.5)  # a busy machine is not what is tested
    testing.check_robot(pipeline.load(), tmp_path, gate)


def changed(**changes):
    return type("Changed", (type(load_pipeline("pendulum").load()),), changes)()


def too_strong(robot, values, draws, computation, delays):
    nodes, task = super(type(robot), robot).training(values, draws, computation, delays)
    task.action_high = 2.0 * task.action_high
    return nodes, task


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"units": {"action": "V"}}, "units: there are action, but not th, thdot"),
        ({"roles": Roles(world="plant")}, "nodes of the model: there are .* but not plant"),
        ({"nominal": lambda _: {"gain": 1e9}}, "gain = 1000000000.0 is outside its bounds"),
        ({"nominal": lambda _: {"mass": 1.0}}, "parameters that can be identified: .* but not mass"),
        ({"training": too_strong}, "go beyond what the robot bears"),
    ],
)
def test_who_does_not_fit_is_noticed(changes, said, tmp_path):
    with pytest.raises(AssertionError, match=said):
        testing.check_robot(changed(**changes, embedded=None), tmp_path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"joints": {"hinge": {"position": "angle"}}}, "fields of joints: there are th, thdot, but not angle"),
        ({"score": lambda _, t_s, states: {"success": np.nan}}, "success is nan, not a share"),
        ({"reward": lambda _, state, action: {"voltage": action}}, r"reward 'voltage' of a state has shape \(1,\)"),
        ({"observation": load_pipeline("pendulum").load().observation[:2]}, r"the policy sees \(19,\), not \(15,\)"),
    ],
)
def test_what_only_an_episode_shows_is_noticed(changes, said):
    with pytest.raises(AssertionError, match=said):
        testing.check_simulation(changed(**changes))
