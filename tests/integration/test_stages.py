"""The four stages, one after the other and one by one, with tiny budgets."""

import json
import shutil

import pytest
from live_robots import PATIENT, manifest_of

from sim2real import cli
from sim2real.log.reader import read_log
from sim2real.stages.runs import STAGES, finished, newest

pytestmark = pytest.mark.realtime


def strict_json(path):
    """Read JSON as other programs do, which know no NaN."""

    def refuse(word):
        raise ValueError(f"{path} holds {word}")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_a_resumed_run_is_complete(completed):
    for stage in STAGES:
        manifest = manifest_of(completed / stage)
        assert manifest["status"] == "finished"
        for output in manifest["outputs"].values():
            assert (completed / stage / output["path"]).exists()
    assert strict_json(completed / "record" / "timing.json")["timing"]["sensor"]["steps"] > 500
    rows = {p["name"]: p for p in strict_json(completed / "identify" / "parameters.json")["parameters"]}
    assert set(rows) == {"gain", "gravity", "damping", "friction", "sensor_delay", "actuator_delay", "round_trip_delay"}
    result = strict_json(completed / "deploy" / "result.json")
    assert {g["quantity"] for g in result["gap"]} >= {"success", "angle_rms_rad"}
    assert all(g["simulation"] is not None for g in result["gap"] if g["quantity"] != "first_upright_s")
    inputs = manifest_of(completed / "train")["inputs"]
    assert inputs["log"]["sha256"] == manifest_of(completed / "record")["outputs"]["log"]["sha256"]
    assert inputs["parameters"]["sha256"] == manifest_of(completed / "identify")["outputs"]["parameters"]["sha256"]
    # Relative to the run folder: a run that is moved can still be trained.
    assert inputs["log"]["path"] == "record/session.mcap"
    assert strict_json(completed / "identify" / "parameters.json")["log"]["path"] == "record/session.mcap"


def test_resuming_a_finished_run_does_nothing(completed, root, capsys):
    before = {stage: manifest_of(completed / stage)["started"] for stage in STAGES}
    assert cli.main(["run", "pendulum", "--resume", str(completed), "--runs", str(root)]) == 0
    assert capsys.readouterr().err.count("finished before, skipped") == 4
    assert before == {stage: manifest_of(completed / stage)["started"] for stage in STAGES}


def test_deploying_again_keeps_the_first_deployment(completed, tmp_path):
    run_dir = tmp_path / "runs" / "pendulum" / "copy"
    shutil.copytree(completed, run_dir)
    first = manifest_of(run_dir / "deploy")["started"]
    flags = ["--episodes", "2", "--duration-s", "1", "--runs", str(tmp_path / "runs"), "--strict-timing"]
    flags += PATIENT
    assert cli.main(["deploy", "pendulum", *flags]) in (0, 5)  # a busy machine may miss deadlines; all is written
    assert manifest_of(run_dir / "deploy")["started"] == first
    again = run_dir / "deploy.2"
    assert {p.name for p in again.glob("*.mcap")} == {"episode_0.mcap", "episode_1.mcap"}
    assert all(read_log(p).complete for p in again.glob("*.mcap"))
    assert len(strict_json(again / "result.json")["episodes"]) == 2


def test_a_new_recording_is_what_identify_takes_next(completed, root, tmp_path):
    shutil.copytree(root, tmp_path, dirs_exist_ok=True)
    assert cli.main(["record", "pendulum", "--duration-s", "1", "--runs", str(tmp_path), *PATIENT]) == 0
    latest = newest(tmp_path, "pendulum", "record")
    assert latest.run_dir.name != completed.name
    # Too short to identify from: the stage says so instead of falling back to the older one.
    assert cli.main(["identify", "pendulum", "--runs", str(tmp_path)]) == 2
    assert finished(latest.run_dir, "identify") is None
    # Named, the older run is used, and gets the new attempt.
    flags = ["--run", completed.name, "--runs", str(tmp_path), "--generations", "10", "--population", "8"]
    assert cli.main(["identify", "pendulum", *flags]) == 0
    assert (tmp_path / "pendulum" / completed.name / "identify.2").is_dir()


def test_an_interrupted_stage_is_run_again(completed, tmp_path, capsys):
    run_dir = tmp_path / "pendulum" / "copy"
    shutil.copytree(completed, run_dir)
    path = run_dir / "deploy" / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "status": "running", "exit_code": None}))
    flags = ["--resume", "copy", "--runs", str(tmp_path), "--deploy.episodes", "1", "--deploy.duration-s", "1"]
    assert cli.main(["run", "pendulum", *flags]) == 0
    assert capsys.readouterr().err.count("finished before, skipped") == 3
    assert manifest_of(run_dir / "deploy.2")["status"] == "finished"
    assert manifest_of(run_dir / "deploy")["status"] == "running"


@pytest.mark.parametrize("command", ["info", "report"])
def test_a_finished_run_can_be_looked_at(completed, command, capsys):
    assert cli.main([command, str(completed)]) == 0
    assert capsys.readouterr().out
