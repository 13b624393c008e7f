"""Identification of a synthetic log whose truth is known to the last digit."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Steps
from sim2real.identification.predictions import errors, positions, samples
from sim2real.identification.residuals import Problem
from sim2real.identification.segments import Span

SETTLE_S = 0.3


def round_trip(values):
    return values["sensor_delay"] + values["actuator_delay"]


def test_truth_is_recovered_and_the_interval_of_the_round_trip_covers_it(fitted):
    found, truth, spread = fitted.values, fitted.truth, fitted.spread
    for name in ("gain", "gravity", "damping", "friction"):
        assert found[name] == pytest.approx(truth[name], rel=0.03)
    assert spread.state == ("ok",) * 5
    error = spread.standard_error[list(fitted.problem.table.names).index("actuator_delay")]
    assert error < 0.002
    assert round_trip(found) == pytest.approx(round_trip(truth), abs=min(0.001, 1.96 * error))


def test_the_nominal_model_without_delays_is_much_worse(fitted):
    models = {
        "identified": fitted.values,
        "no_delays": {**fitted.values, "sensor_delay": 0.0, "actuator_delay": 0.0},
        "nominal": {p.name: p.nominal for p in fitted.problem.table},
    }
    columns = samples(fitted.problem, models, SETTLE_S)
    check_measurements(fitted, columns)
    (row,) = errors(columns, list(models), positions(fitted.problem.model, {}), SETTLE_S, 1.0)
    rmse = {"identified": row.error, **row.baselines}
    assert rmse["identified"] < 0.03
    assert rmse["nominal"] > 5 * rmse["identified"]
    assert rmse["no_delays"] > 2 * rmse["identified"]
    assert rmse["standing still"] > 5 * rmse["identified"]


def check_measurements(fitted, columns):
    """What is called measured is what the log holds at that time, and held out is what was not fitted."""
    episode, problem = fitted.episode, fitted.problem
    stamps = episode.steps["sensor"].ts_overwrite * 1e-6
    near = np.abs(stamps[None] - columns["t"][:, None]).argmin(axis=1)
    np.testing.assert_allclose(stamps[near], columns["t"], atol=2e-6)
    for field in ("th", "thdot"):
        np.testing.assert_allclose(columns[f"{field}_measured"], episode.outputs["sensor"][field][near], atol=1e-5)
    np.testing.assert_array_equal(columns["held_out"], columns["segment"] >= len(problem.train))
    assert columns["held_out"].any()
    per_segment = np.bincount(columns["segment"])
    assert per_segment.min() > 0.8 * problem.segment_s * 50


@pytest.mark.parametrize(("node", "field"), [("sensor", "th"), ("sensor", "thdot"), ("actuator", "action")])
def test_nan_in_the_log_is_an_error(fitted, node, field):
    data = fitted.episode.outputs[node][field].copy()
    data[123] = np.nan
    outputs = {**fitted.episode.outputs, node: {**fitted.episode.outputs[node], field: data}}
    with pytest.raises(Sim2RealError, match=f"'{field}' of node '{node}'.*no numbers, the first in step 123"):
        fitted.make_problem(replace(fitted.episode, outputs=outputs))


def test_logs_that_lack_something_are_errors(fitted):
    episode = fitted.episode
    with pytest.raises(Sim2RealError, match=r"no steps of node 'actuator'\. Available: sensor"):
        fitted.make_problem(replace(episode, steps={"sensor": episode.steps["sensor"]}))
    outputs = {**episode.outputs, "sensor": {"th": episode.outputs["sensor"]["th"]}}
    with pytest.raises(Sim2RealError, match=r"no field 'thdot' in this log\. Available: th"):
        fitted.make_problem(replace(episode, outputs=outputs))
    model = fitted.problem.model
    with pytest.raises(UsageError, match="too few to start a segment"):
        Problem(model, [episode], [Span(0, 1.0), Span(0, episode.duration_s + 3.0)], fitted.problem.segment_s)


def test_a_segment_that_would_start_in_a_gap_is_skipped(fitted):
    """As where a busy computer paused the recording: the rest of the log is of use."""
    episode, model = fitted.episode, fitted.problem.model
    steps = episode.steps["sensor"]
    rows = np.flatnonzero((steps.start < 3_000_000) | (steps.start > 4_000_000))
    kept = Steps(*(getattr(steps, name)[rows] for name in Steps.__dataclass_fields__))
    outputs = {n: v[rows] for n, v in episode.outputs["sensor"].items()}
    paused = replace(
        episode, steps={**episode.steps, "sensor": kept}, outputs={**episode.outputs, "sensor": outputs}, messages={}
    )
    problem = Problem(model, [paused], [Span(0, b) for b in (1.0, 3.5, 5.0)], fitted.problem.segment_s)
    assert [s.begin_s for s in problem.spans] == [1.0, 5.0]
    with pytest.raises(UsageError, match="each segment would start in a gap"):
        Problem(model, [paused], [Span(0, 3.5)], fitted.problem.segment_s)
