"""How far a joint can have moved between two readings; used to stop a robot, and to check an imported file."""

import numpy as np

STAMP_S = 0.01
"""Uncertainty of the time between two samples [s]: a servo may answer with an older sample."""
PLAY_RAD = 0.05
"""Tolerance of a position change [rad]: 33 counts."""


def reach_rad(fastest_rad_s: float | np.ndarray, elapsed_s: float | np.ndarray) -> np.ndarray:
    """Return the largest plausible change of a position [rad].

    Args:
        fastest_rad_s: The joint's largest speed [rad/s].
        elapsed_s: Time between the two samples [s].
    """
    return np.asarray(fastest_rad_s * (elapsed_s + STAMP_S) + PLAY_RAD)
