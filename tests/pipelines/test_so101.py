"""The SO-101's geometry, limits, parameters, calibration, aims and score; its embedded robot has tests of its own."""

import itertools
import json

import mujoco
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.stages.load import load_module, load_robot
from sim2real.stages.session.excitation import excitation

PIPELINE = load_robot("so101")
ROBOT, PLANT = PIPELINE, load_module(PIPELINE.name, "plant")
MODULE = load_module(PIPELINE.name, "robot")
LOW, HIGH = np.array(ROBOT.drive.servos.low), np.array(ROBOT.drive.servos.high)


@pytest.fixture(scope="module")
def plant():
    """The embedded robot's physics."""
    return PLANT.SO101Plant()


def test_the_arm_is_as_long_as_the_public_description_says():
    """Stretched forward and level, and upright: sums of its lengths, written down by hand."""
    np.testing.assert_allclose(MODULE.tip_of(np.zeros(6)), [0.3914, 0, 0.2344], atol=2e-4)
    up = MODULE.tip_of(np.array([0, 0, -np.pi / 2, 0, 0, 0]))
    np.testing.assert_allclose(up, [0.0388 + 0.0304 + 0.0280 - 0.0052, 0, 0.2292 + 0.2941], atol=2e-4)
    turned = MODULE.tip_of(np.array([np.pi / 2, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(turned, [0.0388, -0.3526, 0.2344], atol=2e-4)


def lowest(plant, angles):
    """How far the arm's lowest ball is above the table [m]."""
    model, data = plant.model, plant.data
    data.qpos[:] = angles
    mujoco.mj_kinematics(model, data)
    half = (
        np.abs(data.geom_xmat[1:, 8]) * model.geom_size[1:, 1] * (model.geom_type[1:] == mujoco.mjtGeom.mjGEOM_CAPSULE)
    )
    return float((data.geom_xpos[1:, 2] - half - model.geom_size[1:, 0]).min())


def test_no_goal_leads_into_the_table(plant):
    """The gate lets no goal out of a box; everywhere in it the arm is above the table, by more than it droops."""
    gate = ROBOT.drive.gate(PIPELINE.defaults.deploy.gate)
    np.testing.assert_array_equal(gate.range, [LOW, HIGH])
    swing = [np.linspace(LOW[i], HIGH[i], 9) for i in (1, 2, 3)]
    heights = [lowest(plant, [0, *angles, 0, 0]) for angles in itertools.product(*swing)]
    assert min(heights) > 0.04
    assert lowest(plant, [0, 0.3, 1.3, -1.0, 0, 0]) < 0, "outside of it there is the table"


def test_excitations_aims_and_rest_are_within_the_limits(plant):
    signal = excitation(PIPELINE.defaults.record, ROBOT.drive.rate_hz, 6) + ROBOT.drive.centre
    inside = (signal >= LOW - 1e-9) & (signal <= HIGH + 1e-9)
    assert inside.mean(axis=0).min() > 0.85, "the gate cuts little"
    assert np.ptp(np.clip(signal, LOW, HIGH), axis=0).min() > 0.5
    assert np.all((ROBOT.drive.servos.at_rest >= LOW) & (ROBOT.drive.servos.at_rest <= HIGH))


def test_each_joint_has_its_own_damping_friction_and_limit():
    values = {**ROBOT.nominal(), "damping_elbow_flex": 0.3, "friction_gripper": 0.02, "saturation_gripper": 0.1}
    model, gain = ROBOT.model.fields(values), values["gain"]
    np.testing.assert_allclose(model["dof_damping"], [0.6, 0.6, 0.3, 0.6, 0.6, 0.6], rtol=1e-6)
    np.testing.assert_allclose(model["dof_frictionloss"], [0.06] * 5 + [0.02], rtol=1e-6)
    most = [2.94] * 4 + [gain * values["saturation_wrist_roll"], gain * 0.1]
    np.testing.assert_allclose(model["actuator_forcerange"][:, 1], most, rtol=1e-5)


@pytest.fixture
def lerobot(tmp_path, monkeypatch):
    """LeRobot's folder of calibrations."""
    monkeypatch.delenv(MODULE.CALIBRATION, raising=False)
    monkeypatch.setenv("HF_LEROBOT_CALIBRATION", str(tmp_path))
    folder = tmp_path / "robots" / "so101_follower"
    folder.mkdir(parents=True)
    return folder


def test_the_only_calibration_is_taken_and_of_several_the_one_that_is_named(lerobot, monkeypatch):
    text = (PIPELINE.folder / "calibration.json").read_text()
    for name in ("mine", "other"):
        (lerobot / f"{name}.json").write_text(text)
        if name == "mine":
            assert MODULE.find() == lerobot / "mine.json"
    with pytest.raises(UsageError, match=r"several calibrations: mine.json, other.json"):
        MODULE.find()
    monkeypatch.setenv(MODULE.CALIBRATION, str(lerobot / "other.json"))
    assert MODULE.find() == lerobot / "other.json"
    assert [j.servo_id for j in MODULE.read(MODULE.find())] == [1, 2, 3, 4, 5, 6]


def test_an_arm_without_calibration_is_not_opened(lerobot):
    with pytest.raises(UsageError, match="no calibration in") as told:
        ROBOT.drive.device("/dev/ttyACM0", 0.1, embedded=False)
    assert "SO101_CALIBRATION" in str(told.value.hint)


def test_a_calibration_of_another_arm_is_refused(tmp_path):
    motors = json.loads((PIPELINE.folder / "calibration.json").read_text())
    motors["shoulder"] = motors.pop("elbow_flex")
    (tmp_path / "x.json").write_text(json.dumps(motors))
    with pytest.raises(UsageError, match=r"has no motor 'elbow_flex'. There are: shoulder_pan"):
        MODULE.read(tmp_path / "x.json")


def test_the_calibration_is_the_embedded_arms():
    joints = MODULE.read(PIPELINE.folder / "calibration.json")
    for joint, zero in zip(joints, PLANT.ZERO_COUNTS, strict=True):
        assert joint.zero_count + joint.homing_offset == pytest.approx(zero, abs=0.5)
        low, high = sorted(joint.angle(count) for count in (joint.low_count, joint.high_count))
        i = ROBOT.drive.servos.joints.index(joint.name)
        assert low < LOW[i] < HIGH[i] < high
