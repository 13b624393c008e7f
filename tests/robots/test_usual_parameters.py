"""Joints whose drives the model's file describes with the same figures share the default parameters."""

import mujoco as mj
import pytest

from sim2real.robots.model.parameters import expand, usual_patterns


def arm(names, gains, dampings):
    """Return a chain of links whose joints are servos with the given stiffness and damping."""
    bodies = "".join(
        f'<body name="b{i}" pos="0 0 .1"><joint name="{name}" axis="0 1 0" damping="{d}"/><geom size=".05"/>'
        for i, (name, d) in enumerate(zip(names, dampings, strict=True))
    )
    servos = "".join(f'<position joint="{n}" kp="{kp}" kv="{kv}"/>' for n, (kp, kv) in zip(names, gains, strict=True))
    end = "</body>" * len(names)
    return mj.MjModel.from_xml_string(
        f"<mujoco><worldbody>{bodies}{end}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def placed(model, joints, commands=("goal",), physical=False):
    terms = usual_patterns(commands, physical, model, joints)
    return {p.parameter.name: (p.parameter.nominal, p.at) for p in expand(terms, joints, model, model)}


def test_each_group_of_like_joints_starts_from_its_own_figures():
    joints = [f"joint{i}" for i in range(1, 5)]
    model = arm(joints, [(600, 60), (600, 60), (150, 20), (50, 8)], [1] * 4)
    found = placed(model, joints)
    assert {name: value for name, value in found.items() if name.startswith(("kp", "damping"))} == {
        "kp_joint1_joint2": (600, (0, 1)),
        "kp_joint3": (150, (2,)),
        "kp_joint4": (50, (3,)),
        # The only damping: that of the joint and that of the file's servo.
        "damping_joint1_joint2": (61, (0, 1)),
        "damping_joint3": (21, (2,)),
        "damping_joint4": (9, (3,)),
    }


@pytest.mark.parametrize(
    ("joints", "different", "names"),
    [
        (["FL_hip_joint", "FR_hip_joint", "FL_calf_joint", "FR_calf_joint"], 2, {"kp_hip", "kp_calf"}),
        (["a", "b", "c", "d", "e"], 1, {"kp_a_b_c_and_1", "kp_e"}),
        (["\u95a2", "\u7bc0", "\u8098"], 1, {"kp_group1", "kp_group2"}),
    ],
)
def test_a_group_has_the_name_of_what_its_joints_share(joints, different, names):
    gains = [(100, 0)] * (len(joints) - different) + [(20, 0)] * different
    assert {n for n in placed(arm(joints, gains, [1] * len(joints)), joints) if n.startswith("kp")} == names


def test_friction_that_the_file_does_not_have_may_be_far_below_the_guess():
    """A rail without friction: a bound of a fiftieth bent gain, damping and inertia, which only friction kept apart."""
    model = arm(["a", "b"], [(20, 1)] * 2, [1, 1])
    model.dof_frictionloss[0] = 0.05
    found = {
        p.parameter.name: p.parameter
        for p in expand(usual_patterns(("goal",), False, model, ["a", "b"]), ["a", "b"], model, model)
    }
    assert found["frictionloss_a"].low == pytest.approx(0.001)
    assert found["frictionloss_b"].low == pytest.approx(1e-5)


def test_like_joints_have_one_value():
    joints = ["x", "y"]
    assert {"kp", "damping", "armature"} < placed(arm(joints, [(20, 1)] * 2, [1, 1]), joints).keys()


def test_factors_of_the_logs_own_gains_are_for_all_joints():
    joints = ["x", "y"]
    found = placed(arm(joints, [(20, 1), (40, 1)], [1, 1]), joints, ("goal", "kp", "kd"), physical=True)
    assert {n for n in found if n.startswith("k")} == {"kp", "kd"}
    assert found["damping_x"] == (1, (0,))
