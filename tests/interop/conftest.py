"""The pendulum with its delays, in episodes of eleven steps."""

import pytest

from sim2real.interop import robot_environment
from sim2real.stages.config import TrainConfig

DELAYS = {"sensor_delay": 0.02, "actuator_delay": 0.025}
STEPS = 11


@pytest.fixture(scope="session")
def pendulum():
    config = TrainConfig(episode_s=0.5, timelines=2)
    made = robot_environment("pendulum", "nominal", DELAYS, config)
    assert made.step_limit == made.env.length == 24
    return made
