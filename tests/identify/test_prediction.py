"""Prediction errors and the worst second, on columns made by hand."""

import math

import numpy as np
import pytest

from sim2real.artifacts.identification import with_small_unit, worst_window
from sim2real.identification.lacks import ringing
from sim2real.identification.predictions import Position, errors, worst_second

SETTLE_S = 0.2
POSITIONS = (Position("th", "th", "rad", 0.1), Position("q[2]", "q", "rad", 0.1))


@pytest.fixture
def columns():
    """Two segments with a sample each 0.1 s, one of them held out; measured is a ramp in the second."""
    into = np.tile(0.1 * np.arange(1, 8), 2)
    segment = np.repeat([0, 1], 7)
    measured = np.where(segment == 0, 3.0, 10.0 * into)
    off = np.where(into > SETTLE_S, np.where(segment == 0, 0.5, 1.0 + (into > 0.45)), 100.0)
    made = {
        "t": into + 20.0 * segment,
        "segment": segment,
        "recording": segment + 4,
        "held_out": segment == 1,
        "into": into,
    }
    for label in ("th", "thdot", "q[2]"):
        made[f"{label}_measured"] = measured
        made[f"{label}_model"] = measured + off * (2.0 if label == "thdot" else -1.0)
    return made


def errors_at(columns, horizon_s):
    """Return model -> error of each position up to a horizon."""
    column_of = {p.name: p.column for p in POSITIONS}
    rows = errors(columns, ["model"], POSITIONS, SETTLE_S, horizon_s)
    return {column_of[row.joint]: {"model": row.error, **row.baselines} for row in rows}


def test_errors_count_from_the_end_of_settling_to_the_horizon(columns):
    short, long = (errors_at(columns, horizon_s) for horizon_s in (0.2001, 0.5001))
    assert short["th"]["model"] == pytest.approx(1.0)  # 0.3 and 0.4 s: off by 1
    assert long["th"]["model"] == pytest.approx(np.sqrt((1 + 1 + 4 + 4 + 4) / 5))  # and 0.5 to 0.7 s: off by 2
    assert long["q[2]"]["model"] == pytest.approx(long["th"]["model"])


def test_standing_still_says_what_was_measured_last(columns):
    # The last measurement before the horizon is the one at 0.2 s, 2: then 3 and 4 come.
    assert errors_at(columns, 0.2001)["th"]["standing still"] == pytest.approx(np.sqrt((1 + 4) / 2))


def test_the_goal_is_where_a_joint_shall_be(columns):
    columns = {**columns, "q[2]_goal": columns["q[2]_measured"] + np.where(columns["into"] > 0.45, 0.3, 0.1)}
    found = errors_at(columns, 0.2001)
    assert found["q[2]"]["goal"] == pytest.approx(0.1)
    assert "goal" not in found["th"]


@pytest.mark.parametrize(("resonance_hz", "found"), [(15.0, True), (8.0, True), (None, False)])
def test_a_belt_rings_where_friction_and_noise_do_not(resonance_hz, found):
    """A mass on a spring behind a drive that follows a motion, and residuals of dry friction with noise."""
    rng, step_s, length = np.random.default_rng(0), 0.005, 260
    t = step_s * np.arange(12 * length)
    waves, phases = rng.uniform(0.3, 4.0, 8), rng.uniform(0.0, 6.28, 8)
    q = 0.1 * np.sin(2 * np.pi * waves * t[:, None] + phases).sum(axis=1) + 0.3 * np.sign(np.sin(2.5 * t))
    q = np.convolve(q, np.hanning(16) / np.hanning(16).sum(), "same")
    speed, acceleration = np.gradient(q, step_s), np.gradient(np.gradient(q, step_s), step_s)
    off = 0.01 * np.sign(speed) + 1e-4 * acceleration
    if resonance_hz:
        w, y, dy = 2 * np.pi * resonance_hz, np.zeros_like(q), 0.0
        for k in range(1, len(t)):
            dy += step_s * (-acceleration[k - 1] - 0.06 * w * dy - w * w * y[k - 1])
            y[k] = y[k - 1] + step_s * dy
        off = y
    segment = np.repeat(np.arange(12), length)
    samples = {"into": t - t[segment * length], "segment": segment, "held_out": segment >= 9}
    samples |= {"q_identified": q, "q_measured": q + off + 1e-3 * rng.normal(size=len(t))}
    share, hz = ringing(samples, "q")
    assert (share > 1 / 3) == found
    assert not found or hz == pytest.approx(resonance_hz, rel=0.15)
    assert ringing(samples | {"held_out": segment >= 0}, "q") == (0.0, 0.0)
    assert ringing({name: column[:29] for name, column in samples.items()}, "q") == (0.0, 0.0)


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
