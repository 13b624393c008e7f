"""What later logs say of an identification."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real.artifacts.identification import (
    ComparedError,
    Estimate,
    ExpectedError,
    Identification,
    Internal,
    Judgement,
)
from sim2real.artifacts.posterior import Posterior
from sim2real.artifacts.recording import Recording
from sim2real.errors import UsageError
from sim2real.log import read_log
from sim2real.stages.load import load_robot
from sim2real.stages.shared.arguments import open_recording
from sim2real.stages.shared.identification import identified_robot, usable
from sim2real.stages.validate import stage
from sim2real.stages.validate.config import ValidateConfig
from sim2real.stages.validate.stage import Validation

ROOT = Path(__file__).parents[2]
LOGS = [ROOT / "datasets" / "pendulum" / f"{name}.mcap" for name in ("chirp", "multisine")]


def error(log="b.mcap", size=0.004, expected=0.02, free_run=False, **changes):
    row = ComparedError(log, "elbow", "rad", 8.0, size, free_run, expected, baselines={"standing still": 0.2})
    return replace(row, **changes)


@pytest.mark.parametrize(
    ("rows", "changes", "holds", "named"),
    [
        ([error()], {}, True, "this log"),
        ([error(), error("c.mcap")], {}, True, "2 logs"),
        ([error(size=0.0199)], {}, True, "this log"),
        ([error(size=0.031)], {}, False, "1.55"),
        ([error(size=None)], {}, False, "diverges"),
        ([error()] * 99 + [error("bad.mcap", 0.031, free_run=True)], {}, False, "bad.mcap"),
        ([error(as_good=("standing still",))], {}, False, "standing still"),
        ([error()], {"refused": {"a.mcap": "it lasts 0.1 s"}}, False, "a.mcap"),
        ([error(expected=None)], {}, True, "names no expected error"),
    ],
)
def test_an_error_above_the_expected_one_is_named_and_fails(rows, changes, holds, named, monkeypatch, capsys):
    found = Validation("arm", 8.0, tuple(sorted(rows, key=lambda e: -(e.ratio or 0.0))), **changes)
    assert found.holds == holds
    assert named in found.verdict
    monkeypatch.setattr(stage.Identification, "load", lambda path: Identification("arm", (), Judgement("", ()), ()))
    monkeypatch.setattr(stage, "find_parameters", lambda source, runs: Path(source) / "parameters.json")
    monkeypatch.setattr(stage, "load_robot", lambda name: load_robot("arm"))
    monkeypatch.setattr(stage, "open_recording", lambda *given: None)
    monkeypatch.setattr(stage, "score", lambda *given: found)
    for as_json in (False, True):
        assert stage.run(ValidateConfig("run", ("b.mcap",), json=as_json)) == holds
    out, err = capsys.readouterr()
    verdict, following, *_ = err.splitlines()
    assert verdict == f"verdict: {found.verdict}"
    assert ("sim2real identify arm --log b.mcap" in following) == bool(found.exceeded or found.beaten)
    assert ("sim2real train arm" in following) == holds
    document = json.loads(out[out.index("{") :])
    assert document["holds"] == holds
    ratio = document["errors"][0]["ratio"]
    assert ratio == (found.errors[0].ratio if found.errors[0].error else None)


def identification(upper_s=0.06, world=None, expected=1.0, horizon_s=1.0):
    """The pendulum at the values of its data sheet, with an expected error of its angle."""
    pipeline = load_robot("pendulum")
    parameters = tuple(
        Estimate(p.name, p.unit, p.kind, "", p.nominal, p.nominal, "accepted", lower=p.low,
                 upper=2 * upper_s if p.name == "actuator_delay" else p.high)
        for p in pipeline.identifiable(0.06).parameters
    )  # fmt: skip
    error = (ExpectedError("hinge", "rad", horizon_s, expected),)
    return pipeline, Identification(
        "pendulum",
        (),
        Judgement("accepted", ()),
        parameters,
        expected_error=error,
        internal=Internal(settle_s=0.3, world=world),
    )


def test_an_identification_is_scored_in_its_world_and_with_its_delays():
    pipeline, found = identification(upper_s=0.2)
    assert identified_robot(found, pipeline)[1].max_delay_s == 0.2
    assert identified_robot(identification()[1], pipeline)[1].max_delay_s == pipeline.defaults.identify.max_delay_s
    with pytest.raises(UsageError, match="nowhere"):
        identified_robot(identification(world="nowhere")[1], pipeline)


def test_each_log_is_scored_alone_and_a_bad_one_does_not_stop_the_others():
    pipeline, found = identification(expected=1e-6)
    good, short = (open_recording(path, pipeline) for path in LOGS)
    lacking = Recording(Path("lacking.mcap"), replace(short.episode, steps={}, outputs={}))
    found = replace(
        found, expected_error=(*found.expected_error, ExpectedError("hinge", "rad", 2.0, 1.0, free_run=True))
    )
    scored = stage.score(found, pipeline, [good, lacking, short], {"unreadable.csv": "no columns"})
    assert set(scored.refused) == {"lacking.mcap", "unreadable.csv"}
    ahead = {e.log: e for e in scored.errors if not e.free_run}
    assert set(ahead) == {good.path.name, short.path.name}
    assert all(e.ratio == pytest.approx(e.error / 1e-6) for e in ahead.values())
    assert {e.seconds for e in scored.errors if e.free_run} == {2.0}
    assert not scored.holds
    (alone,) = [e for e in stage.score(found, pipeline, [good]).errors if not e.free_run]
    assert alone.error == pytest.approx(ahead[good.path.name].error, rel=0.02)  # programs of other sizes
    with pytest.raises(UsageError, match="lacking"):
        stage.score(found, pipeline, [lacking])


def test_a_short_log_has_a_shorter_free_run_and_one_that_is_too_short_is_refused():
    pipeline, found = identification()
    free = ExpectedError("hinge", "rad", 9.0, 1.0, free_run=True)
    found = replace(found, expected_error=(*found.expected_error, free))
    short, shorter = (Recording(Path(f"{s} s"), read_log(LOGS[0], 0.0, s)) for s in (3.0, 0.6))
    begin, end = usable(short.episode, identified_robot(found, pipeline)[1])
    scored = stage.score(found, pipeline, [short, shorter])
    assert [e.seconds for e in scored.errors if e.free_run] == [pytest.approx(end - begin - 0.3)]
    assert 2.0 < end - begin - 0.3 < 2.7
    assert set(scored.refused) == {"0.6 s"}


@pytest.mark.parametrize(("deviation", "unsteady"), [(0.5, {"chirp.mcap": ["hinge"]}), (1e-6, {})])
def test_a_free_run_that_parameters_within_their_uncertainty_carry_away_is_no_test(deviation, unsteady):
    """A good model of a pendulum was 135 times worse than expected in a free run of its swing-up."""
    pipeline, found = identification()
    gain = next(p for p in found.parameters if p.name == "gain")
    low, middle, high = (np.log([value]) for value in (gain.lower, gain.estimate, gain.upper))
    found = replace(
        found,
        expected_error=(*found.expected_error, ExpectedError("hinge", "rad", 2.0, 0.05, free_run=True)),
        posterior=Posterior(("gain",), ("log",), middle, np.array([[deviation**2]]), low, high),
    )
    scored = stage.score(found, pipeline, [open_recording(LOGS[0], pipeline)])
    assert scored.unsteady == unsteady
    assert any(e.free_run for e in scored.errors) == (not unsteady)
