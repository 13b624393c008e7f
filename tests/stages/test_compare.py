"""``sim2real report`` of several runs: runs side by side, and the parameters whose intervals do not overlap."""

import json
from dataclasses import replace

import pytest

from sim2real import cli
from sim2real.artifacts.comparison import ComparedRun, Comparison, overlap
from sim2real.artifacts.identification import Estimate, Identification, Judgement
from sim2real.errors import USAGE


def identification(values, errors, unit="1"):
    rows = [
        Estimate(f"p{i}", unit, "dynamics", "", 1.0, v, "accepted", e, v - 1.96 * e, v + 1.96 * e)
        for i, (v, e) in enumerate(zip(values, errors, strict=True))
    ]
    return Identification("pendulum", (), Judgement("accepted", ()), tuple(rows))


def comparison(*identifications):
    return Comparison(tuple(ComparedRun(f"run {i}", "", found) for i, found in enumerate(identifications)))


def test_parameters_whose_intervals_do_not_overlap_are_named():
    first, second = identification([1.0, 2.0, 3.0], [0.1] * 3), identification([1.3, 2.5, 3.0], [0.1] * 3)
    found = comparison(first, second)
    assert found.different == ("p1",)
    assert [overlap(row) for row in found.parameters.values()] == [True, False, True]
    assert first.intervals["p1"] == pytest.approx((1.804, 2.196))


def test_parameters_without_intervals_are_shown_and_not_compared():
    fixed = identification([1.0, 3.0], [0.1, 0.1])
    fixed = replace(fixed, parameters=(fixed.parameters[0], replace(fixed.parameters[1], low95=None)))
    other_unit = identification([5.0], [0.1], "rad")
    found = comparison(fixed, identification([1.0, 3.5], [0.1, 0.1]), other_unit)
    assert [(name, overlap(row)) for (name, _), row in found.parameters.items()] == [("p0", True), ("p1", None)]
    assert found.rows().rows[1] == ["p1", "1", "3", "3.5 ± 0.2", "-", ""]


def test_runs_are_compared_from_the_command_line(finished_run_dir, run_copy, tmp_path, capsys):
    file = run_copy / "identify" / "parameters.json"
    document = json.loads(file.read_text())
    (gain,) = (p for p in document["parameters"] if p["name"] == "gain")
    for end in ("estimate", "low95", "high95"):
        gain[end] += 20 * gain["standard_error"]
    file.write_text(json.dumps(document))
    page = tmp_path / "page.html"
    arguments = ["report", str(finished_run_dir), str(run_copy / "identify"), "--out", str(page), "--json"]
    assert cli.main(arguments) == 0
    found = json.loads(capsys.readouterr().out)
    overlap = {row["parameter"]: row["intervals overlap"] for row in found["parameters"]}
    assert {name for name, text in overlap.items() if text == "no"} == {"gain"}
    names = {row["figure"] for row in found["figures"]}
    assert {"started", "identification", "deployment", "episodes"} <= names
    assert "gain" in page.read_text(encoding="utf-8")


def test_json_of_one_run_and_runs_of_two_robots_are_refused(finished_run_dir, run_copy, capsys):
    assert cli.main(["report", str(finished_run_dir), "--json"]) == USAGE
    assert "two runs" in capsys.readouterr().err
    for file in run_copy.glob("*/manifest.json"):
        file.write_text(json.dumps({**json.loads(file.read_text()), "pipeline": "head"}))
    assert cli.main(["report", str(finished_run_dir), str(run_copy)]) == USAGE
    assert "different robots" in capsys.readouterr().err
