"""The figures in README.md and in pages of docs/ are those of the reports."""

import importlib.util
import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

from sim2real.stages.estimation import promises

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def script():
    """The script that writes the tables."""
    spec = importlib.util.spec_from_file_location("readme_script", ROOT / "scripts" / "readme.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_are_those_of_the_reports(script):
    reports = script.read_reports()
    tables = script.tables(reports)
    pages = {name: (ROOT / name).read_text() for name in script.PAGES}
    assert {name: script.updated(text, tables) for name, text in pages.items()} == pages
    assert all(any(f"<!-- {name}:begin -->" in text for text in pages.values()) for name in tables)
    figure = script.what_training_knows(reports["randomise"], reports["randomise_worn"])
    assert (ROOT / script.FIGURE).read_text() == figure
    assert (ROOT / script.DELAYS_FIGURE).read_text() == script.falls_over_delay(reports["walk_delays"])


def test_the_readme_is_read_in_a_minute():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 120
    assert re.search(r"^    make demo", text, re.MULTILINE).start() < 0.25 * len(text)
    for guide in (ROOT / "docs" / "guides").glob("*.md"):
        assert f"docs/guides/{guide.name}" in text
    assert (ROOT / "docs" / "images" / "swing_up.gif").stat().st_size < 2e6


def test_the_evidence_names_the_sets_that_are_lost(script):
    """The table holds the best of the others on each set, whoever wins; a lost set stands below it."""
    reports = script.read_reports()
    text = script.tables(reports)["evidence"]
    worse = json.loads(json.dumps(reports["league"]))
    for row in worse["rows"]:
        if row["name"] == "league/go2/ours/mean":
            row["value"] = 7.0
    assert "Unitree Go2 in the air, RMSE, mean over held-out parts | 5.8 mrad | 6.0 (11.1) | 5.9 mrad" in text
    lost = script.evidence(reports["randomise"], worse)
    assert "loses on Unitree Go2 in the air, RMSE, mean over held-out parts: 7.0 mrad against 5.9 mrad" in lost


def test_a_report_without_its_state_is_refused_until_told(script, monkeypatch, tmp_path, capsys):
    pages = {name: (ROOT / name).read_text() for name in script.PAGES}
    reports = {
        name: {k: v for k, v in r.items() if k not in ("measured", "commit")}
        for name, r in script.read_reports().items()
    }
    for name, text in pages.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / script.FIGURE).parent.mkdir()
    monkeypatch.setattr(script, "ROOT", tmp_path)
    monkeypatch.setattr(script, "read_reports", lambda: reports)
    assert script.main([]) == 1
    told = capsys.readouterr().err
    assert "reports/demo.json: it has no digest of the state of the code" in told
    assert "hint: measure again, or --stale-ok randomise league demo arm_cpu so101_cpu identify_disk" in told
    assert {name: (tmp_path / name).read_text() for name in pages} == pages
    assert script.main(["--stale-ok", *reports]) == 0
    assert "Commit that was measured: not recorded (demo)." in (tmp_path / "docs" / "results.md").read_text()


@pytest.fixture
def league():
    """A report of the league: two sets, one of them in radians, and an entrant without a figure."""
    axis = {"ours": (2.0, 2.5, 4.0), "textbook": (1.5, 1.5, 1.5), "published_a": (1.9,) * 3, "published_b": (1.7,) * 3}
    values = {
        "disk": {"ours": (0.0251, 0.0302), "sysid": (0.1, 0.2), "sysid_delay": (0.035, 0.04), "bam_m1": (None, None)},
        "go2": {"ours": (4.14, 5.0), "pace": (123.4, 150.0)},
        "an_axis": axis,
    }
    units = {"disk": "rad", "go2": "mrad", "an_axis": "mm"}
    rows = [
        {"name": f"league/{name}/{entrant}/{what}", "value": value, "unit": units[name]}
        for name, entrants in values.items()
        for entrant, both in entrants.items()
        for what, value in zip(("mean", "worst", "worst_joint"), both, strict=False)
    ]
    folds = [
        {
            **{"set": name, "fold": f"block {i}", "entrant": entrant, "seconds": 10.0 * (i + 1)},
            **{"value": 20.0 + 10.0 * (i == 4) if name == "disk" else None, "unit": units[name]},
        }
        for name, count in (("disk", 5), ("go2", 3), ("an_axis", 1))
        for i in range(count)
        for entrant in values[name]
    ]
    return {"rows": rows, "folds": folds, "commit": "0123456789"}


def test_the_league_has_a_line_a_set_in_one_unit(script, league):
    text = script.tables({"league": league})["league"]
    assert (
        "eccentric mass, RMSE, 5 folds [mrad] | 25.1 | 30.0 (32.3) | - | 30 s | 100 | 35.0 | - | - | - | - | - |\n"
        in text
    )
    assert "Go2 in the air, RMSE, 3 folds [mrad] | 4.1 | - | - | 20 s | - | - | 123 | - | - | - | - |\n" in text
    assert "XL330" not in text
    assert "| an_axis, 1 fold [mm] | 2.0 | - | 4.0 | 10 s | - | - | - | - | - | 1.5 | 1.7 |\n" in text, "no code"
    better = "Better than sim2real on the set an_axis: textbook servo (1.5 mm), best published set (1.7 mm).\n"
    assert text.count("Better than sim2real") == 1
    assert better in text
    assert text.endswith("Commit that was measured: `0123456` (league).\n")
    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert len(widths) == 1


