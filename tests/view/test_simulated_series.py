"""What a deployment's simulation is read as."""

import numpy as np

from sim2real.artifacts.deployment import _of_episode
from sim2real.view.signals import simulated_series


def test_the_entries_of_a_command_share_the_times_at_which_it_was_sent():
    t_s, sent_s = np.linspace(0.0, 1.0, 101), np.array([0.013, 0.034, 0.052])
    arrays = {"t_0": t_s, "t_command_0": sent_s, "position[0]_0": t_s, "command[0]_0": sent_s, "command[1]_0": -sent_s}
    found = {s.name: s for s in simulated_series(_of_episode({**arrays, "command[0]_10": t_s}, 0))}
    assert set(found) == {"position[0]", "command[0]", "command[1]"}
    np.testing.assert_array_equal(found["command[1]"].t_s, sent_s)
    np.testing.assert_array_equal(found["command[1]"].values, -sent_s)
    np.testing.assert_array_equal(found["position[0]"].t_s, t_s)
