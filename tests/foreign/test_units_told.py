"""Positions without a unit, too small to be degrees by their reach: what goals, velocities and encoders say of them."""

import numpy as np
import pytest
from foreign_robots import csv, imported, servo

from sim2real.errors import UsageError

T = np.arange(0, 12, 0.01)
GOAL = np.sin(2 * T) + 0.5 * np.sin(5.3 * T)  # in degrees or in radians: within 1.5
Q = servo(T, GOAL)
RATE = np.gradient(Q, T)
DEG = np.radians(1.0)


@pytest.mark.parametrize(
    ("columns", "q", "goal", "velocity"),
    [
        ({"goal_rad": GOAL * DEG, "q": Q}, DEG, 1.0, None),
        ({"goal_deg": GOAL, "q": Q}, DEG, DEG, None),
        ({"goal": GOAL * DEG, "q": Q}, DEG, 1.0, None),
        ({"goal": GOAL / DEG, "q": Q}, 1.0, DEG, None),
        ({"goal_rad": GOAL, "q": Q}, 1.0, 1.0, None),
        ({"goal": GOAL, "q": Q, "dq_rad_s": RATE * DEG}, DEG, DEG, 1.0),
        ({"goal": GOAL, "q": Q, "dq_deg_s": RATE}, DEG, DEG, DEG),
        ({"goal": GOAL, "q": Q, "dq": RATE * DEG}, DEG, DEG, 1.0),
        ({"goal": GOAL, "q": Q, "dq": RATE / DEG}, 1.0, 1.0, DEG),
        ({"goal": GOAL, "q": Q, "dq_deg_s": -RATE}, DEG, DEG, -DEG),
        ({"goal_rad": GOAL * DEG, "q": Q, "dq": RATE * DEG}, DEG, 1.0, 1.0),
        ({"goal": GOAL, "q": np.round(Q * 4096 / 360) * 360 / 4096}, DEG, DEG, None),
        ({"goal": 0.5 * GOAL, "q": 0.5 * Q}, 1.0, 1.0, None),  # 1.5 degrees would be hardly a motion
        ({"goal": GOAL, "qpos": Q}, 1.0, 1.0, None),
        ({"goal": GOAL, "q_rad": Q, "dq_deg_s": RATE}, 1.0, 1.0, None),  # the name of one is wrong: left out
    ],
)
def test_units_by_what_goes_with_positions(tmp_path, columns, q, goal, velocity):
    _, found = imported(csv(tmp_path / "run.csv", {"t_s": T, **columns}))
    sensor, actuator = (found.mapping.nodes[name].fields for name in ("sensor", "actuator"))
    scales = sensor["position"].scale, actuator["goal"].scale
    np.testing.assert_allclose(scales, (q, goal))
    assert ("velocity" in sensor) == (velocity is not None)
    if velocity is not None:
        np.testing.assert_allclose(sensor["velocity"].scale, velocity)


@pytest.mark.parametrize(
    ("columns", "named"),
    [
        ({"goal": GOAL, "q": Q}, "'q' .* in radians or degrees. It reaches 1.47.*Candidates: rad, deg"),
        ({"goal": 4 * GOAL, "q": 4 * Q, "dq": 4 * RATE}, "'q' .* in radians or degrees.*It reaches 5.88"),
        ({"goal_deg": GOAL, "q": Q, "dq_rad_s": RATE}, "(?s)'q' .* in radians or degrees.*contradict each other"),
        ({"goal_rad": GOAL, "q": Q, "dq": RATE * DEG}, "(?s)'q' .* in radians or degrees.*contradict each other"),
        (
            {"goal": GOAL * DEG, "q_rad": Q},
            "(?s)'q_rad' .*in radians, follows 'goal' .*neither in radians nor in degrees",
        ),
        ({"goal": GOAL / DEG, "q_deg": Q}, "(?s)'q_deg' .*in degrees, follows 'goal' .*neither"),
        ({"goal_rad": GOAL, "q_deg": Q}, "'goal_rad' .* is in rad by its name, but 'q_deg', in degrees"),
    ],
)
def test_units_that_contradict_each_other(tmp_path, columns, named):
    with pytest.raises(UsageError, match=named):
        imported(csv(tmp_path / "run.csv", {"t_s": T, **columns}))
