"""The ledger of promises: against scipy's distributions and simulated parts, not against itself."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from sim2real.artifacts.identification import (
    AHEAD,
    FREE_RUN,
    Bound,
    HeldOut,
    HeldOutPart,
    Identification,
    Judgement,
    Promise,
    too_many_broken,
)
from sim2real.identify.validation.verdict import Position
from sim2real.stages.estimation import estimate, predicted_logs, promises
from sim2real.stages.estimation.free_run import Lack
from sim2real.stages.identify.show import show
from sim2real.view.identification.section import _promises

ANGLE = Position("th", "tilt", "rad", 0.001)


def left(name, ahead=0.1, **more):
    return HeldOutPart(name, (), {"gain": 1.0}, {"gain": 0.2}, {"th": ahead}, **more)


def columns(errors, seconds=4.0, swing=1.0):
    """Columns of held-out data: recording r is off by ``errors[r]`` after the first 0.5 s."""
    into = np.tile(np.arange(0.0, seconds, 0.1), len(errors))
    recording = np.repeat(np.arange(len(errors)), len(into) // len(errors))
    measured = swing * np.sin(3.0 * into)
    off = np.where(into > 0.5, np.array(errors)[recording], 9.0)  # the first part fits the state, and does not count
    common = {"into": into, "recording": recording, "held_out": np.ones(len(into), bool)}
    return {**common, "th_measured": measured, "th_identified": measured + off}


def document(parts, ahead, free=(), **more):
    free_columns = columns(free) if free else {}
    sizes = {"sigma": {"th": 0.001}, "settle_s": 0.5, "samples": columns(ahead), "free": free_columns, "units": {}}
    return Identification("robot", (), Judgement("", ()), (), left_out=tuple(parts), **sizes, **more)


def with_ledger(doc, names, fitted):
    recordings = predicted_logs.predicted(names, fitted, doc.left_out)
    doc = replace(doc, promises=promises.ledger(doc, doc.left_out, [ANGLE], recordings))
    return replace(doc, bounds=promises.bounds(doc, recordings, predicted_logs.in_blocks(names[:fitted], doc.left_out)))


@pytest.mark.parametrize("parts", [2, 3, 5, 8])
def test_a_further_part_stays_below_its_bound_as_often_as_promised(parts):
    """The logarithm's deviation varies between rigs as the prior assumes: a scaled inverse chi-square of 4 parts."""
    rng = np.random.default_rng(parts)
    deviation = 0.3 * np.sqrt(4.0 / rng.chisquare(4.0, (8000, 1)))
    logs = -3.0 + deviation * rng.normal(size=(8000, parts + 1))
    kept = [np.exp(row[-1]) < promises.further(np.exp(row[:-1])) for row in logs]
    low, high = stats.binom.interval(0.999, len(kept), 0.95)
    assert low <= sum(kept) <= high


def test_of_many_errors_of_two_kinds_one_in_twenty_is_above_its_bound():
    """Steps are predicted ten times worse than sines: a log-normal bound was exceeded by 12 of 100 errors."""
    rng = np.random.default_rng(0)
    for count in (40, 200):
        kept = []
        for _ in range(1000):
            steps = rng.random(count + 1) < 0.2
            errors = np.where(steps, 0.03, 0.001) * np.exp(0.1 * rng.normal(size=count + 1))
            kept.append(errors[-1] < promises.further(errors[:-1]))
        assert 0.93 < np.mean(kept) < 0.99


def test_of_twenty_promises_alike_one_may_be_broken():
    def rows(broken, kept, **changes):
        made = [Promise(str(i), True, "th", "tilt", "rad", AHEAD, 1.0, 0.02, 0.01) for i in range(broken)]
        made += [Promise(str(i), True, "th", "tilt", "rad", AHEAD, 1.0, 0.01, 0.01) for i in range(kept)]
        return [replace(row, **changes) for row in made]

    assert too_many_broken(rows(1, 18))
    assert not too_many_broken(rows(1, 19))
    assert too_many_broken(rows(3, 38))
    assert not too_many_broken(rows(19, 0, fresh=False))
    assert too_many_broken([*rows(0, 100), *rows(1, 0, column="other")])
    (sentence,) = promises.broken_sentences(rows(2, 38))
    assert sentence.startswith("2 of 40 promises are broken, no more than one in twenty; a promise is broken: tilt")
    assert len(promises.broken_sentences(rows(5, 38))) == 4


