"""The yardstick `cold`: where its commit comes from, and how processor time is measured."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
from benches.processor_time import yardstick

from sim2real.errors import Sim2RealError


def git(folder, *arguments):
    about = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false")
    return subprocess.run(["git", *about, *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout


def test_the_files_of_a_commit_are_those_of_that_commit(tmp_path):
    root, folder = tmp_path / "root", tmp_path / "out"
    for name in ("room/code.py", "other/code.py"):
        (root / name).parent.mkdir(parents=True)
        (root / name).write_text("then")
    git(tmp_path, "init", "-q", str(root))
    git(root, "add", "-A")
    git(root, "commit", "-q", "-m", "first")
    (root / "room" / "code.py").write_text("now")
    yardstick.extract(git(root, "rev-parse", "HEAD").strip(), ["room"], folder, root)
    assert [p.relative_to(folder).as_posix() for p in folder.rglob("*.py")] == ["room/code.py"]
    assert (folder / "room" / "code.py").read_text() == "then"


@pytest.mark.parametrize("repository", [True, False])
def test_a_history_without_the_commit_is_an_error_with_a_hint(tmp_path, monkeypatch, repository):
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    if repository:
        git(tmp_path, "init", "-q")
    with pytest.raises(Sim2RealError, match=r"(?s)needs commit 51f54b7.*hint: .*--unshallow.*--commit"):
        yardstick.extract(yardstick.COMMIT, yardstick.PATHS, tmp_path / "out", tmp_path)


def test_a_machine_without_git_gets_the_same_error(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Sim2RealError, match="hint: "):
        yardstick.extract(yardstick.COMMIT, yardstick.PATHS, tmp_path / "out", tmp_path)


def test_processor_time_has_that_of_grandchildren_and_not_the_waiting(tmp_path):
    burn = "import time; [None for _ in iter(lambda: time.process_time() < 0.5, False)]"
    code = f"import subprocess, sys, time; time.sleep(0.5); subprocess.run([sys.executable, '-c', {burn!r}])"
    done = yardstick.measure([sys.executable, "-c", f"{code}; print('end')"], tmp_path, os.environ)
    assert (done.code, done.output) == (0, "end\n")
    assert 0.5 < done.processor_s < done.wall_s
    assert done.wall_s > 1.0


def test_a_yardstick_is_computed_without_the_settings_of_a_test_run():
    settings = {"XLA_FLAGS": "--xla_backend_optimization_level=0", "JAX_PLATFORMS": "cpu", "PYTEST_XDIST_WORKER": "gw0"}
    assert yardstick.plain_environment({**settings, "HOME": "/home"}) == {"HOME": "/home"}
