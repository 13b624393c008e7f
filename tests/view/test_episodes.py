"""The picture of what episodes are drawn from."""

import numpy as np
import pytest

from sim2real.artifacts.episodes import Episodes, Varied
from sim2real.artifacts.identification import Noise
from sim2real.view.episodes import picture


@pytest.fixture
def episodes():
    """Two parameters, one node and one noise."""
    rng = np.random.default_rng(0)
    return Episodes(
        parameters=(Varied("gain", "1/s", 2.0, 1.9, 2.1), Varied("round_trip_delay", "s", 0.04)),
        noise=(Noise("q[0]", "rad", 0.1, 0.0, 0.2),),
        draws={"gain": rng.normal(2.0, 0.1, 50), "round_trip_delay": rng.normal(0.04, 0.001, 50)},
        recorded_s={"agent": rng.uniform(0.001, 0.002, 50), "lost": np.array([np.nan])},
        drawn_s={"agent": rng.uniform(0.001, 0.002, 50), "lost": np.array([np.nan])},
        off={"q[0]": rng.normal(0.0, 0.1, 50)},
    )


def test_the_picture_is_a_png_also_of_nothing(episodes, tmp_path):
    for name, drawn in (("all", episodes), ("none", Episodes(()))):
        picture(tmp_path / f"{name}.png", drawn)
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
