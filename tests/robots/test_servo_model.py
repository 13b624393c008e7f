"""An MJCF with servos on its joints: its world against a loop in numpy around C MuJoCo, its parameters and exports."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from small_robot import SERVOS, SHEET, VALUES, PairRobot, play_in_a_graph, play_on_c, world_params

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.servo_plant import ServoPlant
from sim2real.errors import UsageError
from sim2real.hardware.joint import Joint
from sim2real.identification.rollouts import choose_engine
from sim2real.robots.messages import EpisodeStart
from sim2real.robots.robot import watched
from sim2real.robots.servo.model import ServoModel, servo_parameters
from sim2real.stages.load import load_robot
from sim2real.stages.shared.identification import with_wanted_terms

GEARS = (2.0, 0.5)
GEARED = replace(SERVOS, joints=(Joint("left", 0.3, -1, GEARS[0]), Joint("right", gear=GEARS[1])))


def played(robot, values, resumed=False):
    """Half a second of moving goals, some of them too fast for the profile, in the graph's world and on C."""
    t = 0.01 * np.arange(50)
    goals = np.stack([np.sin(5 * t), np.where(t < 0.2, 0.9, -0.3)], axis=1).astype(np.float32)
    position, velocity = [0.3, -0.2], [0.0, 0.5]
    params = world_params(robot, values, position, velocity, [0.1])
    first, later, setpoints = play_in_a_graph(robot.model.make_world(resumed))(params, goals)
    return goals, first, later, setpoints, play_on_c(robot, values, position, velocity, goals)


def test_the_world_is_a_rate_limiter_and_a_torque_in_c_mujoco():
    goals, first, later, setpoints, (expected, positions, speeds) = played(PairRobot(converged=True), VALUES)
    assert np.ptp(positions, axis=0).min() > 0.5
    np.testing.assert_allclose(first.position, [0.3, -0.2], rtol=1e-6)
    np.testing.assert_allclose(setpoints, expected[1::2], atol=1e-6)
    np.testing.assert_allclose(later.position, positions, atol=2e-5)
    np.testing.assert_allclose(later.velocity, speeds, atol=5e-4)
    arrived = np.abs(expected - np.repeat(goals, 2, axis=0)) < 1e-6
    assert 0.02 < arrived.mean() < 0.9, "some goals are reached, and on the way they are not"


@pytest.mark.night  # MJX compiles for seconds
def test_in_the_middle_of_a_recording_setpoints_begin_at_the_goals(pair):
    goals, *_, setpoints, _ = played(pair, VALUES, resumed=True)
    np.testing.assert_allclose(setpoints[0], goals[0], atol=1e-7)


@pytest.mark.night  # MJX compiles for seconds
def test_without_a_profile_setpoints_are_the_goals_at_once():
    robot = PairRobot(replace(SERVOS, sheet=replace(SHEET, profile_rad_s=float("inf"))))
    params = world_params(robot, VALUES, [0.0, 0.0], [0.0, 0.0], [0.1])
    goals = jnp.array([[0.5, -1.0], [-0.5, 1.0]])
    *_, setpoints = play_in_a_graph(robot.model.make_world())(params, goals)
    np.testing.assert_array_equal(setpoints, goals)


@pytest.mark.parametrize("name", ["arm", "so101"])
def test_parameters_are_in_the_graph_as_in_the_exported_model(name):
    robot = load_robot(name)
    values = robot.nominal() | {"payload": 0.1, "damping": 0.3, "goal_offset_elbow_flex": 0.02}
    exported = mujoco.MjModel.from_xml_string(robot.model.exported(values).mjcf)
    for field, numbers in robot.model.fields(values).items():
        np.testing.assert_allclose(getattr(exported, field), numbers, rtol=1e-4, atol=1e-7, err_msg=field)
    own = robot.model.model
    assert exported.body_mass.sum() == pytest.approx(own.body_mass.sum() + 0.1)
    np.testing.assert_allclose(exported.body_inertia, own.body_inertia, rtol=1e-4)
    sheet = robot.drive.servos.sheet
    np.testing.assert_allclose(own.actuator_forcerange[:, 1], sheet.stall, rtol=1e-6)


