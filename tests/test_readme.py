"""What README.md says was measured must be what reports/ holds, and what it links to must be there."""

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def script():
    """The script that writes the tables."""
    spec = importlib.util.spec_from_file_location("readme_script", ROOT / "scripts" / "readme.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_are_those_of_the_reports(script):
    text = (ROOT / "README.md").read_text()
    tables = script.tables(script.read_reports())
    assert script.updated(text, tables) == text
    assert all(f"<!-- {name}:begin -->" in text for name in tables)


def test_a_report_without_its_state_is_refused_until_told(script, monkeypatch, tmp_path, capsys):
    readme = (ROOT / "README.md").read_text()
    reports = {
        name: {k: v for k, v in r.items() if k not in ("measured", "commit")}
        for name, r in script.read_reports().items()
    }
    (tmp_path / "README.md").write_text(readme)
    monkeypatch.setattr(script, "ROOT", tmp_path)
    monkeypatch.setattr(script, "read_reports", lambda: reports)
    assert script.main([]) == 1
    told = capsys.readouterr().err
    assert "reports/demo.json: it does not say which state of the code it is of" in told
    assert "hint: measure again, or --stale-ok demo arm_cpu arm_h200 so101_cpu identify_disk" in told
    assert (tmp_path / "README.md").read_text() == readme
    assert script.main(["--stale-ok", *reports]) == 0
    assert "Commit that was measured: not recorded (demo)." in (tmp_path / "README.md").read_text()


@pytest.fixture
def league():
    """A report of the league: two sets, one of them in radians, and an entrant without a figure."""
    values = {
        "disk": {"ours": (0.0251, 0.0302), "sysid": (0.1, 0.2), "sysid_delay": (0.035, 0.04), "bam_m1": (None, None)},
        "go2": {"ours": (4.14, 5.0), "pace": (123.4, 150.0)},
    }
    units = {"disk": "rad", "go2": "mrad"}
    rows = [
        {"name": f"league/{name}/{entrant}/{what}", "value": value, "unit": units[name]}
        for name, entrants in values.items()
        for entrant, both in entrants.items()
        for what, value in zip(("mean", "worst"), both, strict=True)
    ]
    folds = [
        {"set": name, "fold": f"block {i}", "entrant": entrant, "seconds": 10.0 * (i + 1)}
        for name, count in (("disk", 5), ("go2", 3))
        for i in range(count)
        for entrant in values[name]
    ]
    return {"rows": rows, "folds": folds, "commit": "0123456789"}


def test_the_league_has_a_line_a_set_in_one_unit(script, league):
    text = script.tables({"league": league})["league"]
    assert "| motor with eccentric mass, RMSE, 5 folds | 25.1 | 30.2 | 30 s | 100 | 35.0 | - | - | - |\n" in text
    assert "| Unitree Go2 in the air, RMSE, 3 folds | 4.1 | 5.0 | 20 s | - | - | 123 | - | - |\n" in text
    assert "XL330" not in text
    assert text.endswith("Commit that was measured: `0123456` (league).\n")
    widths = {line.count("|") for line in text.splitlines() if line.startswith("|")}
    assert len(widths) == 1


def test_a_table_whose_reports_are_not_all_there_is_left_as_it_is(script):
    reports = script.read_reports()
    assert set(script.tables(reports)) >= {"demo", "arm", "real"}
    few = {name: r for name, r in reports.items() if name not in ("arm_h200", "league", "randomise")}
    assert set(script.tables(few)) == {"demo", "so101", "real"}


def test_links_lead_somewhere():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "guides").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page}: {target}"
