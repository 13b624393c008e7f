"""A recording with a hiccup: the commands that waited leave at once, and it identifies all the same."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span
from sim2real.log.reader import read_log
from sim2real.robots.loop import BURST
from sim2real.stages.load import load_robot

LOG = Path(__file__).parents[2] / "datasets" / "pendulum" / "steps.mcap"


def burst_of(episode):
    """Return how many messages more than usual the window of a problem's commands holds."""
    model = load_robot("pendulum").identifiable(0.06)
    nodes = Problem(model, [episode], [Span(0, 1.0)], 3.0).rollouts.graph.nodes
    return nodes["world"].inputs["actuator"].delay_dist.burst


@pytest.mark.parametrize("waited", [0, 12])
def test_commands_that_leave_at_once_find_room(waited):
    episode = read_log(LOG)
    actuator = episode.steps["actuator"]
    end = actuator.end.copy()
    end[100 : 100 + waited] = end[100 + waited] - 1000 * np.arange(waited, 0, -1)
    held = replace(episode, steps={**episode.steps, "actuator": replace(actuator, end=end)})
    assert burst_of(held) == (BURST if waited == 0 else 11)
