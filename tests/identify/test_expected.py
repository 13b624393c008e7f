"""The expected error: 1.25 times the worst held-out part, wider for motion beyond the fitted one."""

import numpy as np
import pytest

from sim2real.artifacts.identification import ComparedError, Identification, Internal, Judgement
from sim2real.identification.expected import wider_for, with_expected_errors
from sim2real.identification.held_out import HeldOutPart
from sim2real.identification.predictions import Position

JOINT = Position("position[0]", "pan", "rad", 0.001)
NO_MOTION = np.zeros(40)


def part(name, ahead, free):
    return HeldOutPart(name, {}, {}, {JOINT.column: ahead}, {JOINT.column: free}, run_s=4.0)


def samples(error, measured=None):
    """Return the columns of one held-out segment with a constant error."""
    measured = np.sin(np.linspace(0.0, 6.0, 40)) if measured is None else measured
    columns = {"t": np.arange(40) * 0.05, "into": np.arange(40) * 0.05, "segment": np.zeros(40, int)}
    columns |= {"recording": np.zeros(40, int), "held_out": np.ones(40, bool)}
    return columns | {"position[0]_measured": measured, "position[0]_identified": measured + error}


def judged(parts, error=0.01, wider=1.0, measured=None):
    rows = samples(error, measured)
    document = Identification("robot", (), Judgement("", ()), (), samples=rows, free=rows)
    return with_expected_errors(document, [JOINT], parts, ["log"], [{JOINT.name: wider}])


def test_it_is_the_worst_part_and_a_quarter():
    found = judged([part("a", 0.01, 0.02), part("b", 0.03, 0.04), part("c", None, None)])
    assert found.expected_of(JOINT.name).error == pytest.approx(1.25 * 0.03)
    assert found.expected_of(JOINT.name, free_run=True).error == pytest.approx(1.25 * 0.04)
    ahead = found.errors[0]
    assert (ahead.expected, ahead.ratio) == (pytest.approx(1.25 * 0.03), pytest.approx(0.01 / (1.25 * 0.03)))
    assert not ahead.exceeded


def test_of_many_parts_one_that_stands_out_does_not_decide():
    errors = [*np.linspace(0.01, 0.02, 15), 0.05]
    found = judged([part(str(i), e, e) for i, e in enumerate(errors)])
    assert found.expected_of(JOINT.name).error == pytest.approx(1.25 * np.quantile([*errors, 0.01], 0.9))
    assert found.errors[0].expected < 1.25 * 0.03
    few = [part(str(i), e, e) for i, e in enumerate(errors[-9:])]
    assert judged(few[:-1]).expected_of(JOINT.name).error == pytest.approx(1.25 * errors[-2])
    assert judged(few).expected_of(JOINT.name).error < 1.25 * 0.03, "of ten, the end of the log is one"
    diverged = judged([part(str(i), e, np.inf if i == 3 else e) for i, e in enumerate(errors)])
    assert diverged.expected_of(JOINT.name, free_run=True) is None


def test_an_error_on_held_out_data_is_compared_and_expected_from_then_on():
    found = judged([part("a", 0.01, 0.01), part("b", 0.02, 0.01)], error=0.08, wider=2.0)
    ahead = found.errors[0]
    assert ahead.expected == pytest.approx(2.0 * 1.25 * 0.02)
    assert ahead.ratio == pytest.approx(1.6)
    assert ahead.exceeded
    assert found.expected_of(JOINT.name).error == pytest.approx(1.25 * 0.08 / 2.0)


@pytest.mark.parametrize("parts", [[part("a", 0.01, 0.01)], [part("a", 0.01, np.inf), part("b", np.nan, 0.01)]])
def test_too_few_parts_or_one_that_diverged_let_expect_nothing(parts):
    found = judged(parts)
    assert found.expected_error == ()
    assert [row.expected for row in found.errors] == [None, None]


def test_it_is_not_below_the_noise_and_a_joint_at_rest_is_not_compared():
    found = judged([part("a", 1e-5, 1e-5), part("b", 1e-5, 1e-5)], error=0.0, measured=NO_MOTION)
    assert found.errors == ()
    assert found.expected_of(JOINT.name).error == pytest.approx(2.0 * JOINT.sigma)


@pytest.mark.parametrize("names", [["log"], ["log", "at rest"]])
def test_the_error_on_all_held_out_data_is_that_of_the_only_log(names):
    rows, parts = samples(0.01), [part("a", 0.01, 0.01), part("b", 0.02, 0.01)]
    whole = ComparedError("", JOINT.name, "rad", 2.0, 0.01, baselines={"standing still": 0.5})
    settled = Internal(settle_s=0.1)
    document = Identification(
        "robot", (), Judgement("", ()), (), errors=(whole,), samples=rows, free=rows, internal=settled
    )
    found = with_expected_errors(document, [JOINT], parts, names, [{}] * len(names))
    (overall,) = found.held_out
    assert overall.baselines == {"standing still": 0.5}
    assert (overall.expected is not None) == (len(names) == 1)
    assert len([e for e in found.errors if not e.free_run]) == len(names)
    assert "" in {e.log for e in found.judged}
    assert {e.seconds for e in found.errors if not e.free_run} == {2.0}, "the horizon, although samples end before it"
    assert [e.seconds for e in found.errors if e.free_run] == [pytest.approx(1.85)]


def motion(low, high, speed):
    return {JOINT.name: (low, high, speed)}


@pytest.mark.parametrize(
    ("later", "factor"),
    [
        (motion(-1.0, 1.0, 2.0), 1.0),
        (motion(-0.5, 0.5, 6.0), 3.0),
        (motion(-1.0, 2.0, 2.0), 1.5),
        (motion(-1.0, 1.0, 90.0), 4.0),
        (motion(-1.0, 30.0, 2.0), 1.0 + (2 * np.pi - 2.0) / 2.0),  # after a whole turn a hinge has been everywhere
    ],
)
def test_the_motion_of_a_single_joint_widens_it(later, factor):
    assert wider_for(motion(-1.0, 1.0, 2.0), later, [JOINT]) == {"pan": pytest.approx(factor)}
    moved = {JOINT.name: (later[JOINT.name][0] + 5.0, later[JOINT.name][1] + 5.0, later[JOINT.name][2])}
    assert wider_for(motion(4.0, 6.0, 2.0), moved, [JOINT]) == {"pan": pytest.approx(factor)}, "wherever zero is"


@pytest.mark.parametrize(("before", "now", "factor"), [(0.5, 1.5, 3.0), (0.0, 1.5, 1.0)])
def test_how_much_faster_a_slow_joint_moves(before, now, factor):
    assert wider_for(motion(-1.0, 1.0, before), motion(-1.0, 1.0, now), [JOINT]) == {"pan": pytest.approx(factor)}
