"""The worst second: of which joint, when, and against which size."""

import math

import numpy as np
import pytest

from sim2real.artifacts.identification import with_small_unit, worst_window
from sim2real.identification.predictions import Position, worst_second

LARGE, SMALL = Position("q[0]", "hip", "rad", 0.001), Position("q[1]", "wrist", "rad", 0.001)
LOGS = ("a.mcap", "b.mcap")


def samples(errors):
    """Return 8 segments of 1.3 s, the last two held out; ``errors`` are functions of the time [s], one a joint."""
    into = np.tile(np.arange(0, 1.3, 0.01), 8)
    segment = np.repeat(np.arange(8), 130)
    t = into + 1.3 * segment
    columns = {"t": t, "into": into, "segment": segment, "recording": 0 * segment, "held_out": segment >= 6}
    for p, size, error in zip((LARGE, SMALL), (1.0, 0.05), errors, strict=True):
        measured = size * np.sin(2 * t)
        columns |= {f"{p.column}_measured": measured, f"{p.column}_identified": measured + error(t)}
    return columns


def still(t):
    return 0.001 * np.sin(50 * t)


def pulse(begin_s, size, long_s=0.5):
    return lambda t: np.where((t >= begin_s) & (t < begin_s + long_s), size, 0.0)


@pytest.mark.parametrize(
    ("errors", "name", "around_s"),
    [
        ((pulse(3.0, 0.2), still), "hip", 3.25),
        ((still, pulse(4.3, 0.03)), "wrist", 4.55),
        ((pulse(3.0, 0.04), pulse(4.3, 0.03)), "wrist", 4.55),
        ((pulse(3.0, 0.0015), still), "hip", 3.25),
        ((pulse(7.81, 0.5, 0.28), pulse(3.0, 0.005)), "wrist", 3.25),
    ],
    ids=["large", "small", "as a share of the motion", "all is noise", "the fitted beginning of a held-out segment"],
)
def test_the_worst_joint_and_its_second(errors, name, around_s):
    columns = samples(errors)
    worst, inside = worst_second(columns, (LARGE, SMALL), 0.3, LOGS)
    assert worst.joint == name
    t = columns["t"][inside]
    assert (t[0], t[-1]) == (worst.begin_s, worst.end_s)
    assert worst.begin_s <= around_s <= worst.end_s
    assert worst.end_s - worst.begin_s == pytest.approx(1.0, abs=0.02)


def test_a_model_that_diverges_is_the_worst():
    worst, _ = worst_second(samples((pulse(3.0, 5.0), pulse(4.3, math.nan))), (LARGE, SMALL), 0.3, LOGS)
    assert (worst.joint, worst.error, worst.unexplained) == ("wrist", None, True)
    assert worst_second({}, (LARGE,), 0.3, LOGS) is None


def test_a_series_shorter_than_a_second_is_one_window():
    assert worst_window(np.array([0.0, 0.1]), np.array([1.0, 9.0])) == (0.0, 0.1, pytest.approx(math.sqrt(5.0)))


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (0.00423, "rad", "4.2 mrad"),
        (1.5, "rad", "1.5 rad"),
        (0.809, "rad", "809 mrad"),
        (0.02, "V", "0.02 V"),
        (3.0, "", "3"),
    ],
)
def test_small_errors_are_in_thousandths(value, unit, text):
    assert with_small_unit(value, unit) == text
