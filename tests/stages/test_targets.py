"""Which run a user means."""

from pathlib import Path

import pytest

from sim2real.artifacts import run as run_folder
from sim2real.errors import SafetyStop, UsageError
from sim2real.stages.config import RecordConfig
from sim2real.stages.shared import find_run


def record(root, run_dir=None, pipeline="pendulum", text="log"):
    with run_folder.open_stage(root, pipeline, "record", RecordConfig(), run_dir=run_dir) as stage:
        stage.output("log", "session.mcap").write_text(text)
    return stage.result


def test_runs_are_found_by_path_name_stage_folder_and_pipeline(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = Path("runs")
    run_dir = record(root).run_dir
    latest = record(root).run_dir
    for target in (run_dir, run_dir / "record", run_dir.name):
        assert find_run.find_run(root, target, "pendulum") == run_dir
        assert find_run.find_run(root, target) == run_dir
    assert find_run.find_run(root, "pendulum") == latest
    with pytest.raises(UsageError, match="a run of pendulum, not of arm"):
        find_run.find_run(root, run_dir, "arm")
    with pytest.raises(UsageError, match=latest.name):
        find_run.find_run(root, "nothing")
    with pytest.raises(UsageError, match="pipeline 'arm' has no run in runs"):
        find_run.find_run(root, "arm")


def test_a_run_folder_as_working_directory_does_not_stand_for_every_name(tmp_path, monkeypatch):
    here, there = record(tmp_path / "here").run_dir, record(tmp_path / "there").run_dir
    monkeypatch.chdir(here)
    assert find_run.find_run(tmp_path / "there", "pendulum") == there
    assert find_run.find_run(tmp_path / "there", there.name) == there
    assert find_run.find_run(tmp_path / "there", ".").resolve() == here
    assert find_run.find_run(tmp_path / "there", "record").resolve() == here
    with pytest.raises(UsageError, match="nothing"):
        find_run.find_run(tmp_path / "there", "nothing")


def test_a_run_that_failed_does_not_hide_those_before(tmp_path):
    good = record(tmp_path).run_dir
    with pytest.raises(SafetyStop), run_folder.open_stage(tmp_path, "pendulum", "record", None) as failed:
        raise SafetyStop("too fast")
    assert find_run.find_run(tmp_path, "pendulum") == good
    assert find_run.find_run(tmp_path, failed.run_dir.name) == failed.run_dir
    with pytest.raises(SafetyStop), run_folder.open_stage(tmp_path, "arm", "record", None) as only:
        raise SafetyStop("too fast")
    assert find_run.find_run(tmp_path, "arm") == only.run_dir, "there is no other to show"
