"""A twin made of a model's MJCF moves as the plant that was written by hand, and refuses what it does not know."""

import math

import numpy as np
import pytest

from sim2real.emulation.servo_plant import ServoPlant
from sim2real.errors import UsageError
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import RAD_PER_COUNT
from sim2real.stages.load import load_module, load_robot

CENTRE_RAD = 2048 * RAD_PER_COUNT
FACTORS = {"gain": 0.87, "damping": 0.252 / 0.23, "armature": 1.25, "friction": 1.5}


@pytest.fixture(scope="module")
def arguments():
    """What the arm's robot hands to a twin."""
    robot = load_robot("arm")
    return robot.model.twin(robot.drive.embedded().emulator, **FACTORS).plant.keywords


@pytest.fixture
def by_hand():
    """The plant of pipelines/arm, which knows nothing of the model, with the same numbers."""
    make = load_module("arm", "plant").ArmPlant
    return make(stall=0.87, back_emf=1.1, armature=1.25, coulomb=(1.5, 1.5, 1.5), bump=0.0)


def played(plant, seconds=2.0):
    """Return positions (N, 3) [rad] under moving goals, 50 a second."""
    for i in plant.servo_ids:
        plant.configure(i, 800, 0, 5.0)
    rows = []
    for k in range(round(50 * seconds)):
        for i, frequency_hz in zip(plant.servo_ids, (0.7, 0.9, 1.1), strict=True):
            goal = 0.6 * math.sin(2 * math.pi * frequency_hz * k / 50)
            plant.command(i, OperatingMode.POSITION, CENTRE_RAD + goal)
        plant.advance((k + 1) / 50)
        rows.append([plant.state()[f"position[{i}]"] for i in range(3)])
    return np.array(rows)


def test_it_moves_as_a_plant_that_was_written_by_hand(arguments, by_hand):
    ours, theirs = played(ServoPlant(**arguments)), played(by_hand)
    assert np.ptp(theirs, axis=0).min() > 0.4
    assert np.abs(ours - theirs).max() < 0.002


def test_its_truth_is_the_model_times_the_factors(arguments, by_hand):
    truth = {name: value for name, value in by_hand.truth().items() if name != "payload"}  # a twin's hand is empty
    assert ServoPlant(**arguments).truth() == pytest.approx(truth, rel=1e-6)


def test_without_torque_it_swings_down(arguments):
    plant = ServoPlant(**{**arguments, "truth": {**arguments["truth"], "friction": 0.003}})
    for i in plant.servo_ids:
        plant.command(i, OperatingMode.POSITION, CENTRE_RAD + 0.8)
    plant.advance(1.0)
    assert plant.state()["position[1]"] > 0.6
    for i in plant.servo_ids:
        plant.command(i, OperatingMode.OFF, 0.0)
    plant.advance(20.0)  # the model's damping goes on braking
    assert plant.state()["position[1]"] < 0.2
    assert all(abs(plant.measure(i)[2]) < 1e-9 for i in plant.servo_ids)


def test_the_profile_is_the_hosts(arguments):
    plant = ServoPlant(**arguments)
    plant.configure(1, 400, 0, 1.0)
    plant.command(1, OperatingMode.POSITION, CENTRE_RAD + 1.0)
    plant.advance(0.5)
    assert 0.2 < plant.measure(1)[0] - CENTRE_RAD < 0.5


def test_unknown_names_are_refused(arguments):
    with pytest.raises(UsageError, match="no joint 'neck'"):
        ServoPlant(**{**arguments, "joints": ["neck", "shoulder", "elbow"]})
    robot = load_robot("arm")
    with pytest.raises(UsageError, match="no factor 'mass'"):
        robot.model.twin(robot.drive.embedded().emulator, mass=2.0)
