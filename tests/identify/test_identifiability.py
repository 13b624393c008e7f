"""What can be identified: groups by name, dead parameters, and what a minute of data would tell."""

from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.identify.model import Channel
from sim2real.identify.parameters import Parameter, ParameterTable
from sim2real.identify.uncertainty.identifiability import from_linearised
from sim2real.identify.uncertainty.uncertainty import Linearised


def checked(table, slopes, segment_s=1.0, segments=10, initial_state="rest", prior=None):
    """Judge a table by slopes ``(P, S, C)`` of residuals on the parameters' scales."""
    problem = SimpleNamespace(
        table=table,
        config=SimpleNamespace(initial_state=initial_state),
        channels=(Channel("q", None, 1.0, 1.0),),
        segment_s=segment_s,
        train=np.arange(segments),
    )
    J = np.moveaxis(np.asarray(slopes), 0, -1)[:, :, None]
    prior = np.diag(12.0 / table.span**2) if prior is None else prior
    x = (table.low + table.high) / 2
    ones = np.ones(J.shape[:3])
    return from_linearised(problem, Linearised(ones, J, prior, x, ones))


def determined(found):
    """Return the combination that each message names; "" of a group of which none is determined."""
    named = [m.partition(" is determined")[0] if m.startswith("only ") else "" for m in found.messages]
    return tuple(name.removeprefix("only ") for name in named)


def log(name, factor=4.0):
    return Parameter(name, "1", 1.0, 1.0 / factor, factor)


def second(name, side=""):
    return Parameter(name, "s", 0.0, 0.0, 0.06, "linear", "delay", side=side)


@pytest.fixture
def signals():
    """Four unrelated signals, ``(4, 10, 80)``."""
    return 20.0 * np.random.default_rng(0).normal(size=(4, 10, 80))


def test_all_is_well(signals):
    found = checked(ParameterTable([log("a"), log("b")]), signals[:2])
    assert found.messages == ()
    assert determined(found) == ()
    span = np.log(16.0)
    expected = np.linalg.cond(signals[:2].reshape(2, -1).T * span)
    assert found.condition == pytest.approx(expected, rel=1e-6)


def test_the_expected_error_is_the_regressions(signals):
    table = ParameterTable([log("a", 1e6), log("b", 1e6)])
    found = checked(table, signals[:2], segment_s=6.0)  # a minute
    J = signals[:2].reshape(2, -1).T
    np.testing.assert_allclose(
        list(found.standard_error_per_minute.values()), np.sqrt(np.diag(np.linalg.inv(J.T @ J))), rtol=1e-3
    )


def test_a_quotient_is_determined_and_its_parts_are_not(signals):
    table = ParameterTable([log("K"), log("R"), log("J"), log("friction")])
    found = checked(table, [signals[0], -signals[0], -signals[0], signals[1]])
    assert determined(found) == ("K/(R J)",)
    assert found.undetermined == (("K", "R", "J"),)
    (message,) = found.messages
    assert message.startswith("only K/(R J) is determined")
    assert found.condition > 1e6


def test_powers_are_named(signals):
    table = ParameterTable([log("K"), log("R"), log("b")])
    found = checked(table, [2 * signals[0], -signals[0], signals[1]])
    assert determined(found) == ("K/R^0.5",)


def test_bounds_of_different_widths_do_not_hide_the_quotient(signals):
    table = ParameterTable([log("K", 30.0), log("R", 2.0), log("J", 8.0)])
    found = checked(table, [signals[0], -signals[0], -signals[0]])
    assert found.undetermined == (("K", "R", "J"),)
    assert determined(found) == ("K/(R J)",)


def test_a_sum_of_delays_is_determined(signals):
    found = checked(ParameterTable([log("gain"), second("sensing"), second("acting")]),
                    [signals[0], 100 * signals[1], 100 * signals[1]])  # fmt: skip
    assert determined(found) == ("sensing + acting",)
    assert found.messages == (
        "only sensing + acting is determined: fix 1 of sensing, acting, or accept what is determined",
    )


def test_logarithms_beside_seconds(signals):
    """Two groups whose scales differ by a factor of fifty: each is reported."""
    table = ParameterTable([log("K"), log("R"), second("sensing"), second("acting")])
    found = checked(table, [signals[0], -signals[0], 100 * signals[1], 100 * signals[1]])
    assert set(determined(found)) == {"K/R", "sensing + acting"}
    assert set(found.undetermined) == {("K", "R"), ("sensing", "acting")}


def test_a_parameter_without_effect(signals):
    found = checked(
        ParameterTable([log("a"), log("dead"), log("b")]), [signals[0], 0 * signals[0], signals[1]], segment_s=6.0
    )
    assert found.undetermined == (("dead",),)
    assert found.messages == ("nothing in this data determines dead: excite it, fix it or give it a prior",)
    assert found.standard_error_per_minute["dead"] == pytest.approx(np.log(16.0) / np.sqrt(12.0), rel=1e-6)


def test_a_dead_parameter_beside_a_group(signals):
    table = ParameterTable([log("K"), second("dead"), log("R")])
    found = checked(table, [signals[0], 0 * signals[0], -signals[0]])
    assert dict(zip(found.undetermined, determined(found), strict=True)) == {("K", "R"): "K/R", ("dead",): ""}


@pytest.mark.parametrize(("segment_s", "factor"), [(6.0, 1.0), (1.5, 0.5), (24.0, 2.0)])
def test_the_error_to_expect_falls_with_the_root_of_time(signals, segment_s, factor):
    table = ParameterTable([log("a", 1e6), log("b", 1e6)])
    minute, found = (checked(table, signals[:2], segment_s=s).standard_error_per_minute for s in (6.0, segment_s))
    assert found == {name: pytest.approx(factor * error, rel=1e-3) for name, error in minute.items()}


def test_a_prior_is_no_data_but_narrows_the_error(signals):
    table = ParameterTable([log("K"), log("R")])
    prior = np.diag(12.0 / table.span**2) + np.diag([0.0, 1e4])  # R is known to a hundredth
    found = checked(table, [signals[0], -signals[0]], prior=prior, segment_s=6.0)
    assert found.standard_error_per_minute["K"] == pytest.approx(0.01, rel=0.05)
