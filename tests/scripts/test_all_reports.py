"""``bench.py all``: it measures the reports that this machine can, and names the machine that each other one needs."""

import importlib
import importlib.util
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("bench_all", ROOT / "scripts" / "bench.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def folder(bench, tmp_path, capsys):
    """Three reports: one that this machine measures in a second, one of a GPU, and one that no bench makes."""
    assert bench.main(["log", "--quick", "--json", str(tmp_path / "log.json")]) == 0
    capsys.readouterr()
    quick = json.loads((tmp_path / "log.json").read_text())
    gpu = {**quick, "machine": {**quick["machine"], "devices": ["NVIDIA H9000"]}}
    (tmp_path / "log_h9000.json").write_text(json.dumps(gpu))
    (tmp_path / "by_hand.json").write_text(json.dumps({"rows": [], "commit": "0123456789"}))
    return tmp_path


def test_reports_are_listed_with_machine_commit_and_state(bench, folder, capsys):
    assert bench.main(["all", "--list", "--reports", str(folder)]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()[2:]}
    assert "stale: it was made with --quick" in lines["log"]
    assert lines["log"].rstrip().endswith("can be measured here")
    assert "needs NVIDIA H9000" in lines["log_h9000"]
    assert "0123456" in lines["by_hand"]
    assert "no bench makes it" in lines["by_hand"]


def test_a_report_without_a_flag_of_its_bench_is_not_measured_with_the_default(bench, folder, capsys):
    """The default may describe other robots than those of the report."""
    report = json.loads((folder / "log.json").read_text())
    name = min(report["flags"])
    report["flags"].pop(name)
    (folder / "log.json").write_text(json.dumps(report))
    assert bench.main(["all", "--list", "--reports", str(folder)]) == 0
    assert f"measured by a bench without {name}: name" in capsys.readouterr().out


def test_reports_of_this_machine_are_measured_again(bench, folder, capsys):
    before = {p.name: p.read_text() for p in folder.glob("*.json")}
    report = json.loads(before["log.json"])
    (folder / "log.json").write_text(json.dumps({**report, "rows": []}))
    assert bench.main(["all", "--quick", "--reports", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "reports/log_h9000.json is not measured: needs NVIDIA H9000" in out
    assert "reports/by_hand.json is not measured: no bench makes it" in out
    fresh = json.loads((folder / "log.json").read_text())
    assert (len(fresh["rows"]), fresh["flags"]) == (len(report["rows"]), report["flags"])
    assert {"commit", "measured", "machine"} <= fresh.keys()
    assert (folder / "by_hand.json").read_text() == before["by_hand.json"]


def test_flags_of_a_report_are_those_of_its_command(bench):
    """Lists, switches, and flags that are passed on to stages."""
    from benches.all_reports import _words
    from benches.runs import arm

    flags = {"seeds": [3, 4], "no_nominal": True, "keep": None, "train": None, "flags": ["--ppo.num-envs", "64"]}
    assert _words(arm, flags) == ["--seeds", "3", "4", "--no-nominal", "--", "--ppo.num-envs", "64"]
    _, options = bench.parse(["arm", *_words(arm, flags)])
    assert (options.seeds, options.no_nominal) == ([3, 4], True)


def test_the_command_of_each_report_has_its_flags_and_its_file(bench):
    from benches.all_reports import plans
    from benches.catalogue import BENCHES

    from sim2real.artifacts.run.manifest import plain

    def module_of(name):
        return importlib.import_module(f"benches.{BENCHES[name].module}")

    for plan in plans(ROOT / "reports", module_of, Path("data"), []):
        flags = json.loads(plan.report.read_text()).get("flags", {})
        _, options = bench.parse(plan.arguments)
        again = plain(bench.reported_flags(vars(options)))
        assert options.json == plan.report
        shared = flags.keys() & again  # a bench may have lost a flag since
        assert {n: again[n] for n in shared} == {n: flags[n] for n in shared}, plan.report


def test_a_report_that_fails_does_not_lose_the_others(bench, folder, monkeypatch, capsys):
    (folder / "early.json").write_text((folder / "log.json").read_text())
    measured = []

    def fails_first(arguments):
        measured.append(arguments[2])
        if len(measured) == 1:
            raise RuntimeError("no such luck")
        return 0

    monkeypatch.setattr(bench, "main", fails_first)
    assert bench.measure_all(["--reports", str(folder)]) == 1
    assert [Path(path).name for path in measured] == ["early.json", "log.json"]
    assert "reports/early.json is not measured: RuntimeError: no such luck" in capsys.readouterr().out


def test_an_unknown_report_is_refused(bench, folder, capsys):
    with pytest.raises(SystemExit):
        bench.main(["all", "--list", "--only", "nothing", "--reports", str(folder)])
    assert "has no report nothing" in capsys.readouterr().err
