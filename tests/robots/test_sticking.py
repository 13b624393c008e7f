"""Dry friction of a robot from its MJCF holds a joint; MuJoCo's default impedance lets it creep."""

import mujoco
import numpy as np
import pytest

from sim2real.robots.from_model.mjcf import driven, read_model
from sim2real.robots.from_model.mjcf_robot import MjcfRobot, RobotConfig
from sim2real.robots.from_model.usual_parameters import usual_terms

XML = """<mujoco><worldbody><body><joint name="lift" axis="0 1 0" frictionloss="1" {own}/>
<inertial pos="0.1 0 0" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>"""
STEP_S = 0.002


def crept(model):
    """Return how far a weight moves its joint in 10 s, half of which friction would hold [rad]."""
    data = mujoco.MjData(model)
    for _ in range(round(10.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return abs(float(data.qpos[0]))


@pytest.fixture
def model_file(tmp_path):
    def written(own=""):
        (tmp_path / "arm.xml").write_text(XML.format(own=own))
        return tmp_path / "arm.xml"

    return written


def test_a_joint_that_friction_holds_stays_where_it_is(model_file):
    plain = read_model(model_file())
    assert crept(plain) > 0.02, "the file's own model creeps"
    assert crept(driven(model_file(), ("lift",), STEP_S, False, False)) < 1e-3


def test_an_impedance_of_the_file_is_kept(model_file):
    path = model_file('solreffriction="0.01 1" solimpfriction="0.8 0.9 0.001 0.5 2"')
    model = driven(path, ("lift",), STEP_S, False, False)
    assert model.dof_solref[0] == pytest.approx([0.01, 1.0])
    assert model.dof_solimp[0, :2] == pytest.approx([0.8, 0.9])


def test_the_identified_model_holds_its_joints_as_the_identification_did(model_file):
    robot = MjcfRobot(RobotConfig(model_file(), ("lift",), ("torque",), step_s=STEP_S, terms=usual_terms(("torque",))))
    values = {p.name: 1.0 if p.name.startswith("frictionloss") else p.nominal for p in robot.dynamics()}
    exported = mujoco.MjModel.from_xml_string(robot.identified_mjcf(values))
    np.testing.assert_allclose(exported.dof_solref, robot.model.dof_solref)
    np.testing.assert_allclose(exported.dof_solimp, robot.model.dof_solimp)
    assert crept(exported) < 1e-3