def test_few_parts_that_differ_by_chance_promise_no_vacuous_bound():
    apart = np.array([0.008, 0.075])
    student = np.exp(np.log(apart).mean() + stats.t.ppf(0.95, 1) * np.log(apart).std(ddof=1) * np.sqrt(1.5))
    assert student > 1.0  # the promise of 0.93 rad on a rig whose errors were 8 to 75 mrad was such a one
    assert promises.further(apart) < 3.5 * 0.075


def test_what_comes_after_the_fitted_data_moves_the_bound_only_upwards():
    alike = np.array([0.012, 0.014, 0.012, 0.015, 0.013])
    worse, better = (promises.further(alike, np.array([e])) for e in (0.025, 0.005))
    assert worse > 0.025 * 1.3
    assert better > 0.014


def test_each_part_stands_beside_the_bound_from_the_others_and_the_end_beside_that_of_all():
    errors = [0.010, 0.012, 0.011]
    doc = with_ledger(document([left(n, e) for n, e in zip("abc", errors, strict=True)], [0.02]), ["log"], 1)
    rows = {r.source: r for r in doc.promises}
    assert list(rows) == ["a", "b", "c", "the held-out end"]
    assert rows["b"].error == 0.012
    assert rows["b"].bound == pytest.approx(promises.further(np.array([0.010, 0.011])))
    end = rows["the held-out end"]
    assert (end.fresh, end.error, end.seconds) == (True, pytest.approx(0.02), pytest.approx(3.4))
    assert end.bound == pytest.approx(promises.further(np.array(errors)))
    assert not any(r.fresh for n, r in rows.items() if n in "abc")


def test_a_broken_promise_about_the_end_is_named_and_the_bound_begins_there():
    doc = with_ledger(document([left(n, 0.01) for n in "abcde"], [0.04]), ["log"], 1)
    assert [r.source for r in promises.broken(doc.promises)] == ["the held-out end"]
    sentence = promises.broken_sentences(doc.promises)[0]
    assert "tilt is off by 0.04 rad up to 3.4 s ahead on the held-out end; promised was 0.0" in sentence
    assert doc.bounds[0].bound > 0.04
    assert doc.bounds[0].scope == "this recording"
    assert "95 % of later parts of this recording stay below 0." in promises.sentences(doc, [ANGLE])[0]


def test_ends_of_several_fitted_recordings_widen_no_bound_but_a_recording_held_out_whole_does():
    parts = [left(f"log {i}", 0.01) for i in range(4)]
    names = ["a", "b", "c", "d"]
    doc = with_ledger(document(parts, [0.001, 0.001, 0.001, 0.04]), names, 4)
    assert doc.bounds[0].bound == pytest.approx(promises.further(np.full(4, 0.01)))
    assert doc.bounds[0].scope == "recordings like these"
    with_whole = with_ledger(document(parts, [0.001] * 4 + [0.04]), [*names, "later.mcap"], 4)
    assert with_whole.bounds[0].bound > 0.04
    assert promises.broken(with_whole.promises)[0].source == "later.mcap"


def test_free_runs_have_bounds_of_their_own():
    parts = [left(n, 0.01, free={"th": 0.03}) for n in "abc"]
    doc = with_ledger(document(parts, [0.01], free=[0.03]), ["log"], 1)
    by_reach = {b.reach: b.bound for b in doc.bounds}
    assert by_reach[FREE_RUN] == pytest.approx(3 * by_reach[AHEAD])


def test_a_joint_that_rests_has_no_error_and_errors_below_the_noise_break_nothing():
    resting = document([left(n, None) for n in "abc"], [0.01])
    resting = replace(resting, samples=columns([0.01], swing=1e-5))
    assert with_ledger(resting, ["log"], 1).promises == ()
    exact = with_ledger(document([left(n, 1e-6) for n in "abc"], [0.0019]), ["log"], 1)
    assert promises.broken(exact.promises) == []


