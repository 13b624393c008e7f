"""Positions of a log beyond the ranges of a model's joints."""

import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.robots.model.robot import MjcfRobot, RobotConfig

ARM = """<mujoco><compiler {}/><worldbody><body><joint name="elbow" axis="0 1 0" range="-1.5 1.5"/>
<geom size="0.02 0.1" type="capsule" pos="0 0 -0.1"/></body></worldbody></mujoco>"""


def doubts(path, compiler, position):
    (path / "arm.xml").write_text(ARM.format(compiler))
    robot = MjcfRobot(RobotConfig(path / "arm.xml", ("elbow",), ("goal",)))
    return robot.doubts({"sensor": {"position": position[:, None]}})


def test_ranges_in_degrees_that_a_file_means_in_radians_are_refused(tmp_path):
    swing = np.sin(np.linspace(0.0, 20.0, 200))
    assert not doubts(tmp_path, 'angle="radian"', swing)
    with pytest.raises(UsageError, match=r"elbow goes from -0.996 to .* -0.0262 to 0.0262: .*cannot move") as error:
        doubts(tmp_path, "", swing)
    assert "compiler angle" in (error.value.hint or "")


def test_a_zero_elsewhere_is_reported(tmp_path):
    swing = np.sin(np.linspace(0.0, 20.0, 200))
    (line,) = doubts(tmp_path, 'angle="radian"', swing + 1.6)
    assert "elbow goes from 0.6" in line
    assert "check zero and sign" in line
    assert not doubts(tmp_path, 'angle="radian"', swing + 0.6)
