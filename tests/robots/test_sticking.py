"""Dry friction holds a joint; MuJoCo's default impedance lets it creep, and too few iterations let it shiver."""

import mujoco
import numpy as np
import pytest

from sim2real.robots.model.drives import driven
from sim2real.robots.model.file import read_model
from sim2real.robots.model.parameters import usual_patterns
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.load import load_robot

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
    robot = MjcfRobot(
        RobotConfig(model_file(), ("lift",), ("torque",), step_s=STEP_S, terms=usual_patterns(("torque",)))
    )
    values = {p.name: 1.0 if p.name.startswith("frictionloss") else p.nominal for p in robot.dynamics()}
    exported = mujoco.MjModel.from_xml_string(robot.exported(values).mjcf)
    np.testing.assert_allclose(exported.dof_solref, robot.model.dof_solref)
    np.testing.assert_allclose(exported.dof_solimp, robot.model.dof_solimp)
    assert crept(exported) < 1e-3


@pytest.mark.parametrize("name", ["so101", "arm"])
def test_an_exported_servo_robot_rests_where_friction_holds_it(name):
    """With a single iteration of the solver, as in training, its joints shiver and creep."""
    robot = load_robot(name)
    model = mujoco.MjModel.from_xml_string(robot.model.exported(robot.nominal()).mjcf)
    model.opt.gravity[:], model.dof_frictionloss[:] = 0.0, 0.2

    def fastest():
        data = mujoco.MjData(model)
        data.ctrl[:] = data.qpos + 0.16 / model.actuator_gainprm[:, 0]
        speeds = []
        for _ in range(round(3.0 / model.opt.timestep)):
            mujoco.mj_step(model, data)
            speeds.append(np.abs(data.qvel).max())
        return max(speeds[len(speeds) // 3 :])

    assert fastest() < 1e-3
    model.opt.iterations, model.opt.ls_iterations = 1, 4
    assert fastest() > 1e-2, "few iterations do suffice: training may have them, too"
