"""Bounds that follow the size of a log's motion, on simulated recordings whose kinds are predicted unlike well."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_promises import ANGLE, columns, document, left

from sim2real.artifacts.identification import AHEAD, Bound, Growth, Identification
from sim2real.identify.model import Channel
from sim2real.identify.problem.segments import Span
from sim2real.stages.estimation import growth, predicted_logs, promises
from sim2real.stages.identify import ledger
from sim2real.stages.identify.inputs import Inputs


def rig(rng, count):
    """Errors of a rig, and the sizes of the motions: errors grow with the goal's steps, and not with the speed."""
    steps = np.where(rng.random(count) < 0.3, rng.uniform(0.3, 1.5, count), rng.uniform(0.01, 0.05, count))
    errors = 0.2 * steps**0.8 * np.exp(0.2 * rng.normal(size=count))
    return errors, [{"largest step": float(s), "largest speed": float(rng.uniform(1.0, 3.0))} for s in steps]


def with_bounds(errors, sizes, ends=(), of_ends=()):
    """The document of recordings held out one at a time, and of further ones that are held out whole."""
    names = [f"log {i}" for i in range(len(errors))]
    later = [f"later {i}" for i in range(len(ends))]
    doc = document([left(n, float(e)) for n, e in zip(names, errors, strict=True)], [1e-3] * len(names) + list(ends))
    motions = {n: {"th": s} for n, s in zip(names, sizes, strict=True)}
    own = [{"th": s} for s in [*sizes, *of_ends]]
    recordings = predicted_logs.predicted([*names, *later], len(names), doc.left_out, [{}] * len(own), own)
    growths = promises.growths_of(doc.left_out, [ANGLE], motions)
    doc = replace(doc, promises=promises.ledger(doc, doc.left_out, [ANGLE], recordings, motions, growths))
    return replace(doc, bounds=promises.bounds(doc, recordings, False, growths))


def test_the_size_with_which_errors_grow_is_found_with_its_power():
    rng = np.random.default_rng(0)
    found = growth.growth(*rig(rng, 60))
    assert found.size == "largest step"
    assert found.power == pytest.approx(0.8, abs=0.1)
    errors, sizes = rig(rng, 60)
    assert growth.growth(rng.permutation(errors), sizes) is None
    assert growth.growth(errors[:12], sizes[:12]).size == "largest step"
    assert growth.growth(errors[:11], sizes[:11]) is None
    assert growth.growth(1.0 / errors, sizes) is None, "errors that fall with the motion are of another cause"
    assert growth.growth(errors, [{"largest step": 0.0}] * 60) is None


def test_each_log_has_a_bound_of_its_own_that_holds_and_is_not_vacuous():
    """Without growth the bound is 20 times the error of half of the logs."""
    rng, kept, over, wide, plain = np.random.default_rng(1), [], [], [], []
    for _ in range(12):
        errors, sizes = rig(rng, 60)
        ends, of_ends = rig(rng, 20)
        doc = with_bounds(errors, sizes, ends, of_ends)
        rows = [r for r in doc.promises if r.source.startswith("later")]
        kept += [r.ratio < 1.0 for r in rows]
        over += [r.broken for r in rows]
        wide += [r.bound / r.error for r in rows]
        plain += [promises.further(errors) / r.error for r in rows]
    assert 0.9 < np.mean(kept) < 0.99
    assert np.mean(over) < 0.02
    assert np.median(wide) < 2.0
    assert np.median(plain) > 10.0


def test_twelve_recordings_of_one_kind_seldom_have_a_growth_by_chance():
    rng, count = np.random.default_rng(5), 0
    for _ in range(200):
        sizes = [{f"size {i}": float(s) for i, s in enumerate(np.exp(0.8 * rng.normal(size=7)))} for _ in range(12)]
        count += growth.growth(0.01 * np.exp(0.5 * rng.normal(size=12)), sizes) is not None
    assert count < 14


def test_a_later_log_is_beside_the_bound_for_its_motion():
    doc = with_bounds(*rig(np.random.default_rng(2), 40))
    limits = promises.of(doc)
    bound = limits["th", AHEAD]
    small, large = ({"th": {"largest step": step}} for step in (0.02, 1.2))
    logs = [predicted_logs.Predicted("a", True, {"th": 1.0}, small), predicted_logs.Predicted("b", True, {}, large)]
    later = replace(doc, samples=columns([0.001, 0.02]), free={})
    a, b = promises.on_later_logs(later, [ANGLE], logs, limits)
    assert b.bound / a.bound == pytest.approx(60.0**bound.growth.power, rel=1e-6)
    assert b.bound / b.stretch == pytest.approx(bound.growth.bound)
    assert a.bound < bound.bound < b.bound
    assert "times the usual bound, for its motion" in b.sentence()
    # Without its sizes, as for a log without goals, the bound is the one for any motion.
    (plain,) = promises.on_later_logs(
        replace(doc, samples=columns([0.01]), free={}), [ANGLE], [predicted_logs.Predicted("c", True)], limits
    )
    assert plain.bound == pytest.approx(bound.bound)
    sentence = promises.sentences(doc, [ANGLE])[0]
    assert "where the largest step is the usual" in sentence
    assert "in proportion to its power 0.8" in sentence or "in proportion to its power 0.7" in sentence