def test_a_diverged_prediction_breaks_its_promise():
    doc = document([left(n, 0.01) for n in "abc"], [np.nan])
    (row,) = promises.broken(with_ledger(doc, ["log"], 1).promises)
    assert row.error is None
    assert "diverges" in row.sentence()


def test_without_parts_the_held_out_end_alone_gives_a_bound():
    doc = with_ledger(document([], [0.01]), ["log"], 1)
    assert [r.bound for r in doc.promises] == [None]
    assert 0.015 < doc.bounds[0].bound < 0.04


def test_a_file_of_before_has_the_bounds_of_its_held_out_parts():
    score = HeldOut("tilt", "th", "rad", 0.5, {"identified": 0.01})
    old = replace(document([left(n, e) for n, e in zip("ab", (0.1, 0.2), strict=True)], [0.01]), held_out=(score,))
    bound = promises.of(old)["th", AHEAD]
    assert bound.bound == pytest.approx(promises.further(np.array([0.1, 0.2])))
    assert promises.of(replace(old, left_out=())) == {}


def test_the_ledger_is_written_and_read(tmp_path):
    doc = replace(with_ledger(document([left(n, 0.01) for n in "abc"], [0.04]), ["log"], 1), free={}, samples={})
    doc.save(tmp_path)
    back = Identification.load(tmp_path)
    assert (back.promises, back.bounds) == (doc.promises, doc.bounds)
    assert isinstance(back.promises[0], Promise)
    assert isinstance(back.bounds[0], Bound)
    rows = back.promises_table().records()
    assert [rows[0][name] for name in ("predicted", "shown", "kept")] == ["the held-out end", pytest.approx(0.04), "no"]
    assert rows[0]["promised"] == pytest.approx(promises.further(np.full(3, 0.01)))
    assert {row["kept"] for row in rows[1:]} == {"yes"}


def test_console_and_page_show_the_ledger_with_ratio_and_what_became_of_the_promise(capsys):
    parts = [left("a", 0.01), left("b", 0.01), left("c", 0.022)]
    doc = replace(with_ledger(document(parts, [0.05]), ["log"], 1), samples={}, free={})
    show(doc)
    end, *_ = (line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("tilt"))
    bound = promises.further(np.array([0.01, 0.01, 0.022]))
    assert end[-5:] == [f"{bound:.4g}", "0.05", "rad", f"{0.05 / bound:.2f}", "no"]
    (table,) = _promises(doc)
    assert table.columns[3:] == ["promised", "shown", "unit", "ratio", "kept"]
    assert [(row[1], row[-1], tone) for row, tone in zip(table.rows, table.tones, strict=True)] == [
        ("the held-out end", "no", "bad"), ("c", "within 1.25", "doubt"), ("a", "yes", "good"), ("b", "yes", "good"),
    ]  # fmt: skip


SLOW = {"'th' of 'sensor'": (-1.0, 1.0), "the speed of 'th' of 'sensor'": (-2.0, 3.0)}


@pytest.mark.parametrize(
    ("position", "speed", "factor"),
    [
        ((-0.5, 0.5), (-1.0, 1.0), 1.0),
        ((-1.0, 1.0), (-6.0, 3.0), 2.0),
        ((-1.5, 1.5), (-3.0, 3.0), 1.5),
        ((-1.0, 2.0), (-3.0, 6.0), 3.0),
        ((-1.0, 1.0), (-99.0, 99.0), 10.0),
    ],
)
def test_the_bound_is_wider_for_a_motion_that_is_faster_or_reaches_further(position, speed, factor):
    later = {"'th' of 'sensor'": position, "the speed of 'th' of 'sensor'": speed}
    assert predicted_logs.stretches(SLOW, later, [ANGLE]) == {"th": pytest.approx(factor)}


