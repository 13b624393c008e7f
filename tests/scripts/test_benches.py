"""Every bench runs with --quick and writes a report, or refuses without a GPU. Figures are not looked at."""

import importlib
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))
import bench  # noqa: E402
import canary  # noqa: E402
import figures  # noqa: E402
from benches import pays  # noqa: E402
from benches.rows import missed, row, text_of, values  # noqa: E402

PROCESSES = ("arm", "demo", "so101")
"""Benches that start robots or keep deadlines on the wall clock."""
ON_A_GPU = ("walk-train",)
FLAGS = {"randomise": ["--ways", "all", "--record-s", "12"]}
ON_A_CPU = [
    pytest.param(name, marks=[pytest.mark.process] if name in PROCESSES else [])
    for name in bench.BENCHES
    if name not in (*ON_A_GPU, "league")
]


def run(tmp_path, name, *flags):
    """Run a bench with tiny sizes, and return its report."""
    assert bench.main([name, "--quick", "--json", str(tmp_path / "report.json"), *map(str, flags)]) == 0
    return json.loads((tmp_path / "report.json").read_text())


@pytest.mark.night
@pytest.mark.parametrize("name", ON_A_CPU)
def test_quick_run_writes_a_report(name, tmp_path):
    if name == "compose":
        pytest.importorskip("warp")
    report = run(tmp_path, name, *FLAGS.get(name, ()))
    assert {"command", "commit", "date", "machine", "versions", "seeds"} <= set(report)
    assert report["quick"]
    assert report["rows"]
    assert all(set(line) == {"name", "value", "unit", "yardstick", "goal"} for line in report["rows"])


@pytest.mark.night
def test_league_continues_from_its_results(tmp_path):
    pytest.importorskip("mujoco.sysid")
    (tmp_path / "bam_sts3250").mkdir()
    t = 0.02 * np.arange(150)
    for i, name in enumerate(("sin_sin", "up_and_down", "lift_and_drop")):
        goal, q = 0.5 * np.sin((2 + i) * t), np.zeros(150)
        for k in range(1, 150):
            q[k] = q[k - 1] + 0.3 * (goal[k - 1] - q[k - 1])
        rows = zip(t, goal, q, strict=True)
        entries = [{"timestamp": a, "goal_position": b, "position": c, "torque_enable": True} for a, b, c in rows]
        about = {"kp": 32, "vin": 12.0, "mass": 1.0, "length": 0.1, "trajectory": name, "entries": entries}
        (tmp_path / "bam_sts3250" / f"{name}.json").write_text(json.dumps(about))
    flags = ("--data", tmp_path, "--sets", "sts3250", "--results", tmp_path / "results.jsonl", "--entrants")
    first = run(tmp_path, "league", *flags, "sysid_delay", "pace", "bam_m1")
    results = (tmp_path / "results.jsonl").read_text()
    again = run(tmp_path, "league", *flags, "pace", "bam_m1", "--jobs", 2)
    assert (tmp_path / "results.jsonl").read_text() == results
    assert {f["value"] for f in again["folds"]} < {f["value"] for f in first["folds"]}


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="has a GPU")
@pytest.mark.parametrize("name", ON_A_GPU)
def test_training_on_warp_is_refused_without_a_gpu(name):
    assert bench.main([name, "--quick"]) == 2


@pytest.mark.parametrize("name", bench.BENCHES)
def test_help_of_a_bench(name, capsys):
    """Its module can be imported, and its quick values are those of flags."""
    with pytest.raises(SystemExit) as end:
        bench.main([name, "--help"])
    assert end.value.code == 0
    text, module = capsys.readouterr().out, bench.module_of(name)
    assert callable(module.run)
    assert all(f"--{flag.replace('_', '-')}" in text for flag in module.QUICK if flag != "flags")


@pytest.mark.parametrize("function", sorted({f for f, *_ in (*figures.TABLES.values(), *figures.IMAGES.values())}))
def test_functions_of_tables_exist(function):
    module, _, name = function.rpartition(".")
    assert callable(getattr(importlib.import_module(f"benches.{module}"), name))


def test_goals():
    met = [("< 3", 2), ("<= 3", 3), (">= 0.9, 1 wanted", 0.9), ("+-5", [-5, 4]), ("p99 < 1", [0.1, 0.9, 7.0]), ("", 9)]
    not_met = [("< 3", 3), ("+-5", [0, -6]), ("p99 < 1", [0.1, 1.1, 7.0]), (">= 1e6", 847140)]
    assert not any(missed(row("a", value, "s", "", goal)) for goal, value in met)
    assert all(missed(row("a", value, "s", "", goal)) for goal, value in not_met)
    assert missed(row("a", 19, "of 20", "", "all"))


def test_ways_to_train_are_compared_on_the_seeds_that_all_of_them_have():
    """The data sheet's second seed would double its error; ``fast`` has no seed in both ways."""
    errors = {("follow", "data_sheet"): [0.01, 0.03], ("follow", "posterior"): [0.004], ("fast", "posterior"): [1.0]}
    results = []
    for (task, way), of_seeds in errors.items():
        for unit, value in enumerate(of_seeds):
            trials = [{"success": 1.0, "error_m": value, "settled_s": value, "overshoot_m": None}]
            results.append({"robot": "arm", "task": task, "way": way, "unit": unit, "train_s": 1.0, "trials": trials})
    options = SimpleNamespace(ways=["data_sheet", "posterior"], units=2)
    lines = pays.rows(results, options)
    found = values({"rows": lines}, "pays/arm/")
    assert (found["follow/data_sheet/error_mm"], found["follow/identified_over_best"]) == (10.0, 0.4)
    assert (found["follow/seeds"], found["fast/seeds"]) == (1, 0)
    assert not any(name.startswith("fast/posterior") for name in found)
    assert sum(map(missed, lines)) == 2
    text = pays.table({"rows": lines, "results": results, "flags": vars(options)})
    assert "10 mm" in text
    assert "Arm, time" in text.rpartition("|")[2]


def test_canary():
    old = row("demo/gain_error", [-0.4, 0.2], "%", "", "+-5")
    red = lambda value, tolerances: canary.why_red({**old, "value": value}, old, tolerances)  # noqa: E731
    assert not red([2.5], {"*_error": ("within", 3.0)})
    assert red([2.7], {"*_error": ("within", 3.0)})
    assert red([float("nan")], {"*_error": ("within", 3.0)})
    assert not red([4.0], {})
    assert red([6.0], {})
    names = {case.split()[0] for case, *_ in canary.CASES}
    assert names <= set(bench.BENCHES)


def test_a_report_is_json_with_a_line_for_each_row():
    report = {"bench": "a", "rows": [row("a/b", 1.0, "s"), row("a/c", None, "s")], "flags": {"seeds": [0]}}
    assert json.loads(text_of(report)) == report
    assert len(text_of(report).splitlines()) == 8


@pytest.mark.night
def test_figures_of_pages_are_those_of_the_reports():
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / path for path in figures.IMAGES)]
    before = {page: page.read_bytes() for page in pages}
    try:
        assert figures.main() == 0
        assert {page: page.read_bytes() for page in pages} == before
    finally:
        for page, text in before.items():
            page.write_bytes(text)
