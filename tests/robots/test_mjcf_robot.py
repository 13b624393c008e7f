"""Robots of a model and a recording: drives, parameters by pattern, the description as a file."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.robots.model.drives import driven, force_of, gains_of, joints_of, limit_of
from sim2real.robots.model.file import read_model
from sim2real.robots.model.parameters import ParameterPattern, usual_patterns
from sim2real.robots.model.robot import MjcfRobot, RobotConfig
from sim2real.worlds.driven import DriveCommand

XML = """<mujoco>
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper"><joint name="left_hip" axis="0 1 0" damping="0.1" armature="0.01" frictionloss="0.05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.4" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -0.2"><joint name="left_knee" axis="0 1 0" damping="0.2" armature="0.02"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.2" contype="0" conaffinity="0"/></body></body>
    <body name="other" pos="0 1 0"><joint name="right_hip" axis="0 1 0"/>
      <geom type="sphere" size="0.05" mass="0.3" contype="0" conaffinity="0"/></body>
    {free}
  </worldbody>
  <actuator>
    <position joint="left_hip" kp="12" kv="0.7" forcerange="-3 3"/>
    <position joint="left_knee" kp="8" forcerange="-2 2"/>
  </actuator>
</mujoco>"""
FREE = '<body name="base" pos="0 0 1"><freejoint name="root"/><geom size="0.1" mass="1"/></body>'
URDF = """<robot name="r"><link name="a"/><link name="b"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"""
JOINTS = ("left_knee", "left_hip")


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(XML.format(free=""))
    return path


def config(path, **options):
    return RobotConfig(**{"model": path, "joints": JOINTS, "commands": ("goal",), "step_s": 0.002, **options})


def test_a_gear_counts_in_what_a_file_says(tmp_path):
    """Before the gear a motor makes 5 N m at most, and a servo sees 3 times the joint's angle."""
    path = tmp_path / "geared.xml"
    path.write_text("""<mujoco><worldbody>
      <body><joint name="m"/><geom size=".1"/></body><body pos="1 0 0"><joint name="s"/><geom size=".1"/></body>
    </worldbody><actuator><motor joint="m" gear="25" ctrllimited="true" ctrlrange="-5 5"/>
      <position joint="s" kp="4" kv="0.5" gear="3" forcelimited="true" forcerange="-2 2"/></actuator></mujoco>""")
    own = read_model(path)
    assert (force_of(own, "m"), limit_of(own, "m"), gains_of(own, "m")) == (25.0, 125.0, None)
    assert (force_of(own, "s"), limit_of(own, "s"), gains_of(own, "s")) == (None, 6.0, (36.0, 4.5))
    robot = MjcfRobot(RobotConfig(model=path, joints=("m",), commands=("torque",), terms=(ParameterPattern("gain"),)))
    (gain,) = robot.dynamics()
    assert (gain.nominal, gain.low, gain.high) == (25.0, pytest.approx(0.05), pytest.approx(500.0))


def test_a_drive_has_no_defaults_of_the_files_servos(model_file):
    """A new actuator in a file with default gains had this stiffness, damping and limit in addition to its own."""
    plain = driven(model_file, JOINTS, 0.002, False, False)
    default = '<default><position kp="35" kv="0.6" forcerange="-2 2" ctrlrange="-1 1"/></default><worldbody>'
    model_file.write_text(model_file.read_text().replace("<worldbody>", default))
    made = driven(model_file, JOINTS, 0.002, False, False)
    for field in ("gainprm", "biasprm", "biastype", "gear", "ctrllimited", "forcelimited"):
        np.testing.assert_array_equal(getattr(made, f"actuator_{field}"), getattr(plain, f"actuator_{field}"))


@pytest.mark.parametrize(("kv", "goal", "most"), [(0.7, (0.1, -0.15), 2.9), (0.0, (0.5, -1.4), np.inf)])
def test_drives_push_as_mujocos_own_position_servos(model_file, kv, goal, most):
    """Three actuators a joint, whose controls are force, stiffness and damping, are one servo with these gains.

    Also where torque is limited, but for the damping of a drive at its limit, which C MuJoCo then takes as explicit.
    """
    model_file.write_text(model_file.read_text().replace('kv="0.7"', f'kv="{kv}"'))
    own = mujoco.MjModel.from_xml_path(str(model_file))
    made = driven(model_file, JOINTS, 0.002, False, False)
    own.dof_solref[:], own.dof_solimp[:] = made.dof_solref[0], made.dof_solimp[0]  # friction that holds a joint
    assert [made.joint(i).name for i in range(made.njnt)] == ["left_hip", "left_knee"]  # the other one is held
    told, kp, kd = np.array(goal), np.array([8.0, 12.0]), np.array([0.0, kv])
    a, b = mujoco.MjData(own), mujoco.MjData(made)
    pushed = []
    for _ in range(400):
        a.ctrl[:] = told[::-1]
        b.ctrl[:] = np.concatenate([kp * told, kp, kd])
        mujoco.mj_step(own, a)
        mujoco.mj_step(made, b)
        np.testing.assert_allclose(b.qpos, a.qpos[:2], atol=1e-9)
        pushed.append(np.abs(a.actuator_force).max())
    assert max(pushed) < most
    assert most < np.inf or max(pushed) == 3.0
    assert np.abs(a.qpos[:2]).max() > 0.05


