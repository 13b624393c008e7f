"""A small robot, and the arm's pipeline."""

import pytest
from small_robot import PairRobot

from sim2real.stages.load import load_robot


@pytest.fixture(scope="session")
def pair():
    """The robot of two servos."""
    return PairRobot()


@pytest.fixture(scope="session")
def arm():
    """The arm's pipeline."""
    return load_robot("arm")
