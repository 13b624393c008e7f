"""From recordings to an estimate: a lag whose parameters are known."""

from dataclasses import replace

import numpy as np
import pytest
from lag import BIAS, CONFIG, GAIN, LENGTH_S, TAU_S, Model, lag_log, spans
from test_residuals import OutsideModel

from sim2real.errors import Sim2RealError, UsageError
from sim2real.identification import fit as fitting
from sim2real.identification.config import FitConfig
from sim2real.identification.fit import fit, refine, remaining
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span

TABLE = Model.parameters.with_fixed({"square": 0.0})
TRUTH = {"gain": GAIN, "tau": TAU_S, "bias": BIAS}


@pytest.fixture(scope="module")
def episode():
    return lag_log(0)


@pytest.fixture(scope="module")
def found(episode):
    return fit(Problem(Model(), [episode], spans(0), LENGTH_S, CONFIG, TABLE))


@pytest.mark.parametrize("model", [Model, OutsideModel])
def test_the_parameters_are_found_with_honest_errors(episode, model):
    """Also of a world that calls back to Python, which JAX cannot differentiate."""
    result = fit(Problem(model(), [episode], spans(0), LENGTH_S, CONFIG, TABLE))
    assert result.converged
    assert result.left < 0.1
    spread = result.uncertainty()
    assert spread.state == ("ok",) * 3
    for name, error in zip(result.problem.table.names, spread.standard_error, strict=True):
        assert abs(result.values[name] - TRUTH[name]) < 4 * error
        assert error < 0.01


def test_two_starts_end_with_one_loss(found, episode):
    problem = found.problem
    rng = np.random.default_rng(0)
    ends = [refine(problem, problem.table.low[None] + rng.uniform(0.1, 0.9, 3) * problem.table.span) for _ in range(4)]
    assert [e.loss for e in ends] == pytest.approx([found.loss] * 4, rel=1e-3)
    assert all(e.converged for e in ends)


def test_a_search_begins_a_descent_and_reports(episode, found):
    told = []
    config = replace(CONFIG, generations=6, population=4, strategy="SNES", refine_steps=8)
    result = fit(Problem(Model(), [episode], spans(0), LENGTH_S, config, TABLE), report=lambda *what: told.append(what))
    assert result.loss == pytest.approx(found.loss, rel=1e-3)
    assert result.loss <= result.search.loss
    assert result.search.evaluations == 24
    for stage in ("search", "refine"):
        shares = [share for name, share, *_ in told if name == stage]
        assert shares
        assert sum(shares) <= 1.0 + 1e-6
    np.testing.assert_allclose(told[-1][3], result.x)  # what an interrupted search leaves behind


@pytest.mark.parametrize(("low", "high"), [(0.25, 1.2), (2.2, 4.0)])
def test_where_the_bounds_exclude_the_truth_the_fit_ends_at_one(episode, low, high):
    table = TABLE.with_nominal({"gain": (low + high) / 2}).with_bounds({"gain": (low, high)})
    result = fit(Problem(Model(), [episode], spans(0), LENGTH_S, CONFIG, table))
    assert result.values["gain"] == pytest.approx(high if high < GAIN else low, rel=0.02)
    assert result.uncertainty().state[0] == "at a bound"


def test_a_friction_that_begins_at_its_lowest_value_comes_off_it(episode):
    """As at a bound the loss has a slope inwards."""
    rows = [replace(p, low=0.0, begin=0.0) if p.name == "bias" else p for p in TABLE]
    result = fit(Problem(Model(), [episode], spans(0), LENGTH_S, CONFIG, ParameterTable(rows)))
    assert result.values["bias"] == pytest.approx(BIAS, abs=0.01)


def test_from_where_another_fit_ended_only_the_last_refinement_is_made(episode, found, monkeypatch):
    """A descent on windows would leave a minimum that long segments have."""
    cuts, descend = [], fitting._refine
    monkeypatch.setattr(
        fitting, "_refine", lambda problem, *rest: cuts.append(problem.segment_s) or descend(problem, *rest)
    )
    monkeypatch.setattr(fitting, "run_search", lambda *_: pytest.fail("nothing is searched for"))
    longer, end = [Span(0, 0.4 + 2.0 * i) for i in range(3)], found.x + 0.02
    result = fit(Problem(Model(), [episode], spans(0), LENGTH_S, replace(CONFIG, long_s=2.0), TABLE), longer, end=end)
    assert cuts == [2.0]
    assert result.values["gain"] == pytest.approx(GAIN, rel=0.01)


def test_the_first_part_of_a_segment_is_simulated_but_not_compared(episode):
    everything, rest = (Problem(Model(), [episode], spans(0), LENGTH_S, replace(CONFIG, skip_s=s)) for s in (0.0, 0.4))
    np.testing.assert_array_equal(rest.ts, np.where(everything.ts < 0.4, -1.0, everything.ts))
    x = everything.table.start()
    assert not rest.linearise(x).raw[rest.ts[rest.train] < 0].any()
    with pytest.raises(UsageError, match="have no measurement after their first"):
        Problem(Model(), [episode], spans(0), LENGTH_S, replace(CONFIG, skip_s=1.5))


@pytest.mark.parametrize(
    "wrong",
    [{"skip_s": -0.1}, {"skip_s": float("nan")}, {"difference": 0.0}, {"population": 3}, {"reach": 0.0}, {"seed": -1},
     {"max_delay_s": 0.0}, {"refine_steps": 0}],
)  # fmt: skip
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(UsageError):
        FitConfig(**wrong)


def test_no_span_and_no_finite_start_are_errors(episode, found):
    with pytest.raises(UsageError, match="no segment"):
        Problem(Model(), [episode], [], LENGTH_S, CONFIG)
    with pytest.raises(Sim2RealError, match="every loss is infinite"):
        refine(found.problem, np.full((1, 3), np.nan))


def test_what_is_left_of_a_descent_is_counted_in_standard_errors(found):
    problem, error = found.problem, np.sqrt(np.diag(found.uncertainty().scale_covariance))
    assert remaining(problem, found.x) < 0.1
    assert remaining(problem, found.x + np.array([3.0 * error[0], 0.0, 0.0])) == pytest.approx(3.0, rel=0.7)
