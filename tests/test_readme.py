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


def test_links_lead_somewhere():
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "guides").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page}: {target}"
