"""``sim2real compare``: runs side by side, and which parameters differ beyond chance."""

import json
from dataclasses import replace

import numpy as np
import pytest

from sim2real import cli
from sim2real.artifacts.comparison import LEVEL, ComparedRun, Comparison
from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.errors import USAGE, UsageError
from sim2real.stages.compare.config import CompareConfig


def identification(values, errors, unit="1"):
    rows = [
        Estimate(f"p{i}", unit, "dynamics", "", 1.0, v, "accepted", e, v - 1.96 * e, v + 1.96 * e)
        for i, (v, e) in enumerate(zip(values, errors, strict=True))
    ]
    return Identification("pendulum", (), Judgement("accepted", ()), tuple(rows))


def comparison(*identifications):
    return Comparison.of([ComparedRun(f"run {i}", "", found) for i, found in enumerate(identifications)])


def test_an_unchanged_robot_is_rarely_called_changed():
    """500 comparisons of three runs with twelve parameters: any alarm is one too many at the rate LEVEL."""
    rng = np.random.default_rng(0)
    errors = rng.uniform(0.01, 1.0, (500, 3, 12))
    alarms = sum(bool(comparison(*(identification(rng.normal(1.0, e), e) for e in own)).different) for own in errors)
    assert 0 < alarms < 500 * (LEVEL + 3 * np.sqrt(LEVEL / 500))


def test_a_changed_parameter_is_named_alone():
    rng = np.random.default_rng(1)
    errors = np.full(6, 0.1)
    first, second = rng.normal(1.0, 0.1, (2, 6))
    second[4] += 1.0
    assert comparison(identification(first, errors), identification(second, errors)).different == ("p4",)


def test_two_runs_agree_with_the_test_of_a_difference():
    """For two runs Cochran's Q is the square of the difference in standard errors."""
    from scipy.stats import norm

    (p,) = comparison(identification([1.0], [0.3]), identification([2.0], [0.4])).parameters
    assert p.p_value == pytest.approx(2 * norm.sf(1.0 / 0.5))


def test_parameters_that_cannot_be_tested_are_shown_without_a_test():
    fixed = identification([1.0, 3.0], [0.1, 0.1])
    fixed = replace(fixed, parameters=(fixed.parameters[0], replace(fixed.parameters[1], standard_error=None)))
    other_unit = identification([5.0], [0.1], "rad")
    found = comparison(fixed, identification([1.0, 3.5], [0.1, 0.1]), other_unit)
    assert [p.name for p in found.parameters] == ["p0", "p1"]
    assert found.parameters[1].p_value is None
    assert found.rows().rows[1] == ["p1", "1", "3", "3.5 ± 0.2", "-", "not tested"]


def test_runs_are_compared_from_the_command_line(finished_run_dir, run_copy, tmp_path, capsys):
    file = run_copy / "identify" / "parameters.json"
    document = json.loads(file.read_text())
    (gain,) = (p for p in document["parameters"] if p["name"] == "gain")
    gain["estimate"] += 20 * gain["standard_error"]
    file.write_text(json.dumps(document))
    page = tmp_path / "page.html"
    arguments = ["compare", str(finished_run_dir), str(run_copy / "identify"), "--out", str(page), "--json"]
    assert cli.main(arguments) == 0
    found = json.loads(capsys.readouterr().out)
    verdicts = {row["parameter"]: row["differs beyond chance"] for row in found["parameters"]}
    assert {name for name, verdict in verdicts.items() if verdict.startswith("yes")} == {"gain"}
    names = {row["figure"] for row in found["figures"]}
    assert {"started", "identification", "deployment", "episodes"} <= names
    assert "different beyond chance: gain" in page.read_text(encoding="utf-8")


def test_one_run_is_refused(finished_run_dir, capsys):
    assert cli.main(["compare", str(finished_run_dir)]) == USAGE
    assert "compare needs at least two runs, got 1" in capsys.readouterr().err
    with pytest.raises(UsageError):
        _ = CompareConfig().targets
