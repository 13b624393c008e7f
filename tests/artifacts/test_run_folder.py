"""Run folders and manifests."""

import errno
import json
import os
import subprocess
import sys
import threading
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from sim2real.artifacts import run as run_folder
from sim2real.artifacts.run import StageFolder, git_state, sha256
from sim2real.commands import info
from sim2real.errors import SafetyStop, Sim2RealError, UsageError
from sim2real.stages.config import RecordConfig, TrainConfig


def record(root, run_dir=None, pipeline="pendulum", text="log"):
    with run_folder.open_stage(root, pipeline, "record", RecordConfig(), run_dir=run_dir) as stage:
        stage.output("log", "session.mcap").write_text(text)
    return stage.result


def test_manifest_is_there_from_the_start_and_complete_at_the_end(tmp_path):
    source = tmp_path / "parameters.json"
    source.write_text("{}")
    with run_folder.open_stage(
        tmp_path / "runs", "pendulum", "train", TrainConfig(seed=3), {"parameters": source}
    ) as stage:
        running = json.loads((stage.folder / "manifest.json").read_text())
        stage.output("bundle", "bundle").mkdir()
        (stage.folder / "bundle" / "policy.json").write_text("{}")
        stage.summary({"return": np.float32(1.5), "steps": np.int64(4)})
        stage.summary({"curve": np.arange(3)})
    done = json.loads((stage.folder / "manifest.json").read_text())
    assert (running["status"], running["exit_code"], running["outputs"]) == ("running", None, {})
    assert (done["status"], done["exit_code"], done["pipeline"], done["stage"]) == ("finished", 0, "pendulum", "train")
    assert done["inputs"] == {"parameters": {"path": "../../../parameters.json", "sha256": sha256(source)}}
    assert done["outputs"]["bundle"] == {"path": "bundle", "sha256": sha256(stage.folder / "bundle")}
    assert done["summary"] == {"return": 1.5, "steps": 4, "curve": [0, 1, 2]}
    assert done["config"]["seed"] == 3
    assert done["duration_s"] >= 0
    assert done["versions"]["jax"]
    assert set(done) >= {"started", "git", "command", "versions"}
    assert stage.result.output("bundle") == stage.folder / "bundle"
    assert [p.name for p in stage.folder.iterdir() if p.name.startswith(".")] == []


class Clock:
    """A wall clock that stands still at an hour."""

    def __init__(self, hour):
        self._hour = hour

    def now(self, zone):
        return datetime(2026, 1, 1, self._hour, tzinfo=zone)


DIES = """
import os, signal, sys
from pathlib import Path
from sim2real.artifacts.run import open_stage
with open_stage(Path(sys.argv[1]), "pendulum", "train", None) as stage:
    if sys.argv[2] == "forked":
        read, write = os.pipe()
        if os.fork() == 0:
            os.execvp("sleep", ["sleep", "30"])  # what a stage has started may outlive it
        os.close(write)
        os.read(read, 1)  # until the child is another program: before that, it holds all that its parent has open
    print(stage.folder, flush=True)
    signal.pause()
"""