def test_beyond_the_recordings_motions_the_bound_goes_on_growing_and_below_them_it_stays():
    g = Growth("largest step", 0.5, usual=1.0, low=0.25, high=4.0, bound=0.01)
    assert [g.factor({"largest step": s}, 1.0) for s in (0.01, 0.25, 1.0, 4.0, 16.0)] == [0.5, 0.5, 1.0, 2.0, 4.0]
    # A faster motion than any: the larger of the two factors, not their product.
    assert g.factor({"largest step": 16.0}, 3.0) == pytest.approx(6.0)
    assert g.factor({"largest step": 1.0}, 3.0) == pytest.approx(3.0)
    assert g.factor({}, 1.0) == pytest.approx(2.0)
    assert Bound("th", "tilt", "rad", AHEAD, 1.0, 0.05, "").on({"largest step": 9.0}, 2.0) == (0.1, 2.0)


def test_the_growth_is_written_and_read(tmp_path):
    doc = replace(with_bounds(*rig(np.random.default_rng(3), 30)), samples={}, free={})
    doc.save(tmp_path)
    assert Identification.load(tmp_path).bounds == doc.bounds
    assert isinstance(doc.bounds[0].growth, Growth)


def swing_log(step, seconds=8.0):
    """A joint that follows a goal of steps of a size, 100 readings a second."""
    t = np.arange(0.0, seconds, 0.01)
    goal = step * np.sign(np.sin(2.0 * np.pi * 0.5 * t))
    return SimpleNamespace(
        steps={"sensor": SimpleNamespace(begun_s=t), "actuator": SimpleNamespace(begun_s=t + 0.002)},
        outputs={"sensor": {"th": goal}, "actuator": {"goal": goal}},
    )


def test_an_identification_of_many_logs_has_their_growth_in_its_bounds(monkeypatch):
    """Parts, fitted logs and held-out ends have names of their own, under which their motions are found."""
    rng = np.random.default_rng(4)
    steps = rng.uniform(0.05, 1.5, 30)
    errors = 0.1 * steps**0.7 * np.exp(0.1 * rng.normal(size=30))
    logs = [SimpleNamespace(path=Path(f"{i:03d}.csv"), episode=swing_log(s)) for i, s in enumerate(steps)]
    channel = Channel("th", None, 1e-3, 1.0, goal="goal")
    model = SimpleNamespace(channels=[channel], sensor="sensor", given={"actuator": "goal"})
    windows = [Span(r, begin, begin < 5.0) for r in range(30) for begin in (0.0, 2.0, 4.0, 6.0)]
    rows = {"logs": logs, "fitted": 30, "model": model, "units": {}, "windows": windows}
    inputs = SimpleNamespace(**rows, episodes=[log.episode for log in logs])
    inputs.names = Inputs.names.fget(inputs)
    parts = [left(n, float(e)) for n, e in zip(inputs.names, errors, strict=True)]
    doc = document(parts, [0.1 * s**0.7 for s in steps])
    monkeypatch.setattr(ledger, "positions", lambda *_: [ANGLE])
    fit = SimpleNamespace(windows=SimpleNamespace(segment_s=2.0))
    doc, _ = ledger.with_promises(doc, inputs, fit, parts)
    (bound,) = doc.bounds
    assert bound.growth.power == pytest.approx(0.7, abs=0.1)
    ratios = [r.ratio for r in doc.promises if r.fresh]
    assert len(ratios) == 30
    assert 0.6 < np.mean(ratios) < 1.0


def test_the_sizes_of_a_motion_are_those_of_its_segments():
    t = np.arange(0.0, 4.0, 0.01)
    q = np.stack([np.zeros_like(t), 0.5 * np.sin(2.0 * np.pi * t)], axis=1)
    goal = np.stack([np.zeros_like(t), np.where(t < 3.0, 0.2, 0.9)], axis=1)
    log = SimpleNamespace(
        steps={"sensor": SimpleNamespace(begun_s=t), "actuator": SimpleNamespace(begun_s=t + 0.002)},
        outputs={"sensor": {"q": q}, "actuator": {"goal": goal}},
    )
    channels = [Channel("q", None, 1e-3, 1.0, i, goal="goal") for i in (0, 1)]
    model = SimpleNamespace(channels=channels, sensor="sensor", given={"actuator": "goal"})
    found = growth.sizes(model, [log], [Span(0, 0.5), Span(0, 1.5)], 1.0)
    swing = found["q[1]"]
    assert swing["range"] == pytest.approx(1.0, abs=0.01)
    assert swing["largest speed"] == pytest.approx(np.pi, rel=0.05)
    assert swing["mean speed"] == pytest.approx(np.pi / np.sqrt(2.0), rel=0.05)
    assert swing["largest step"] == 0.0
    assert swing["largest lag"] == pytest.approx(0.7, abs=0.01)
    assert swing["mean lag"] == pytest.approx(np.sqrt(0.04 + 0.125), rel=0.02)
    assert growth.sizes(model, [log], [Span(0, 2.5)], 1.0)["q[1]"]["largest step"] == pytest.approx(0.7)
    assert found["q[0]"]["range"] == 0.0
    # A log of voltages has no goals, and none of their sizes.
    free = SimpleNamespace(channels=[replace(c, goal=None) for c in channels], sensor="sensor", given={})
    assert set(growth.sizes(free, [log], [Span(0, 0.5)], 1.0)["q[1]"]) == {"range", "largest speed", "mean speed"}
    assert growth.sizes(free, [log], [Span(0, 99.0)], 1.0) == {}
