"""The code of the page about graphs, block after block, as a reader would type it."""

import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).parents[2] / "docs" / "graph.md"


@pytest.fixture(scope="module")
def names():
    """Run every block of the page in one namespace; return it."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert len(blocks) == 9
    found = {"__name__": "page"}
    for number, block in enumerate(blocks, start=1):
        exec(compile(block, f"{PAGE.name}, block {number}", "exec"), found)
    return found


@pytest.mark.night
def test_the_page_says_what_is_so(names):
    nodes = names["nodes"]
    assert (nodes["agent"].phase, nodes["actuator"].phase) == pytest.approx((0.003, 0.007))
    assert names["statistics"].steps > 60
    assert names["statistics"].overruns == 0
    assert names["statistics"].age_s["sensor"].p99 == pytest.approx(0.001)
    assert names["Actuator"].sent[0] == "torque on"
    assert names["Actuator"].sent[-1] == "torque off"
    assert len(names["Actuator"].sent) > 5
    assert len(names["log"].outputs["sensor"]["th"]) > 60


@pytest.mark.night
def test_a_loss_of_ones_own_finds_the_mass_of_the_recorded_world(names):
    """The recorded episode was made with the world's own mass, and sensors that saw it 5 ms later."""
    assert float(names["estimate"].parameters["mass"]) == pytest.approx(0.0509, rel=0.1)
    assert names["estimate"].loss < 0.1 * names["estimate"].start


def test_pushing_in_the_direction_of_motion_swings_the_pendulum_up(names):
    heights = np.asarray(names["heights"])
    assert heights[0] < -0.5
    assert heights.max() > 0.9