def control(robot, values=None, **told):
    """Return forces, stiffnesses and dampings for a command."""
    model = robot.identifiable(0.02)
    world = robot.make_nodes()[2]
    values = {p.name: p.nominal for p in model.parameters} | (values or {})
    params = model.params(values, jnp.zeros(4))["world"]
    newest = SimpleNamespace(data=DriveCommand(**{k: jnp.asarray(v) for k, v in told.items()}))
    state: Any = SimpleNamespace(params=params, inputs={"actuator": [newest]})
    return np.asarray(world._control(state)).reshape(3, 2)


def nominal(**terms):
    return tuple(ParameterPattern(what, nominal=value) for what, value in terms.items())


@pytest.mark.parametrize(
    ("options", "told", "pushed"),
    [
        # Positions are pulled to goals, by the encoder's angle.
        ({"terms": (*nominal(kp=10.0), ParameterPattern("zero", each=True))}, {"goal": [0.5, 0.2]}, ([4, 2], 10, 0)),
        # Torque that is off leaves what short-circuited windings brake.
        ({"terms": nominal(kp=10.0, kd=0.4, released=0.25)}, {"goal": [0.5, 0.2], "enabled": [0.0]}, (0, 0, 0.1)),
        # MIT mode takes everything from the log.
        ({"terms": nominal(kp=1.0, kd=1.0)}, {"goal": [0.1, 0.2], "goal_velocity": [1.0, 2.0], "torque": [0.5, 0.0],
         "kp": [20.0, 10.0], "kd": [1.0, 2.0]}, ([20 * 0.1 + 1.0 * 1.0 + 0.5, 10 * 0.2 + 2.0 * 2.0], [20, 10], [1, 2])),
        # A firmware's gain counts in its own unit.
        ({"terms": nominal(kp=10.0), "kp_unit": 200.0}, {"goal": [0.1, 0.1], "kp": [400.0]}, (2.0, 20.0, 0)),
        ({"terms": nominal(gain=2.0)}, {"torque": [0.3, 0.1]}, ([0.6, 0.2], 0, 0)),
        ({"terms": nominal(gain=2.0)}, {"duty": [0.5, 1.0]}, ([1.0, 2.0], 0, 0)),
    ],
)  # fmt: skip
def test_what_is_told_pushes_the_joints(model_file, options, told, pushed):
    robot = MjcfRobot(config(model_file, commands=tuple(told), **options))
    for found, expected in zip(control(robot, {"zero_left_knee": 0.1}, **told), pushed, strict=True):
        np.testing.assert_allclose(found, np.broadcast_to(expected, 2), rtol=1e-6)


def test_parameters_by_pattern_stand_where_they_belong(model_file):
    terms = (
        ParameterPattern("damping"),
        ParameterPattern("armature", ".*_hip"),
        ParameterPattern("frictionloss", each=True),
        ParameterPattern("torque", "left_knee"),
        ParameterPattern("payload", "lower"),
    )
    robot = MjcfRobot(config(model_file, terms=terms))
    names = [p.name for p in robot.dynamics()]
    assert names == ["damping", "armature_hip", "frictionloss_left_knee", "frictionloss_left_hip",
                     "torque_left_knee", "payload_lower"]  # fmt: skip
    values = dict(zip(names, (0.3, 0.05, 0.11, 0.22, 1.5, 0.7), strict=True))
    model = robot.identifiable(0.02)
    world = model.params({**values, "delay": 0.0}, jnp.zeros(4))["world"].model
    # In the model's order: hip, knee.
    np.testing.assert_allclose(world.dof_damping, [0.3, 0.3], rtol=1e-6)
    np.testing.assert_allclose(world.dof_armature, [0.05 - 0.001 * 0.3, 0.02 - 0.001 * 0.3], rtol=1e-6)
    np.testing.assert_allclose(world.dof_frictionloss, [0.22, 0.11], rtol=1e-6)
    np.testing.assert_allclose(world.jnt_actfrcrange, [[-3, 3], [-1.5, 1.5]])
    body = robot.model.body("lower").id
    np.testing.assert_allclose(world.body_mass[body], robot.model.body_mass[body] + 0.7, rtol=1e-6)