def test_a_gear_is_in_the_model_and_not_in_the_servos_parameters(pair):
    """Torque and friction grow by the gear, gain, damping and inertia by its square."""
    robot, gears = PairRobot(GEARED), np.array(GEARS)
    assert robot.nominal() == pair.nominal()
    geared, plain = (r.model.fields(r.nominal()) for r in (robot, pair))
    powers = {"actuator_gainprm": 2, "actuator_biasprm": 2, "actuator_forcerange": 1}
    powers |= {"dof_damping": 2, "dof_armature": 2, "dof_frictionloss": 1}
    for name, power in powers.items():
        expected = np.asarray(plain[name]).T * gears**power
        np.testing.assert_allclose(np.asarray(geared[name]).T, expected, rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(robot.model.exported(robot.nominal()).plain().numbers["profile_rad_s"], 2.0 / gears)
    factors = {"gain": 0.9, "damping": 1.1, "armature": 1.2, "friction": 1.5}
    truth = {n: v * factors[n.split("_")[0]] for n, v in pair.nominal().items()}
    for made in (pair, robot):  # a twin's servos are those of the data sheet, whatever their gears
        twin = ServoPlant(**made.model.twin(EmulatorConfig(), **factors).plant.keywords)
        assert twin.truth() == pytest.approx(truth, rel=1e-5)
    with pytest.raises(UsageError, match="no factor 'mass'"):
        pair.model.twin(EmulatorConfig(), mass=2.0)
    with pytest.raises(UsageError, match="no joint 'neck'"):
        ServoPlant(**{**pair.model.twin(EmulatorConfig()).plant.keywords, "joints": ["neck", "right"]})


def test_inertia_makes_up_for_what_the_implicit_step_adds(pair):
    placed = pair.model.fields(pair.nominal())["dof_armature"]
    np.testing.assert_allclose(placed, 0.01 - 0.5 * 0.005 * 0.2, rtol=1e-5)
    np.testing.assert_array_equal(pair.model.fields({**pair.nominal(), "armature": 1e-4})["dof_armature"], 0.0)


def test_joints_may_have_any_of_the_servos_parameters_for_themselves(pair):
    found = servo_parameters(SHEET, ("left", "right"), own=("damping", "friction"))
    own = ["damping_left", "damping_right", "friction_left", "friction_right"]
    assert [p.name for p in found] == ["gain", *own[:2], "armature", *own[2:]]
    values = {p.name: p.nominal for p in found} | {"damping_right": 0.5, "saturation_left": 0.1}
    placed = pair.model.fields(values)
    np.testing.assert_allclose(placed["dof_damping"], [SHEET.damping, 0.5], rtol=1e-6)
    most = SHEET.gain * np.array([0.1, SHEET.full_rad])
    np.testing.assert_allclose(placed["actuator_forcerange"][:, 1], most, rtol=1e-6)
    del values["damping_left"]
    with pytest.raises(KeyError, match="damping_left"):
        pair.model.fields(values)


def test_a_model_without_a_servos_joint_is_refused(tmp_path):
    (tmp_path / "other.xml").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(UsageError, match="no joint 'left'"):
        ServoModel(SERVOS, tmp_path / "other.xml").make_world()
    with pytest.raises(UsageError, match="there is no model"):
        ServoModel(SERVOS, tmp_path / "none.xml").make_world()


def test_a_payload_is_identified_where_it_is_asked_for_and_always_watched():
    arm = load_robot("arm")
    identified, changeable = arm.identifiable(0.06).parameters, watched(arm, 0.06).parameters
    free = {p.name for p in identified if p.free}
    assert {p.name for p in changeable if p.free} - free == {"payload"}
    assert {p.name for p in with_wanted_terms(identified, "payload") if p.free} == free | {"payload"}
    assert {p.name for p in with_wanted_terms(identified, "none") if p.free} == free


@pytest.mark.parametrize("name", ["arm", "so101"])
def test_a_hand_weighs_something_whatever_it_holds(name):
    robot = load_robot(name)
    fields = robot.model.fields(robot.nominal() | {"payload": robot.model.hand.least_kg})
    assert np.asarray(fields["body_mass"])[1:].min() > 0.005


def test_a_robot_that_is_first_asked_while_jax_traces_keeps_no_tracer():
    robot = type(load_robot("arm"))()
    values, still = robot.nominal(), np.zeros(3)

    def mass(kg):
        return robot.model.params(values | {"payload": kg}, EpisodeStart(still, still, still)).fields["body_mass"].sum()

    heavier = jax.jit(mass)(0.1) - mass(0.0)
    assert float(heavier) == pytest.approx(0.1, rel=1e-4)


def test_c_is_taken_where_it_can_be(pair):
    model = pair.identifiable(0.03)
    for wanted, name in (("auto", "c"), ("compiled", "compiled")):
        assert choose_engine(wanted, model.nodes(0.03), model.given).name == name
    disk = load_robot("disk").identifiable(0.06)
    motor = disk.nodes(0.06), disk.given
    assert choose_engine("auto", *motor).name == "compiled"
    with pytest.raises(UsageError, match="engine c: the world is not one of MuJoCo's"):
        choose_engine("c", *motor)