@pytest.mark.parametrize("child", ["alone", "forked"])
def test_every_reader_says_of_a_stage_that_was_killed_that_it_died(tmp_path, child):
    process = subprocess.Popen([sys.executable, "-c", DIES, str(tmp_path), child], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    folder = Path(process.stdout.readline().strip())

    def status():
        (attempt,) = run_folder.attempts(folder.parent, "train")
        return attempt.manifest.status, *(word for word in ("running", "died") if word in info.run(folder.parent))

    assert status() == ("running", "running")
    process.kill()
    process.wait()
    assert status() == ("died", "died")
    assert not run_folder.finished(folder.parent, "train")
    with run_folder.open_stage(tmp_path, "pendulum", "train", None, run_dir=folder.parent) as again:
        assert [a.manifest.status for a in run_folder.attempts(folder.parent, "train")] == ["running", "died"]
    assert again.result.manifest.status == "finished"


def test_a_stage_that_ends_while_it_is_read_did_not_die(tmp_path):
    """Its writer replaces the manifest before it releases the lock."""
    stop, seen = threading.Event(), set[str]()

    def read():
        while not stop.is_set():
            for folder in tmp_path.glob("pendulum/*/record"):
                read = StageFolder.read(folder)
                seen.add("running" if read is None else read.manifest.status)

    reader = threading.Thread(target=read)
    reader.start()
    for _ in range(8):
        record(tmp_path)
    stop.set()
    reader.join()
    assert seen <= {"running", "finished"}


def test_without_locks_a_stage_counts_as_running(tmp_path, monkeypatch):
    monkeypatch.setattr(run_folder, "fcntl", None)
    with run_folder.open_stage(tmp_path, "pendulum", "record", None) as stage:
        (attempt,) = run_folder.attempts(stage.run_dir, "record")
        assert attempt.manifest.status == "running"


@pytest.mark.parametrize(
    ("error", "status", "code"),
    [
        (SafetyStop("too fast"), "failed", 3),
        (ZeroDivisionError("x"), "failed", 1),
        (KeyboardInterrupt(), "interrupted", 130),
        (SystemExit(143), "interrupted", 143),
    ],
)
def test_manifest_says_how_a_stage_ended(tmp_path, error, status, code):
    def stopped():
        with run_folder.open_stage(tmp_path, "pendulum", "record", RecordConfig()) as stage:
            stage.output("log", "session.mcap").write_text("half")
            stage.output("never", "written.txt")
            raise error

    with pytest.raises(type(error)):
        stopped()
    (path,) = tmp_path.glob("pendulum/*/record/manifest.json")
    manifest = json.loads(path.read_text())
    assert (manifest["status"], manifest["exit_code"], list(manifest["outputs"])) == (status, code, ["log"])
    assert manifest["error"].startswith(type(error).__name__)


def test_a_promised_output_that_is_missing_fails_the_stage(tmp_path):
    def broken():
        with run_folder.open_stage(tmp_path, "pendulum", "record", None) as stage:
            stage.output("log", "session.mcap")

    with pytest.raises(Sim2RealError, match=r"session\.mcap"):
        broken()
    with pytest.raises(
        Sim2RealError, match=r"no finished 'record' of pipeline 'pendulum'[\s\S]*sim2real record pendulum"
    ):
        run_folder.newest(tmp_path, "pendulum", "record")


def test_missing_inputs_are_errors_before_a_folder_is_made(tmp_path):
    with (
        pytest.raises(Sim2RealError, match="cannot read"),
        run_folder.open_stage(tmp_path / "runs", "pendulum", "train", None, {"log": tmp_path / "none.mcap"}),
    ):
        pass
    assert not (tmp_path / "runs").exists()


def test_run_names_are_unique_and_sort_by_age(tmp_path):
    names = [run_folder.new_run(tmp_path, "pendulum").name for _ in range(20)]
    assert names == sorted(set(names))


def test_newest_is_the_last_finished_one(tmp_path):
    first, second = record(tmp_path), record(tmp_path)
    record(tmp_path, pipeline="arm")
    assert run_folder.newest(tmp_path, "pendulum", "record").folder == second.folder
    with pytest.raises(KeyboardInterrupt), run_folder.open_stage(tmp_path, "pendulum", "record", None):
        raise KeyboardInterrupt
    assert run_folder.newest(tmp_path, "pendulum", "record").folder == second.folder
    assert run_folder.newest(tmp_path, "pendulum", "record", run_dir=first.run_dir).folder == first.folder
    again = record(tmp_path, run_dir=first.run_dir)
    assert run_folder.newest(tmp_path, "pendulum", "record").folder == again.folder


def test_two_at_work_in_one_run_do_not_meet(tmp_path):
    with run_folder.open_stage(tmp_path, "pendulum", "train", {"who": "A"}) as a:
        a.output("policy", "policy").write_text("A")
        with run_folder.open_stage(tmp_path, "pendulum", "train", {"who": "B"}, run_dir=a.run_dir) as b:
            b.output("policy", "policy").write_text("B")
            b.summary({"who": "B"})
        a.summary({"who": "A"})
    assert [f.name for f in (a.folder, b.folder)] == ["train", "train.2"]
    for one, who in ((a, "A"), (b, "B")):
        read = StageFolder.read(one.folder)
        assert read.manifest.config == read.manifest.summary == {"who": who}
        assert read.output("policy").read_text() == who
        assert sha256(read.output("policy")) == read.manifest.outputs["policy"].sha256
    assert run_folder.finished(a.run_dir, "train").folder == b.folder, "the one that started last"


def test_what_refers_to_an_attempt_stays_right_when_the_stage_runs_again(tmp_path):
    log = record(tmp_path, text="1").output("log")
    with run_folder.open_stage(tmp_path, "pendulum", "identify", None, {"log": log}, log.parent.parent) as stage:
        pass
    record(tmp_path, stage.run_dir, text="2")
    source = stage.result.manifest.inputs["log"]
    assert source.path == "record/session.mcap"
    moved = tmp_path / "elsewhere"
    stage.run_dir.rename(moved)
    assert sha256(moved / source.path) == source.sha256


@pytest.mark.parametrize("name", ["../../../etc", "..", "a/b", "", ".hidden", "/etc", "a\nb"])
def test_names_that_lead_out_of_the_runs_folder(tmp_path, name):
    for names, said in (((name, "record"), "no name for a pipeline"), (("pendulum", name), "no name for a stage")):
        with pytest.raises(UsageError, match=said), run_folder.open_stage(tmp_path / "r", *names, None):
            pass
    assert not any(tmp_path.iterdir())
    with (
        run_folder.open_stage(tmp_path, "pendulum", "record", None) as stage,
        pytest.raises(UsageError, match="must lie in"),
    ):
        stage.output("log", "../log.mcap")


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_full_disk_is_said_in_words_and_the_manifest_tells(tmp_path, number, monkeypatch):
    opened = os.open

    def full(path, flags, mode=0o777):
        if flags & os.O_CREAT and not os.path.exists(path):
            raise OSError(number, os.strerror(number), str(path))
        return opened(path, flags, mode)

    def fill():
        with run_folder.open_stage(tmp_path, "pendulum", "record", RecordConfig()) as stage:
            monkeypatch.setattr(os, "open", full)  # from here on no file can be made; those that are there have room
            stage.output("log", "session.mcap")
            raise OSError(number, os.strerror(number), "timing.json")

    with pytest.raises(Sim2RealError, match=r"(?s)the disk is full: .*timing\.json.*hint: free some space"):
        fill()
    monkeypatch.undo()
    (path,) = tmp_path.glob("pendulum/*/record/manifest.json")
    manifest = json.loads(path.read_text())
    assert (manifest["status"], manifest["exit_code"]) == ("failed", 1)
    assert "disk is full" in manifest["error"]


def test_outputs_that_are_unknown_or_gone(tmp_path):
    done = record(tmp_path)
    with pytest.raises(Sim2RealError, match=r"no output 'bundle'\. Available: log"):
        done.output("bundle")
    done.output("log").unlink()
    with pytest.raises(Sim2RealError, match="is missing"):
        done.output("log")


def test_hash_of_a_folder_depends_on_names_and_contents(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "f").write_text("1")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "f").write_text("1")
    assert sha256(tmp_path / "a") == sha256(tmp_path / "b")
    (tmp_path / "b" / "f").rename(tmp_path / "b" / "g")
    assert sha256(tmp_path / "a") != sha256(tmp_path / "b")


