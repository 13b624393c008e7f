"""What is said of parts that were left out: against scipy's distributions and simulated parts, not against itself."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sim2real.errors import UsageError
from sim2real.identification.held_out import HeldOutPart
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.predictions import Position
from sim2real.identification.residuals import Linearised
from sim2real.identification.uncertainty import Uncertainty
from sim2real.stages.config import IdentifyConfig
from sim2real.stages.identify.fitting import widened
from sim2real.stages.identify.inputs import table_of
from sim2real.stages.shared.identification import with_wanted_terms

ANGLE = Position("th", "tilt", "rad", 0.001)


def left(name, value=1.0, ahead=0.1, share=0.2, **more):
    return HeldOutPart(name, {"gain": value}, {"gain": share}, {"th": ahead}, **more)


def at_point(x):
    """Return a linearisation of many residuals at a point."""
    r = np.ones((1, 10_000, 1))
    return Linearised(r, np.zeros((*r.shape, len(x))), np.eye(len(x)), np.array(x), r)


@pytest.fixture
def known():
    """An estimate of 1 with a standard error of 0.01, on a linear scale from 0 to 10."""
    table = ParameterTable([Parameter("gain", "1", 1.0, 0.0, 10.0, "linear")])
    error = np.array([0.01])
    spread = Uncertainty(
        scale_covariance=np.diag(error**2),
        standard_error=error,
        low=np.array([0.98]),
        high=np.array([1.02]),
        state=("ok",),
    )
    return SimpleNamespace(table=table, spread=spread, at=at_point([1.0]))


def test_estimates_that_differ_between_parts_widen_the_interval_to_the_jackknifes(known):
    values = np.array([0.9, 1.0, 1.1, 1.05, 0.95])
    found = widened(known.spread, known.table, known.at, [left(str(v), v) for v in values])
    error = np.sqrt(4 / 5 * np.sum((values - values.mean()) ** 2))
    reach = error * stats.t.ppf(0.975, 4) / stats.norm.ppf(0.975)
    assert found.standard_error[0] == pytest.approx(reach, rel=0.01)
    assert found.high[0] - 1.0 == pytest.approx(1.96 * reach, rel=0.01)
    assert found.scale_covariance[0, 0] == pytest.approx(reach**2, rel=0.02)
    far = widened(known.spread, known.table, known.at, [left(str(k), 1.0 + k) for k in range(5)])
    assert far.state == ("not determined",)
    assert far.low[0] >= 0.0


@pytest.mark.parametrize(
    "rows",
    [
        [left(str(k), 1.0 + 0.001 * k) for k in range(5)],  # no more than by chance
        [left(str(k), 1.0 + 0.1 * k, share=0.6 if k == 1 else 0.1) for k in range(5)],  # one part says nearly all
        [left(str(k), 1.0 + 0.1 * k) for k in range(3)],  # too few
    ],
    ids=["agree", "alone", "few"],
)
def test_otherwise_intervals_stay(known, rows):
    found = widened(known.spread, known.table, known.at, rows)
    assert found.standard_error[0] == pytest.approx(0.01)
    assert found.high[0] == pytest.approx(1.02, abs=1e-3)


def test_what_one_part_alone_determines_widens_as_the_others():
    table = ParameterTable([Parameter(n, "1", 1.0, 0.0, 100.0, "linear") for n in ("gain", "touch")])
    two, error = np.ones(2), 0.01 * np.ones(2)
    square = np.diag(error**2)
    spread = Uncertainty(square, error, 0.98 * two, 1.02 * two, ("ok",) * 2)
    values, shares = np.array([0.9, 1.0, 1.1, 1.05, 0.95]), [0.0, 0.9, 0.1, 0.0, 0.0]
    rows = [
        HeldOutPart(str(k), {"gain": v, "touch": 1.0 + 5.0 * s}, {"gain": 0.2, "touch": s}, {"th": 0.1})
        for k, (v, s) in enumerate(zip(values, shares, strict=True))
    ]
    found = widened(spread, table, at_point(two), rows)
    assert found.standard_error[0] > 5.0 * 0.01
    assert found.standard_error[1] == pytest.approx(found.standard_error[0])


TERMS = ParameterTable(
    [
        Parameter("gain", "1", 1.0, 0.5, 2.0),
        Parameter("cogging", "1", 0.1, -1.0, 1.0, "linear", term="cogging"),
        Parameter("swing", "1", 0.1, -1.0, 1.0, "linear", term="swing", off=0.0),
        Parameter("bias", "1", 0.2, -1.0, 1.0, "linear", term="bias"),
    ]
)


def test_the_flag_says_which_terms_are_there_and_holds_a_value_in_whichever():
    assert with_wanted_terms(TERMS, "own") is TERMS
    every = ("cogging", "swing", "bias")
    assert with_wanted_terms(TERMS, "auto").terms == with_wanted_terms(TERMS, "all").terms == every
    assert with_wanted_terms(TERMS, "none").terms == ()
    assert with_wanted_terms(TERMS, "bias, cogging").terms == ("cogging", "bias")
    with pytest.raises(UsageError, match="unknown term 'drag'"):
        with_wanted_terms(TERMS, "drag")
    with pytest.raises(UsageError, match="no optional terms"):
        with_wanted_terms(ParameterTable([TERMS["gain"]]), "auto")
    model = SimpleNamespace(parameters=TERMS, reached=lambda _: {})
    fewer = table_of(model, IdentifyConfig(terms="cogging", fix={"swing": 0.3}), [])
    assert fewer.terms == ("cogging",)
    assert {p.name: (p.nominal, p.free) for p in fewer} == {
        "gain": (1.0, True), "cogging": (0.1, True), "swing": (0.3, False), "bias": (0.2, False),
    }  # fmt: skip
