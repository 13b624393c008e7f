"""Which state of the code a report is of: what counts as a change, and what is said where the history is lacking."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches import provenance
from benches.catalogue import BENCHES, measures

CODE = '"""A module."""\n\n\ndef f(x: float) -> float:\n    """Return twice."""\n    return 2 * x  # twice\n'
PATHS = ("room", "!room/view", "pipeline/robot.py")


def git(folder, *arguments):
    about = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    return subprocess.run(["git", *about, *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def tree(tmp_path):
    """A repository of two commits, of which only the code was measured."""
    root = tmp_path / "tree"
    for name in ("room/code.py", "room/view/page.py", "pipeline/robot.py", "pipeline/other.py"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(CODE)
    (root / "room" / "data.toml").write_text("a = 1\n")
    git(tmp_path, "init", "-q", str(root))
    git(root, "add", "-A")
    git(root, "commit", "-q", "-m", "first")
    return root


@pytest.fixture
def report(tree):
    """A report of the tree as it is."""
    return {"quick": False, **provenance.state(PATHS, tree)}


def test_a_report_names_commit_and_changes(tree, report):
    assert report["commit"] == git(tree, "rev-parse", "HEAD").strip()
    assert report["dirty"] == []
    (tree / "room" / "code.py").write_text("pass\n")
    (tree / "reports").mkdir()
    (tree / "reports" / "one.json").write_text("{}")
    assert provenance.state(PATHS, tree)["dirty"] == ["room/code.py"]


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("room/code.py", CODE.replace("Return twice", "Return the double").replace("# twice", "# it is")),
        ("room/code.py", '"""Another\n\ntext."""\n\n# why\n' + CODE.split("\n", 2)[2]),
        ("room/code.py", CODE.replace("\n\n\ndef", "\n\nfrom __future__ import annotations\n\n\ndef")),
        ("room/view/page.py", "pass\n"),
        ("pipeline/other.py", "pass\n"),
        ("README.md", "words\n"),
        ("room/__pycache__/code.pyc", "bytes"),
    ],
)
def test_words_and_files_that_are_not_measured_do_not_count(tree, report, file, text):
    (tree / file).parent.mkdir(exist_ok=True)
    (tree / file).write_text(text)
    assert provenance.why_stale(report, PATHS, tree) is None


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("room/code.py", CODE.replace("2 * x", "3 * x")),
        ("room/code.py", CODE.replace("return 2 * x", "return '2 # x'")),
        ("room/data.toml", "a = 2\n"),
        ("pipeline/robot.py", ""),
        ("room/new.py", "x = 1\n"),
    ],
)
def test_a_change_of_what_is_measured_counts(tree, report, file, text):
    (tree / file).write_text(text)
    git(tree, "add", "-A")
    git(tree, "commit", "-q", "-m", "second")
    assert (
        provenance.why_stale(report, PATHS, tree)
        == f"the measured files have changed since {report['commit'][:7]}: {file}"
    )
    # Measured again and back again: the files count, not the commits.
    assert provenance.why_stale({"quick": False, **provenance.state(PATHS, tree)}, PATHS, tree) is None
    git(tree, "revert", "--no-edit", "HEAD")
    assert provenance.why_stale(report, PATHS, tree) is None


def test_a_clone_without_history_says_so(tree, report, tmp_path):
    clone = tmp_path / "clone"
    (tree / "room" / "code.py").write_text("x = 1\n")
    git(tree, "commit", "-q", "-a", "-m", "second")
    git(tmp_path, "clone", "-q", "--depth", "1", tree.as_uri(), str(clone))
    said = provenance.why_stale(report, PATHS, clone)
    assert f"changed since {report['commit'][:7]}, which this clone lacks: git fetch --unshallow" in said


def test_a_copy_without_git_still_tells(tree, report, monkeypatch):
    monkeypatch.setenv("PATH", "/nonexistent")
    assert provenance.why_stale(report, PATHS, tree) is None
    copied = provenance.state(PATHS, tree, "abc1234")
    assert copied == {"commit": "abc1234", "dirty": [], "measured": report["measured"]}
    (tree / "room" / "code.py").write_text("x = 1\n")
    assert "changed" in provenance.why_stale(report, PATHS, tree)
    assert "names no commit" in provenance.why_stale({**report, "commit": None}, PATHS, tree)


def test_quick_reports_and_old_ones_are_refused(tree, report):
    assert provenance.why_stale({**report, "quick": True}, PATHS, tree) == "it was made with --quick"
    assert "has no digest" in provenance.why_stale({"rows": []}, PATHS, tree)


@pytest.mark.parametrize("name", BENCHES)
def test_every_bench_measures_files_that_are_there(name):
    assert len(provenance.files(measures(name, {"case": "disk"}), provenance.ROOT)) > 3


@pytest.mark.parametrize("name", BENCHES)
def test_every_bench_measures_the_stages_that_it_uses(name):
    scripts, stages = provenance.ROOT / "scripts", "sim2real.stages."
    read, waiting, used = set(), {f"benches.{BENCHES[name].module}"}, set()
    while waiting:
        module = waiting.pop()
        read.add(module)
        text = (scripts / f"{module.replace('.', '/')}.py").read_text()
        imports = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.ImportFrom) and n.module]
        names = {n.module for n in imports} | {f"{n.module}.{a.name}" for n in imports for a in n.names}
        waiting |= {m for m in names if (scripts / f"{m.replace('.', '/')}.py").is_file()} - read
        # Those of "pipeline" find and load a robot.
        used |= {m for m in names if m.startswith(stages) and not m.startswith(f"{stages}pipeline")}
        if re.search(r'sim2real\.identify\(|"sim2real\.cli", "identify"', text):
            used.add(f"{stages}identify.stage")
    if f"{stages}identify.stage" in used:
        used.add(f"{stages}estimation.promises")
    of_them = {p for m in used if (p := provenance.ROOT / f"{m.replace('.', '/')}.py").is_file()}
    assert of_them <= set(provenance.files(measures(name, {"case": "disk"}), provenance.ROOT))
