"""The verdict: one of four, and why."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.identify.identifiability import Check
from sim2real.identify.verdict import judge

NAMES = ("gain", "sensor_delay", "actuator_delay")
DELAYS = NAMES[1:]


def rows(identified, nominal, horizon_s=1.0, held_out=True, **others):
    errors = {"identified": identified, "nominal": nominal, **others}
    return [
        {"model": m, "horizon_s": horizon_s, "held_out": held_out, "rmse": e} for m, e in errors.items()
    ]  # fmt: skip


def spread(*verdicts, misfit=1.0):
    return SimpleNamespace(verdict=verdicts or ("accepted",) * 3, misfit=misfit)


def check(*groups):
    one = np.ones(3)
    return Check(1.0, one, one, tuple("" if len(g) == 1 else " + ".join(g) for g in groups), groups, 60.0)


def test_accepted():
    found = judge(rows(0.1, 1.0, hold=0.4), spread(), NAMES, check(), shifted=DELAYS)
    assert found.status == "accepted"
    assert len(found.reasons) == 1
    assert "1 s ahead on held-out data" in found.reasons[0]
    assert "0.25 times" in found.reasons[0]
    assert "hold" in found.reasons[0]


@pytest.mark.parametrize("own", [0.96, 1.0, 3.0, np.nan, np.inf])
def test_no_improvement(own):
    found = judge(rows(own, 5.0, hold=1.0) if own < 4 else rows(own, 1.0), spread(), NAMES, check(), shifted=())
    assert found.status == "no improvement on held-out data"
    assert found.reasons[0].startswith("1 s ahead on held-out data it is no better than: ")
    assert ("hold" if own < 4 else "nominal") in found.reasons[0]


@pytest.mark.parametrize("diverged", [np.nan, np.inf])
def test_a_baseline_that_diverges_is_no_better(diverged):
    assert judge(rows(0.1, diverged), spread(), NAMES, check(), shifted=()).status == "accepted"


def test_the_longest_horizon_on_held_out_data_decides():
    prediction = rows(2.0, 1.0, horizon_s=0.1) + rows(0.5, 1.0, horizon_s=1.0) + rows(9.0, 1.0, 2.0, held_out=False)
    assert judge(prediction, spread(), NAMES, check(), shifted=()).status == "accepted"
    nothing = [{"model": "identified", "horizon_s": 3.0, "held_out": True, "rmse": None}]
    assert judge(prediction + nothing, spread(), NAMES, check(), shifted=()).status == "accepted"


def test_hit_a_bound():
    found = judge(rows(0.1, 1.0), spread("at a bound", "accepted", "accepted"), NAMES, check(), shifted=())
    assert found.status == "hit a bound"
    assert any(r.startswith("at a bound: gain; widen it with --bounds") for r in found.reasons)


def test_not_identifiable():
    found = judge(rows(0.1, 1.0), spread(), NAMES, check(("gain",)), shifted=())
    assert found.status == "not identifiable"
    assert "nothing in this data determines gain: excite it, fix it or give it a prior" in found.reasons


def test_delays_of_which_the_sum_counts_are_as_they_should_be():
    group = check(("sensor_delay", "actuator_delay"))
    assert judge(rows(0.1, 1.0), spread(), NAMES, group, shifted=DELAYS).status == "accepted"
    assert judge(rows(0.1, 1.0), spread(), NAMES, group, shifted=()).status == "not identifiable"
    mixed = check(("gain", "actuator_delay"))
    assert judge(rows(0.1, 1.0), spread(), NAMES, mixed, shifted=DELAYS).status == "not identifiable"


def test_the_first_that_applies_is_the_status_and_all_are_reasons():
    found = judge(rows(1.0, 1.0), spread("at a bound", "accepted", "accepted", misfit=7.0), NAMES,
                  check(("gain",)), shifted=())  # fmt: skip
    assert found.status == "no improvement on held-out data"
    assert len(found.reasons) == 4
    assert "residuals are 7 times the measurement's deviation" in found.reasons[-1]
    found = judge(rows(0.1, 1.0), spread("at a bound", "accepted", "accepted"), NAMES, check(("gain",)), shifted=())
    assert found.status == "hit a bound"


def test_nothing_held_out_is_told():
    found = judge(rows(0.1, 1.0, held_out=False), spread(), NAMES, check(), shifted=())
    assert found.reasons == ("nothing was held out: how well it predicts is not known",)


def test_a_delay_that_is_not_needed_is_no_failure():
    prediction = rows(0.1, 1.0, **{"no delay": 0.1})
    found = judge(prediction, spread(), NAMES, check(), shifted=DELAYS)
    assert found.status == "accepted"
    assert any("does not need one" in r for r in found.reasons)


def test_extrapolation_is_said():
    found = judge(rows(0.1, 1.0), spread(), NAMES, check(), DELAYS, ["held-out data extrapolates: kp"])
    assert "held-out data extrapolates: kp" in found.reasons