def test_the_git_state_is_the_commit_and_whether_tracked_files_differ(tmp_path):
    def git(*arguments):
        return subprocess.run(["git", *arguments], cwd=tmp_path, check=True, capture_output=True, text=True).stdout

    assert git_state(tmp_path) is None, "it is no repository"
    git("init", "-q")
    assert git_state(tmp_path) is None, "there is no commit yet"
    (tmp_path / "f").write_text("1")
    git("add", "-A")
    git("-c", "user.name=a", "-c", "user.email=b", "commit", "-qm", "x")
    git("tag", "v1")
    (tmp_path / "untracked").write_text("1")
    assert git_state(tmp_path) == {"sha": git("rev-parse", "HEAD").strip(), "dirty": False}
    (tmp_path / "f").write_text("2")
    assert git_state(tmp_path)["dirty"]


def test_a_clock_that_is_set_back_does_not_hide_the_newest_attempt(tmp_path, monkeypatch):
    first = record(tmp_path, text="1")
    for hour in (9, 7):  # the second one starts before the first one, says the clock
        monkeypatch.setattr(run_folder, "datetime", Clock(hour))
        latest = record(tmp_path, first.run_dir, text=f"at {hour}")
    for number in range(4, 12):
        latest = record(tmp_path, first.run_dir, text=f"at 7, {number}")
    attempts = run_folder.attempts(first.run_dir, "record")
    assert [a.folder.name for a in attempts][:3] == ["record.11", "record.10", "record.9"]
    assert [a.output("log").read_text() for a in attempts][-3:] == ["at 7", "at 9", "1"]
    assert run_folder.finished(first.run_dir, "record").folder == latest.folder


@pytest.mark.parametrize("number", [errno.EROFS, errno.EACCES])
def test_a_folder_that_is_read_only_is_named_before_anything_moves(tmp_path, monkeypatch, number):
    """A process of root writes in spite of permissions, so the error is that of a file system."""
    first = record(tmp_path)

    def refuse(path, *_, **__):
        raise OSError(number, os.strerror(number), str(path))

    monkeypatch.setattr(Path, "mkdir", refuse)
    for run_dir in (None, first.run_dir):
        with pytest.raises(
            Sim2RealError, match=rf"cannot write the run folder .*{os.strerror(number)}[\s\S]*--runs DIR"
        ):
            record(tmp_path, run_dir)
