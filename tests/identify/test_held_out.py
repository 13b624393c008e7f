"""Parts that are held out: the same as never having recorded them."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lag import BIAS, CONFIG, LENGTH_S, NOISE, Model, lag_log, spans

from sim2real.errors import UsageError
from sim2real.identification import held_out
from sim2real.identification.fit import fit, refine, refit
from sim2real.identification.held_out import Fold, folds_of, leave_out, moving
from sim2real.identification.model import Channel
from sim2real.identification.parameters import Parameter, ParameterTable
from sim2real.identification.residuals import Linearised, Problem
from sim2real.identification.segments import Span


@pytest.fixture(scope="module")
def one():
    """One log, fitted with all terms, and again without each of three parts."""
    episode = lag_log(0)
    whole = fit(Problem(Model(), [episode], spans(0), LENGTH_S, CONFIG))
    parts = folds_of(whole.problem, 3)
    rows = leave_out(whole, parts, 0.2, free_run_s=20.0)
    return SimpleNamespace(episode=episode, fit=whole, parts=parts, rows=rows)


def test_a_part_that_is_left_out_might_as_well_not_have_been_recorded(one):
    for part, row in list(zip(one.parts, one.rows, strict=True))[:1]:
        rest = [s for s, gone in zip(spans(0), part.touches(spans(0), LENGTH_S), strict=True) if not gone]
        assert 4 <= len(rest) < len(spans(0))
        alone = fit(Problem(Model(), [one.episode], rest, LENGTH_S, CONFIG)).values
        for name in ("gain", "tau", "bias", "square"):
            spread = abs(alone[name] - one.fit.values[name])
            assert float(row.values[name]) == pytest.approx(alone[name], abs=0.02 * spread + 2e-5)


def test_fewer_parameters_are_estimated_as_by_a_table_that_holds_the_others(one):
    problem, names = one.fit.problem, one.fit.problem.table.names
    present = np.array([n in ("gain", "tau") for n in names])
    fixed = Model.parameters.with_fixed({"bias": 0.0, "square": 0.0})
    alone = fit(Problem(Model(), [one.episode], spans(0), LENGTH_S, CONFIG, fixed))
    data = problem.part(present=present)
    ended = refine(problem, problem.table.start()[None], data)
    found = problem.table.decode(ended.x, present)
    assert ended.loss == pytest.approx(alone.loss, rel=1e-3)
    errors = dict(zip(alone.problem.table.names, alone.uncertainty().standard_error, strict=True))
    assert (float(found["bias"]), float(found["square"])) == (0.0, 0.0)
    for name in ("gain", "tau"):
        assert float(found[name]) == pytest.approx(alone.values[name], abs=0.1 * errors[name])
        assert abs(float(found[name]) - one.fit.values[name]) > 10 * 0.1 * errors[name]
    # A model to compare with by percents ends earlier.
    coarse = refit(problem, present, one.fit.x)
    assert (coarse["bias"], coarse["square"]) == (0.0, 0.0)
    assert problem.loss(problem.table.encode(coarse), data) == pytest.approx(alone.loss, rel=2e-2)
    assert refit(problem, np.zeros(len(names), bool), one.fit.x)["gain"] == 1.5


def test_blocks_cover_the_log_without_overlap(one):
    ends = [(begin, end) for part in one.parts for _, begin, end in part.stretches]
    assert ends[0][0] == pytest.approx(0.4)
    assert all(a[1] == pytest.approx(b[0]) for a, b in pairwise(ends))
    masks = np.array([p.touches(spans(0), LENGTH_S) for p in one.parts])
    assert masks.any(axis=0).all()
    with pytest.raises(UsageError, match="cannot be divided into 40 parts"):
        folds_of(one.fit.problem, 40)


def test_a_model_that_is_right_leaves_the_noise(one):
    for row in one.rows:
        assert row.ahead["y"] == pytest.approx(NOISE, rel=0.25)
        assert row.free["y"] == pytest.approx(NOISE, rel=0.25)
    assert sum(row.share["gain"] for row in one.rows) == pytest.approx(1.0)


@pytest.mark.parametrize("present", [[True], [False]])
def test_a_part_that_is_left_out_of_a_linear_model_has_the_error_of_a_refit(present):
    """Against numpy: each part's mean square at the least squares of all others."""
    table = ParameterTable(
        [
            Parameter("gain", "1", 0.0, -1e4, 1e4, "linear"),
            Parameter("bias", "1", 0.0, -1e4, 1e4, "linear", term="bias"),
        ]
    )
    rng, at = np.random.default_rng(0), np.array([0.3, -0.2])
    J, noise = rng.normal(size=(6, 40, 1, 2)), rng.normal(size=(6, 40, 1))
    r = J @ (at - [1.0, 0.5]) + noise
    parts = np.repeat(np.eye(3, dtype=bool), 2, axis=1)
    stats = held_out.statistics(None, Linearised(r, J, 1e-12 * np.eye(2), at, r), parts)
    found = held_out.on_held_out_parts(stats, table, np.array(present))
    columns, y = slice(0, 2 if present[0] else 1), (J @ at)[..., 0] - r[..., 0]
    for k, part in enumerate(parts):
        best = np.linalg.lstsq(J[~part][..., 0, columns].reshape(-1, columns.stop), y[~part].ravel(), rcond=None)[0]
        assert found[k] == pytest.approx(np.mean((J[part][..., 0, columns] @ best - y[part]) ** 2), rel=1e-6)