def test_a_bound_of_the_report_stands_beside_the_error_on_a_real_motor(script):
    reports = {name: script.read_reports()[name] for name in script.TABLES["real"]}
    bounds = {
        "identify_disk": {"disk/promised/th": 31.4},
        "identify_xl330": {},
        "identify_so101": {"so101/promised/elbow": 12.5},
    }
    for name, rows in bounds.items():
        rest = [r for r in reports[name]["rows"] if "/promised/" not in r["name"]]
        reports[name] = {"rows": rest + [{"name": f"identify/{n}_mrad", "value": v} for n, v in rows.items()]}
    lines = [line.split(" | ") for line in script.real_motors(reports).splitlines()]
    assert lines[0][2] == "promised, RMSE"
    assert [line[2] for line in lines[2:]] == ["31 mrad", "-", "12.5 mrad", "12 mrad"]
    assert len({len(line) for line in lines}) == 1


def test_a_run_has_a_line_on_its_promises_if_its_report_has_them(script):
    report = script.read_reports()["so101_cpu"]
    rows = [{"ratio": ratio, "kept": how} for ratio, how in (("0.50", "yes"), ("1.10", "within 1.25"), ("0.90", "yes"))]
    (seed, *_) = report["seeds"]
    text = script.arm("the arm", {"seeds": [{**seed, "promises": rows}]})
    line = "| errors on held-out data | 2 of 3 below the bound that was promised; the worst is 1.10 times its bound |\n"
    assert line in text
    bare = {name: value for name, value in seed.items() if name != "promises"}
    assert script.arm("the arm", {"seeds": [bare]}) == text.replace(line, "")


def test_each_fold_of_the_league_stands_beside_the_bound_from_the_others(script, league):
    text = script.tables({"league": league})["league_promises"]
    bound = promises.further(np.full(4, 20.0))
    worst, *others = [line.split(" | ") for line in text.splitlines() if "block" in line]
    assert worst[1:] == ["block 4", f"{bound:.1f} mrad", "30.0 mrad", f"{30.0 / bound:.2f}", "yes |"]
    assert len(others) == 4
    assert "5 of 5 errors are below their bounds, 0 above 1.25 times the bound." in text


def test_the_robots_of_several_reports_are_counted_together(script):
    def report(**counts):
        rows = [{"name": f"drift/arm/{change}", "value": v, "unit": f"of {n}"} for change, (v, n) in counts.items()]
        return {"rows": rows}

    first = report(
        **{"none/false_alarms": (0.25, 4), "friction/detected": (0.5, 8), "friction/detected/low95": (0.2, 8)}
    )
    second = report(**{"friction/detected": (1.0, 2), "payload/detected": ("nan", 0)})
    line = script.sentences.drift(first, second).splitlines()[3]
    assert line == "| arms | 1 of 4 | 6 of 10 | - | - |"


def test_a_table_whose_reports_are_not_all_there_is_left_as_it_is(script):
    reports = script.read_reports()
    assert set(script.tables(reports)) >= {"demo", "arm", "real"}
    few = {name: reports[name] for name in ("demo", "so101_cpu", "randomise", *script.TABLES["real"])}
    assert set(script.tables(few)) == {"demo", "so101", "demo_time", "so101_time", "real"}


def test_the_citation_names_the_version_of_the_package():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()


SETTINGS = {"60 s": "the time that the league gives the others, a default of its flags", "4 ms": "the step of a model"}
"""Numbers beside the name of a report that are no measured figures, and the reason."""


def typed_figures(text):
    """Return the numbers with a unit in paragraphs that name a report, outside of code and of what readme.py writes."""
    text = re.sub(r"<!-- (\w+):begin -->.*?<!-- \1:end -->|^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    named = [p for p in re.split(r"\n\s*\n", text) if re.search(r"reports/\w+\.json", p)]
    found = re.findall(
        r"(?<![\w.-])\d[\d.,]* (?:%|ms|s|mrad|rad|mm|times|of \d+)(?!\w)", " ".join(" ".join(named).split())
    )
    return [figure for figure in found if figure not in SETTINGS]


@pytest.mark.parametrize("page", sorted((ROOT / "docs").rglob("*.md")), ids=lambda page: page.stem)
def test_figures_of_a_report_are_written_by_the_script(page):
    assert page.name == "choices.md" or typed_figures(page.read_text()) == []


def test_a_typed_figure_is_found_and_a_written_one_is_not():
    text = "It takes 3.5 s of 60 s\n(`reports/demo.json`).\n\nNo report: 4 s.\n\n"
    written = "<!-- demo:begin -->\n7 ms, reports/demo.json\n<!-- demo:end -->\n"
    assert typed_figures(text + written) == ["3.5 s"]