def test_the_start_is_where_the_encoders_say(model_file):
    robot = MjcfRobot(config(model_file, terms=(ParameterPattern("zero", nominal=0.1, free=False),)))
    params = robot.identifiable(0.02).params({"zero": 0.1, "delay": 0.0}, jnp.array([0.5, -0.3, 1.0, 2.0]))
    np.testing.assert_allclose(params["world"].qpos, [-0.4, 0.4], rtol=1e-6)
    np.testing.assert_allclose(params["world"].qvel, [2.0, 1.0])
    np.testing.assert_allclose(params["sensor"].zero, 0.1)


def test_a_description_survives_its_file(tmp_path, model_file):
    wanted = config(model_file, velocity=True, rate_hz=123.0, terms=(*usual_patterns(("goal", "enabled")),
                    ParameterPattern("frictionloss", "left_.*", True, 0.1, 0.01, 1.0, "dry", False)))  # fmt: skip
    (tmp_path / "robot.toml").write_text(wanted.to_toml("robot.xml"))
    assert RobotConfig.load(tmp_path / "robot.toml") == wanted


def test_identified_friction_leaves_as_mjcf(model_file):
    robot = MjcfRobot(config(model_file, terms=(ParameterPattern("damping"), ParameterPattern("armature", each=True))))
    text = robot.exported({"damping": 0.33, "armature_left_hip": 0.07, "armature_left_knee": 0.08}).mjcf
    model = mujoco.MjModel.from_xml_string(text)
    np.testing.assert_allclose(model.dof_damping, [0.33, 0.33, 0.0])
    np.testing.assert_allclose(model.dof_armature, [0.07 - 0.001 * 0.33, 0.08 - 0.001 * 0.33, 0.0])


def test_urdf_is_read(tmp_path):
    (tmp_path / "robot.urdf").write_text(URDF)
    own = read_model(tmp_path / "robot.urdf")
    assert joints_of(own) == ("j",)
    assert limit_of(own, "j") == 5.0


def test_a_floating_base_is_held_only_where_that_is_said(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(XML.format(free=FREE))
    with pytest.raises(UsageError, match="--fix-base"):
        driven(path, JOINTS, 0.002, False, False)
    assert driven(path, JOINTS, 0.002, True, False).nv == 2


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"joints": ("left_toe",)}, "left_toe"),
        ({"commands": ("kp",)}, "goal, goal_velocity, torque, duty"),
        ({"terms": (ParameterPattern("kp", "right_.*"),)}, "matches none"),
    ],
)
def test_what_does_not_fit_is_named(model_file, change, named):
    with pytest.raises(UsageError, match=named):
        MjcfRobot(config(model_file, **change))


@pytest.mark.parametrize(
    ("text", "term"),
    [
        ("kp", ParameterPattern("kp")),
        ("frictionloss:each", ParameterPattern("frictionloss", each=True)),
        ("kp@.*_hip", ParameterPattern("kp", ".*_hip")),
        ("armature:each@left_.*=0.01", ParameterPattern("armature", "left_.*", True, 0.01, free=False)),
    ],
)
def test_terms_as_flags(text, term):
    assert ParameterPattern.parse(text) == term


@pytest.mark.parametrize("text", ["kq", "kp@(", "kp every"])
def test_wrong_terms_are_refused(text):
    with pytest.raises(UsageError):
        ParameterPattern.parse(text)


def test_the_armature_is_the_rotors_whatever_the_time_step(tmp_path):
    """A damped joint coasts as the equation says; MuJoCo's own steps add half a step of damping to the inertia."""
    path = tmp_path / "rotor.xml"
    path.write_text(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="left_hip" axis="0 1 0"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody></mujoco>'
    )
    terms = (ParameterPattern("armature"), ParameterPattern("damping"), ParameterPattern("frictionloss"))
    robot = MjcfRobot(config(path, joints=("left_hip",), commands=("torque",), step_s=0.005, terms=terms))
    values = {"armature": 0.03, "damping": 1.0, "frictionloss": 1e-9}
    world = robot.identifiable(0.02).params({**values, "delay": 0.0}, jnp.zeros(2))["world"].model
    model = mujoco.MjModel.from_xml_string(robot.exported(values).mjcf)
    np.testing.assert_allclose(world.dof_armature, model.dof_armature, rtol=1e-6)
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    mujoco.mj_step(model, data, 16)
    assert data.qvel[0] == pytest.approx(np.exp(-0.08 * 1.0 / 0.04), rel=0.01)
    # So much inertia is the integrator's already that no rotor is left.
    heavy = MjcfRobot(config(path, joints=("left_hip",), commands=("torque",), step_s=0.1, terms=terms))
    assert mujoco.MjModel.from_xml_string(heavy.exported(values).mjcf).dof_armature[0] == 0.0
