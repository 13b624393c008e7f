"""Groups of joints with values other than the shared one, on a robot of two servos that C MuJoCo records."""

import mujoco
import numpy as np
import pytest
from recorded_on_c import play

from sim2real.identification.config import FitConfig
from sim2real.identification.fit import fit, refine
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.robots.model.parameters import ParameterPattern, like_joints, sharing, usual_patterns
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.stages.shared.identification import offering, with_wanted_terms

GO2 = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
ARM = ["shoulder_pan", "shoulder_lift", "elbow_flex", "gripper"]
STEP_S, PERIOD, SECONDS, NOISE, KP, DAMPING = 0.002, 5, 2.8, 2e-4, (12.0, 24.0), 0.4
XML = """<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
  <body><joint name="pan" axis="0 1 0" damping="0.4" armature="0.02"/>
  <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body>
  <body pos="0 1 0"><joint name="lift" axis="0 1 0" damping="0.4" armature="0.02"/>
  <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/></body></worldbody></mujoco>"""


def test_joints_with_like_names_form_a_group():
    assert like_joints(GO2) == [GO2[0::3], GO2[1::3], GO2[2::3]]
    assert like_joints(["leftKnee", "left_ankle", "rightKnee", "right_ankle"])[0] == ["leftKnee", "rightKnee"]
    assert like_joints(ARM) == [[name] for name in ARM]
    assert like_joints(["joint1", "joint2", "joint3"]) == [["joint1", "joint2", "joint3"]]


def test_groups_are_offered_where_there_are_some_and_single_joints_where_there_are_few():
    usual = (*usual_patterns(("goal",)), ParameterPattern("kd", free=False))
    names = {t.term for t in sharing(usual, GO2, "auto")}
    assert names == {"kp_by_group", "damping_by_group", "armature_by_group"}
    calves = next(t for t in sharing(usual, GO2, "auto") if t.name == "kp_of_calf_joint")
    assert calves.joints.count("|") == 3
    assert {t.term for t in sharing(usual, ARM, "auto")} == {"kp_by_joint", "damping_by_joint", "armature_by_joint"}
    assert {t.term for t in sharing(usual, GO2, "load,kp_by_joint")} == {"kp_by_joint"}
    assert "kp_by_joint" in {t.term for t in sharing(usual, GO2, "all")}, "`validate` finds it again"
    assert sharing(usual, ["joint1"], "auto") == []


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "arm.xml"
    path.write_text(XML)
    model = mujoco.MjModel.from_xml_string(XML)
    t = STEP_S * PERIOD * np.arange(round(SECONDS / STEP_S / PERIOD))
    goals = np.stack([0.8 * np.sin(3.1 * t) + 0.3 * np.sin(9.3 * t), 0.7 * np.sin(4.0 * t + 1.0)], axis=1)
    episode = play(model, goals, lambda k, _, data: np.array(KP) * (goals[k] - data.qpos), PERIOD, NOISE)
    terms = (ParameterPattern("kp"), ParameterPattern("damping"))
    config = RobotConfig(path, ("pan", "lift"), ("goal",), step_s=STEP_S, rate_hz=100.0, terms=terms, sigma_rad=NOISE)
    return MjcfRobot(config), episode


@pytest.mark.night
def test_a_joint_with_another_stiffness_gets_a_factor(recorded):
    robot, episode = recorded
    robot = offering(robot, "kp_by_joint")
    model = robot.identifiable(0.02)
    spans = [Span(0, begin) for begin in np.arange(0.2, SECONDS - 0.8, 0.6)]
    table = with_wanted_terms(model.parameters, "kp_by_joint")
    found = fit(Problem(model, [episode], spans, 0.6, FitConfig(generations=0, max_delay_s=0.02), table))
    # Without the factor, in the same programs.
    problem, shared = found.problem, np.array([name != "kp_of_lift_alone" for name in found.problem.table.names])
    assert not shared.all()
    assert found.loss < 0.01 * refine(problem, problem.table.start()[None], problem.part(present=shared)).loss
    assert found.values["kp"] == pytest.approx(KP[0], rel=0.03)
    assert found.values["kp_of_lift_alone"] == pytest.approx(KP[1] / KP[0], rel=0.05)
    assert found.values["damping"] == pytest.approx(DAMPING, rel=0.05)
    # The model with these values has both stiffnesses.
    made = mujoco.MjModel.from_xml_string(robot.exported(found.values).mjcf)
    assert made.actuator_gainprm[:, 0] == pytest.approx(KP, rel=0.06)
