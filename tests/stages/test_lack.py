"""What a model lacks: residuals far above the noise and free runs that are far off, and the term that mends them."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.artifacts.identification import (
    ComparedError,
    Estimate,
    Identification,
    Internal,
    Judgement,
    Noise,
    Term,
    WorstSecond,
)
from sim2real.identification import lacks
from sim2real.identification.lacks import farthest_run, find_lack, largest_residual, unexplained_second
from sim2real.identification.predictions import Position
from sim2real.identification.residuals import Linearised
from sim2real.stages.identify import judgement

AXIS, ARM = Position("x[0]", "axis", "m", 1e-5), Position("x[1]", "arm", "rad", 1e-3)
NOISE, DRAG = (Noise("x[1]", "rad", 1e-3, 0.0, 0.0),), Term("drag", True)


def run(joint, error):
    return ComparedError("log", joint, "", 6.0, error, free_run=True)


def document(times_noise, *runs, terms=()):
    """Positions that move by 0.2 m and 2 rad; the arm's residuals are some times its noise of 1 mrad."""
    read, off = np.linspace(0.0, 1.0, 50), 1e-3 * times_noise * np.array([1.0, -1.0] * 25)
    columns = {"x[0]_measured": 0.2 * read, "x[1]_measured": 2.0 * read, "x[1]_identified": 2.0 * read + off}
    columns |= {"into": np.full(50, 1.0)}
    return Identification(
        "rig", (), Judgement("", ()), (), errors=runs, samples=columns, terms=terms, internal=Internal(settle_s=0.3)
    )


def lacked(found, monkeypatch, leaning=None, rings=(0.1, 4.0)):
    """Return what a document lacks."""
    monkeypatch.setattr(lacks, "ringing", lambda *_: rings)
    return find_lack(found, [AXIS, ARM], NOISE, lambda: leaning)


@pytest.mark.parametrize(
    ("times_noise", "tried", "named", "flags"),
    [
        (3.0, (), (), ""),
        (3.1, (), ("no optional term was tried",), ""),
        (25.0, (Term("load", False, 0.95),), ("25 times", "load", "95%"), "--terms drag,load"),
        (75.0, (Term("load", False, 0.375),), ("load", "--terms drag,load", "gravity"), ""),
        (75.0, (Term("load", False, 0.0125),), ("no further term", "gravity"), ""),
        (75.0, (Term("load", False), Term("drag", True, 0.95)), ("no further term", "gravity"), ""),
    ],
)
def test_a_model_lacks_the_term_that_halves_its_errors(times_noise, tried, named, flags, monkeypatch):
    found = lacked(document(times_noise, terms=(DRAG, *tried)), monkeypatch)
    assert found.flags == flags
    assert found.unexplained == (times_noise > 50.0)
    assert len(found.reasons) == bool(named)
    assert all(word in found.reasons[0] for word in named)


@pytest.mark.parametrize(("times_noise", "named"), [(9.0, False), (25.0, True)])
def test_gravity_of_another_direction_is_named_first_with_its_command(times_noise, named, monkeypatch):
    leaning = 0.99, {"tilt_x": 0.0, "tilt_y": 0.7}
    found = lacked(document(times_noise, terms=(DRAG,)), monkeypatch, leaning)
    assert ("+0.70 rad (tilt_y)" in found.reasons[0]) == named
    assert found.flags.startswith("--terms drag,tilt --bounds tilt_x -3.15" if named else "")
    assert bool(found.flags) == named


@pytest.mark.parametrize(("turned", "promising"), [(2.0, True), (0.0, False)])
def test_gravity_is_turned_where_a_small_turn_would_help_beside_all_others(turned, promising):
    rng = np.random.default_rng(0)
    J = rng.normal(size=(5, 40, 1, 3))
    r = rng.normal(size=(5, 40, 1)) + J @ np.array([3.0, -2.0, turned])  # others explain what they can
    at = Linearised(r, J, np.eye(3), np.zeros(3), r)
    assert lacks._promises(at, np.array([False, False, True])) is promising


@pytest.mark.parametrize(("times_noise", "share", "named"), [(2.0, 0.5, False), (8.0, 0.5, True), (8.0, 0.3, False)])
def test_a_joint_that_rings_has_no_estimates(times_noise, share, named, monkeypatch):
    found = lacked(document(times_noise), monkeypatch, rings=(share, 14.6))
    assert found.unexplained == named
    assert any("rings at 15 Hz" in reason for reason in found.reasons) == named


@pytest.mark.parametrize(
    ("runs", "named"),
    [
        ([], []),
        ([run("axis", 0.002), run("arm", 0.01)], ["axis is off by 2 mm, 1.0%"]),
        ([run("axis", 0.002), run("arm", 0.19)], ["arm is off by 190 mrad, 9.5%"]),
        ([run("axis", 0.04), run("axis", 0.06)], ["axis is off by 50 mm, 25.0%"]),
        ([run("axis", None)], ["axis diverges"]),
    ],
)
def test_the_worst_free_run_is_named(runs, named, monkeypatch):
    found = lacked(document(1.0, *runs), monkeypatch)
    assert not found.flags
    assert len(found.reasons) == len(named)
    assert all(word in reason for word, reason in zip(named, found.reasons, strict=True))


def test_positions_are_compared_by_their_own_noise_and_range():
    found = document(20.0, run("axis", 0.05), run("arm", 0.3))
    position, ratio, noise = largest_residual(found, NOISE, [AXIS, ARM])
    assert (position, noise) == (ARM, 1e-3)
    assert ratio == pytest.approx(20.0)
    # A noise of zero, as in a simulation, counts as a tenth of the assumed deviation.
    assert largest_residual(found, (Noise("x[1]", "rad", 0.0, 0.0, 0.0),), [ARM])[2] == pytest.approx(1e-4)
    assert largest_residual(found, (), [ARM]) is None
    assert farthest_run(found, [AXIS, ARM]) == (AXIS, 0.05, pytest.approx(0.25))


@pytest.mark.parametrize(("error", "share", "said", "alone"), [
    (0.3, 0.9, True, True), (0.02, 0.6, True, False), (0.3, 0.4, False, False), (None, None, True, True),
])  # fmt: skip
def test_a_second_that_is_worse_than_all_others_is_named_before_what_it_bends(error, share, said, alone):
    worst = WorstSecond("arm", "x[1]", "rad", "a.mcap", 4.1, 5.1, error, share)
    sentence, first = unexplained_second(replace(document(20.0), worst=worst))
    assert ("joint arm, 4.1 s of a.mcap" in sentence, first) == (said, alone)


def test_no_parameter_is_ok_in_a_fit_that_is_not_accepted():
    row = Estimate("kp", "1", "dynamics", "", 1.0, 1.0, state="ok")
    assert judgement._doubted(row).state == "not determined"
    for state in ("at a bound", "fixed"):
        assert judgement._doubted(replace(row, state=state)).state == state
