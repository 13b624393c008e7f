"""The run that tests share is whole, true to its robot, and cannot be changed."""

import json
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import shared_run

from sim2real.artifacts.run.run_folder import STAGES, finished


def test_every_stage_has_finished(finished_run_dir):
    for stage in STAGES:
        folder = finished(finished_run_dir, stage)
        assert folder is not None, stage
        assert all((folder.folder / o["path"]).exists() for o in folder.manifest["outputs"].values())


def test_its_truth_is_that_of_the_robot(finished_run_dir):
    rows = json.loads((finished_run_dir / "identify" / "parameters.json").read_text())["parameters"]
    true = {p["name"]: p["truth"] for p in rows}
    assert true["gain"] == pytest.approx(shared_run.ROBOT.gain)
    assert true["round_trip_delay"] == pytest.approx(shared_run.ROBOT.sensing + shared_run.ROBOT.acting, abs=1e-5)


def test_its_files_cannot_be_written(finished_run_dir):
    paths = [finished_run_dir, *finished_run_dir.rglob("*")]
    assert len(paths) > 20
    assert not [path for path in paths if path.stat().st_mode & 0o222]


def test_a_change_is_noticed_and_a_copy_may_be_changed(finished_run_dir, run_copy):
    before = shared_run.state(run_copy)
    assert len(before) == len(shared_run.state(finished_run_dir))
    (run_copy / "train" / "more.txt").write_text("more")
    assert shared_run.state(run_copy) != before


def test_several_workers_make_it_once(tmp_path, monkeypatch):
    made = []

    def make(root):
        made.append(root)
        (root / "pendulum" / "run").mkdir(parents=True)
        time.sleep(0.2)

    monkeypatch.setattr(shared_run, "make", make)
    with ThreadPoolExecutor(3) as workers:  # a lock on a file holds between threads that open it, too
        found = list(workers.map(shared_run.shared, [tmp_path] * 3))
    assert made == [tmp_path / "shared_run"]
    assert found == [tmp_path / "shared_run" / "pendulum" / "run"] * 3
