"""What was found of links, on a page: numbers in the units that people read."""

import numpy as np
import pytest

from sim2real.artifacts.identification import Link, Ranged
from sim2real.view.identification import link_blocks


@pytest.fixture
def link():
    """Two modes at 4 and 12 ms, of which a part of all messages is lost."""
    delays = np.linspace(0.0, 0.02, 81)
    share = np.exp(-0.5 * ((delays - 0.004) / 5e-4) ** 2) + 0.5 * np.exp(-0.5 * ((delays - 0.012) / 5e-4) ** 2)
    return Link(
        name="sensor_delay + actuator_delay",
        mean=Ranged(0.0067, 0.0065, 0.0069),
        deviation=Ranged(0.0038, 0.0036, 0.004),
        p95=Ranged(0.0126, 0.0124, 0.0128),
        lost=Ranged(0.03, 0.02, 0.04),
        delays=delays,
        share=share / share.sum(),
    )


def test_numbers_stand_with_their_intervals_and_what_is_not_known_is_left_out(link):
    (table,) = link_blocks([link])
    assert [row[0] for row in table.rows] == [
        "sensor_delay + actuator_delay, mean", "sensor_delay + actuator_delay, 95 % of the messages",
        "sensor_delay + actuator_delay, deviation", "sensor_delay + actuator_delay, lost",
    ]  # fmt: skip
    assert table.rows[0][1:] == ["6.700", "6.500 to 6.900", "ms"]
    assert table.rows[3][1:] == ["3.000", "2.000 to 4.000", "%"]
    assert link_blocks([]) == []
