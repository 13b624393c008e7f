"""A twin made of a model's MJCF moves as the plant with the same numbers written by hand, and refuses unknown names."""

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


def test_unknown_names_are_refused(arguments):
    with pytest.raises(UsageError, match="no joint 'neck'"):
        ServoPlant(**{**arguments, "joints": ["neck", "shoulder", "elbow"]})
    robot = load_robot("arm")
    with pytest.raises(UsageError, match="no factor 'mass'"):
        robot.model.twin(robot.drive.embedded().emulator, mass=2.0)
