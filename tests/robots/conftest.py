"""A small robot and its world's program, compiled once; and the arm's embedded robot."""

from types import SimpleNamespace

import numpy as np
import pytest
from small_robot import VALUES, PairRobot, play_in_a_graph, world_params

from sim2real.stages.pipeline.pipeline import load_pipeline


@pytest.fixture(scope="session")
def pair():
    """The robot of two servos."""
    return PairRobot()


@pytest.fixture(scope="session")
def played(pair):
    """Half a second of moving goals, some of them too fast for the profile, played by the graph's world."""
    t = 0.01 * np.arange(50)
    goals = np.stack([np.sin(5 * t), np.where(t < 0.2, 0.9, -0.3)], axis=1).astype(np.float32)
    params = world_params(pair, VALUES, [0.3, -0.2], [0.0, 0.5], [0.1])
    world = pair.model.make_world()
    first, later, references, rewards = play_in_a_graph(world)(params, goals)
    return SimpleNamespace(
        world=world, params=params, goals=goals, first=first, later=later, references=references, rewards=rewards
    )


@pytest.fixture(scope="session")
def arm():
    """The arm's pipeline."""
    return load_pipeline("arm")
