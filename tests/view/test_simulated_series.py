"""What a deployment's simulation is read as."""

import numpy as np
import pytest

from sim2real.graph.episode import Episode
from sim2real.view.signals import Series, Signals, pairs_of, simulated_beside, simulated_series


def test_the_entries_of_a_command_share_the_times_at_which_it_was_sent():
    t_s, sent_s = np.linspace(0.0, 1.0, 101), np.array([0.013, 0.034, 0.052])
    columns = {"t": t_s, "t_command": sent_s, "position[0]": t_s, "command[0]": sent_s, "command[1]": -sent_s}
    found = {s.name: s for s in simulated_series(columns)}
    assert set(found) == {"position[0]", "command[0]", "command[1]"}
    np.testing.assert_array_equal(found["command[1]"].t_s, sent_s)
    np.testing.assert_array_equal(found["command[1]"].values, -sent_s)
    np.testing.assert_array_equal(found["position[0]"].t_s, t_s)


def test_positions_have_the_names_of_their_joints_and_keep_their_simulation():
    t_s = np.linspace(0.0, 1.0, 11)
    measured = [Series(name, "sensor", t_s, t_s) for name in ("position[0]", "position[1]", "velocity[0]")]
    simulation = [Series("position[1]", "world", t_s, 2 * t_s)]
    pairs = pairs_of(
        Signals(Episode({}, {}, {}, {"graph": {}}), measured, [], {}),
        simulation,
        {"position[1]": "elbow"},
    )
    assert [pair.label for pair in pairs] == ["position[0]", "elbow", "velocity[0]"]
    assert pairs[1].simulation is simulation[0]


@pytest.mark.parametrize(
    ("name", "unit", "real", "simulated", "turns"),
    [
        ("th", "rad", 3 * np.pi + 0.01, np.pi, 1),
        ("th", "rad", -5 * np.pi, np.pi, -3),
        ("th", "rad", np.pi + 0.05, np.pi, 0),
        ("th", "rad", 0.4, 2 * np.pi + 0.3, -1),
        ("position[1]", "rad", 3 * np.pi, np.pi, 1),
        ("th", "m", 3 * np.pi, np.pi, 0),
        ("thdot", "rad/s", 3 * np.pi, np.pi, 0),
        ("command", "rad", 3 * np.pi, np.pi, 1),
        ("command", "N m", 3 * np.pi, np.pi, 0),
        ("th", "rad", np.nan, np.pi, 0),
    ],
)
def test_angles_of_a_simulation_are_drawn_on_the_robots_turn(name, unit, real, simulated, turns):
    """Whole turns that the robot's encoder has counted before are no gap; other quantities stay."""
    t_s = np.linspace(0.0, 1.0, 11)
    robot = Series("goal" if name == "command" else name, "node", t_s, real + t_s)
    episode = Episode({}, {}, {}, {"graph": {}})
    measured, commanded = ([], [robot]) if name == "command" else ([robot], [])
    log = Signals(episode, measured, commanded, {}, {robot.name.partition("[")[0]: unit})
    values = simulated - t_s
    (found,) = simulated_beside({"t": t_s, name: values}, log)
    np.testing.assert_allclose(found.values, values + 2 * np.pi * turns)
