"""From a pipeline, a robot or a run to an environment: what is taken, and what is refused."""

import numpy as np
import pytest

import sim2real
from sim2real.errors import Sim2RealError, UsageError
from sim2real.interop import robot_environment


def delays(made):
    """The two delays that an environment's episodes are drawn around."""
    return {n: v for n, v in made.env.task.values.items() if n.endswith("_delay")}


def test_the_nominal_model_has_delays_where_they_are_given(pendulum):
    assert sum(delays(pendulum).values()) == pytest.approx(0.045)
    assert delays(robot_environment("pendulum", "nominal")) == {}
    robot = sim2real.load_robot("pendulum")
    changed = robot_environment(robot, "nominal", {"damping": 3.5})
    assert changed.env.task.values == {**robot.nominal(), "damping": 3.5}


def test_what_does_not_exist_is_named(tmp_path):
    with pytest.raises(UsageError, match=r"there is no parameter 'mass'\. Available: gain, gravity, damping, friction"):
        robot_environment("pendulum", "nominal", {"mass": 1.0})
    with pytest.raises(UsageError, match="only 'sensor_delay' was given: a loop has sensor_delay and actuator_delay"):
        robot_environment("pendulum", "nominal", {"sensor_delay": 0.01})
    with pytest.raises(UsageError, match="there is no file, pipeline or run 'pendulun'"):
        robot_environment("pendulun", runs=tmp_path)
    with pytest.raises(Sim2RealError, match="identify"):
        robot_environment("pendulum", runs=tmp_path)


def test_a_robot_that_shows_more_than_it_names_is_refused(pendulum):
    from dataclasses import replace

    from sim2real.interop.robot import RobotEnvironment
    from sim2real.stages.train.bundle import contract_of

    env = pendulum.env
    contract = contract_of(sim2real.load_robot("pendulum"), env.task, {})
    contract = replace(contract, observation=contract.observation[1:])
    with pytest.raises(UsageError, match="observation terms have 16 entries, its task has 19"):
        RobotEnvironment(env, contract)
    assert np.isfinite([e.low for e in pendulum.observation]).all()