def test_a_joint_beyond_its_range_widens_the_bounds_of_the_others_and_whole_turns_widen_none():
    two = {**SLOW, "'x' of 'sensor'": (0.0, 1.0), "the speed of 'x' of 'sensor'": (0.0, 1.0)}
    far = {**two, "'x' of 'sensor'": (0.0, 2.0)}
    place = Position("x", "place", "m", 0.001)
    assert predicted_logs.stretches(two, far, [ANGLE, place]) == {"th": 2.0, "x": 2.0}
    turning, more = ({**SLOW, "'th' of 'sensor'": (0.0, turns * 7.0)} for turns in (1.0, 5.0))
    assert predicted_logs.stretches(turning, more, [ANGLE]) == {"th": 1.0}
    over = {**SLOW, "'th' of 'sensor'": (-1.0, 20.0)}  # three turns reach no more than one
    assert predicted_logs.stretches(SLOW, over, [ANGLE]) == {"th": pytest.approx(1.0 + (2 * np.pi - 2.0) / 2.0)}
    assert predicted_logs.stretches({}, SLOW, [ANGLE]) == {"th": 1.0}  # a file of before


def test_the_error_of_a_faster_end_is_taken_per_motion():
    parts = [left(n, 0.01) for n in "abcde"]
    doc = document(parts, [0.03])
    faster = predicted_logs.predicted(["log"], 1, doc.left_out, [{"th": 3.0}])
    doc = replace(doc, promises=promises.ledger(doc, doc.left_out, [ANGLE], faster))
    end = doc.promises[-1]
    assert end.bound == pytest.approx(3.0 * promises.further(np.full(5, 0.01)))
    assert not promises.broken(doc.promises)
    (bound,) = promises.bounds(doc, faster, True)
    assert bound.bound == pytest.approx(promises.further(np.full(5, 0.01), np.array([0.01])))
    # A deployment moves as the held-out end did: its bound is that of the end, not that of the slower parts.
    doc = replace(doc, bounds=(bound,), held_out=(HeldOut("tilt", "th", "rad", 1.0, {"identified": 0.03}),))
    assert promises.room(doc, "th") == pytest.approx(3.0 * bound.bound / 0.03)


@pytest.mark.parametrize(
    ("before", "end", "status"),
    [("accepted", 0.04, "promise broken"), ("accepted", 0.012, "accepted"), ("hit a bound", 0.04, "hit a bound")],
)
def test_a_broken_promise_is_the_verdict_where_nothing_worse_is(before, end, status, monkeypatch):
    doc = with_ledger(document([left(n, 0.01) for n in "abcde"], [end]), ["log"], 1)
    monkeypatch.setattr(estimate, "judge", lambda *_, **__: Judgement(before, ("a reason",)))
    monkeypatch.setattr(estimate, "positions", lambda *_: [ANGLE])
    monkeypatch.setattr(estimate, "scores", lambda *_: [])
    monkeypatch.setattr(estimate, "worst_second", lambda *_: None)
    fit = SimpleNamespace(problem=SimpleNamespace(model=None, table=None), converged=True)
    findings = SimpleNamespace(fit=fit, x=None, spread=None, check=None, trip=None)
    verdict = estimate.judged(doc, findings, {}, 0.1, [], Lack()).verdict
    assert verdict.status == status
    assert verdict.reasons[0].startswith("a promise is broken: tilt") == (status == "promise broken")
    assert any(r.startswith("a promise is broken: tilt") for r in verdict.reasons) == (end == 0.04)
    assert any("95 % of later parts" in r or "record more" in r for r in verdict.reasons)


def test_the_bound_of_a_free_run_is_wider_where_drawn_trajectories_part():
    names, p = [predicted_logs.Predicted("a.mcap", True), predicted_logs.Predicted("b.mcap", True)], ANGLE
    limit = {("th", FREE_RUN): Bound("th", "tilt", "rad", FREE_RUN, 3.0, 0.03, "recordings like these")}
    doc = document([], [0.01], free=[0.01, 0.01])
    spread = np.where(doc.free["recording"] == 1, 0.04, 0.0)
    plain, apart = promises.on_later_logs(replace(doc, free={**doc.free, "th_spread": spread}), [p], names, limit)[1:]
    assert (plain.source, plain.bound) == ("a.mcap", pytest.approx(0.03))
    assert (apart.source, apart.bound) == ("b.mcap", pytest.approx(0.05))


def test_where_a_part_diverged_no_bound_is_promised():
    parts = [left("a", 0.01), left("b", 0.01), left("c", float("nan"))]
    doc = with_ledger(document(parts, [0.01]), ["log"], 1)
    assert doc.bounds == ()
    assert promises.of(doc) == {}