def test_errors_are_of_parts_in_which_the_joint_moves():
    pan, tilt = Channel("pan", "pan_rate", 0.002, 0.1), Channel("tilt", None, 0.002, 0.1)
    ts = np.array([[0.0, 0.1, 0.2, -1.0], [0.0, 0.1, 0.2, 0.3]])  # the first segment has three measurements
    read = {0: [[0.0, 0.01, 0.02, 9.0], [0.0, 0.0, 0.0, 0.0]], 2: [[0.0, 0.01, 0.03, 0.0], [0.5, 0.5, 0.51, 0.5]]}
    problem = SimpleNamespace(ts=ts, channels=(pan, tilt), measured=lambda column: np.array(read[column]))
    assert moving(problem, np.array([0])) == [False, False, True]
    assert moving(problem, np.array([1])) == [False, False, False]
    read[0][1][3] = 0.021  # more than ten deviations of a measurement, in one of the segments
    assert moving(problem, np.array([0, 1])) == [True, True, True]


@pytest.fixture(scope="module")
def three():
    """Three logs, of which the last is of another robot: its input has 2.5 times the bias."""
    episodes = [lag_log(1), lag_log(2), lag_log(3, 2.5 * BIAS)]
    whole = fit(Problem(Model(), episodes, [s for r in range(3) for s in spans(r)], LENGTH_S, CONFIG))
    return whole, leave_out(whole, folds_of(whole.problem, 3), 0.2)


def test_recordings_are_left_out_whole_and_one_that_differs_stands_out(three):
    whole, rows = three
    assert [r.name for r in rows] == ["recording 1", "recording 2", "recording 3"]
    assert float(rows[2].values["bias"]) == pytest.approx(BIAS, abs=0.003)
    assert rows[2].ahead["y"] > 20 * NOISE
    assert whole.values["bias"] > BIAS + 0.002


def test_of_many_parts_several_share_a_refit_without_all_of_them(three, monkeypatch):
    whole, _ = three
    monkeypatch.setattr(held_out, "MOST", 2)
    rows = leave_out(whole, folds_of(whole.problem, 3), 0.2)
    assert [r.name for r in rows] == ["recording 1", "recording 2", "recording 3"]
    assert rows[0].values == rows[2].values != rows[1].values
    # The last two rows are of fits without and with the log of the other robot.
    assert float(rows[2].values["bias"]) == pytest.approx(BIAS, abs=0.003)
    assert float(rows[1].values["bias"]) > BIAS + 0.002
    assert rows[2].ahead["y"] > 10 * rows[0].ahead["y"]  # each part has its own error


def test_groups_of_parts_cover_all_of_them_and_few_parts_stay_alone():
    parts = [Fold(f"p{i}", ((i, 0.0, np.inf),)) for i in range(29)]
    groups, of = held_out.shared(parts)
    assert len(groups) == held_out.MOST
    assert all(part.stretches[0] in groups[g].stretches for part, g in zip(parts, of, strict=True))
    assert sum(len(g.stretches) for g in groups) == len(parts)
    groups, of = held_out.shared(parts[: held_out.MOST])
    assert groups == parts[: held_out.MOST]
    assert of.tolist() == list(range(held_out.MOST))


def test_recordings_of_one_name_go_together_and_too_few_are_divided_into_blocks(three):
    whole, _ = three
    found = folds_of(whole.problem, 5, ["slow", "fast", "slow"])
    assert found == [Fold("slow", ((0, 0.0, np.inf), (2, 0.0, np.inf))), Fold("fast", ((1, 0.0, np.inf),))]
    for names, least in ((["a", "b", "c"], 4), (["all", "all", "all"], 2)):
        found = folds_of(whole.problem, 5, names, least)
        assert len(found) == 6  # two of each recording: five at least
        assert [f.stretches[0][0] for f in found] == [0, 0, 1, 1, 2, 2]
        assert all(a.stretches[0][2] == b.stretches[0][1] for a, b in zip(found[::2], found[1::2], strict=True))
    assert found[0].name.startswith("all, 0 to ")


@settings(max_examples=30)
@given(st.integers(8, 40), st.integers(2, 7), st.floats(0.0, 1.0))
def test_blocks_begin_where_segments_may(count, blocks, begin_s):
    """In a world that takes messages at its steps, a regular log's would act at other times there."""
    begun = [Span(0, begin_s + 0.7 * i) for i in range(count)]
    problem = SimpleNamespace(spans=begun, train=np.arange(count), segment_s=0.7)
    found = folds_of(problem, blocks)
    edges = [f.stretches[0][1:] for f in found]
    assert edges[0][0] == begin_s
    assert edges[-1][1] == pytest.approx(begin_s + 0.7 * count)
    inner = np.array([end for _, end in edges[:-1]])
    np.testing.assert_allclose((inner - begin_s) / 0.1, np.round((inner - begin_s) / 0.1), atol=1e-6)
    assert [begin for begin, _ in edges[1:]] == inner.tolist()
    # A segment that ends where a block begins is none of it, whatever the rounding.
    touched = sum(f.touches(begun, 0.7).astype(int) for f in found)
    apart = np.min(np.abs(inner[:, None] - [s.begin_s for s in begun]), axis=1)
    assert touched.sum() == count + np.sum(apart > 1e-6)
