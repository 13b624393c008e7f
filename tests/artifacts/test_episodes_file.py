"""What episodes are drawn from: there and back through its files, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sim2real.artifacts.episodes import DRAWS, EPISODES, Episodes, Varied
from sim2real.artifacts.identification import Noise
from sim2real.errors import Sim2RealError


@pytest.fixture
def episodes():
    """Something in every field."""
    return Episodes(
        parameters=(Varied("gain", "1", 2.0, 1.9, 2.1, open=True),),
        widening=2.5,
        noise=(Noise("q[0]", "rad", 0.1, 0.0, 0.2),),
        timelines=4,
        cut=1,
        again=2,
        longest_pause_s=0.03,
        draws={"gain": np.array([1.9, 2.0, 2.2])},
        recorded_s={"agent": np.array([0.001, 0.002])},
        drawn_s={"agent": np.array([0.001])},
        off={"q[0]": np.array([0.1, -0.1])},
    )


def test_there_and_back(episodes, tmp_path):
    assert set(episodes.save(tmp_path).values()) == {EPISODES, DRAWS}
    back = Episodes.load(tmp_path)
    empty = {"draws": {}, "recorded_s": {}, "drawn_s": {}, "off": {}}
    assert replace(back, **empty) == replace(episodes, **empty)
    for name in empty:
        found, expected = getattr(back, name), getattr(episodes, name)
        assert found.keys() == expected.keys()
        for key, values in expected.items():
            np.testing.assert_array_equal(found[key], values)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda d: d.update(format=99), "format 99"),
        (lambda d: d.pop("parameters"), "missing required field"),
        (lambda d: d.update(parameters=[]), "draws of other parameters"),
        (lambda d: d["noise"][0].update(deviation=-1.0), "noise of"),
    ],
)
def test_damaged_files_are_refused_in_words(episodes, tmp_path, damage, message):
    episodes.save(tmp_path)
    document = json.loads((tmp_path / EPISODES).read_text())
    damage(document)
    (tmp_path / EPISODES).write_text(json.dumps(document))
    with pytest.raises(Sim2RealError, match=message) as refused:
        Episodes.load(tmp_path)
    assert "sim2real train" in refused.value.hint


def test_arrays_that_are_none_are_refused(episodes, tmp_path):
    replace(episodes, draws={"gain": np.zeros((2, 2))}).save(tmp_path)
    with pytest.raises(Sim2RealError, match="no list of numbers"):
        Episodes.load(tmp_path)
