"""A finished run: complete, true to its robot, and what is made from it."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_robots import TINY, manifest_of
from shared_run import recorded

import sim2real
from sim2real import cli
from sim2real.artifacts.bundle import Bundle
from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.run import STAGES
from sim2real.errors import UsageError

NOTEBOOK = Path(__file__).parents[2] / "docs" / "guides" / "notebook.md"


def strict_json(path):
    """Read JSON as other programs do, which know no NaN."""

    def refuse(word):
        raise ValueError(f"{path} holds {word}")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_a_resumed_run_is_complete(finished_run_dir):
    for stage in STAGES:
        manifest = manifest_of(finished_run_dir / stage)
        assert manifest["status"] == "finished"
        for output in manifest["outputs"].values():
            assert (finished_run_dir / stage / output["path"]).exists()
    assert strict_json(finished_run_dir / "record" / "timing.json")["nodes"]["sensor"]["steps"] > 500
    rows = {p["name"]: p for p in strict_json(finished_run_dir / "identify" / "parameters.json")["parameters"]}
    assert set(rows) == {"gain", "gravity", "damping", "friction", "sensor_delay", "actuator_delay", "round_trip_delay"}
    result = strict_json(finished_run_dir / "deploy" / "result.json")
    for row in result["episodes"]:
        assert {"success", "angle_rms_rad"} <= set(row["real"]) == set(row["simulation"])
        assert all(value is not None for name, value in row["simulation"].items() if name != "first_upright_s")
    inputs = manifest_of(finished_run_dir / "train")["inputs"]
    assert set(inputs) == {"parameters"}, "training reads what identify left, not the log"
    assert (
        inputs["parameters"]["sha256"] == manifest_of(finished_run_dir / "identify")["outputs"]["parameters"]["sha256"]
    )
    # Relative to the run folder: a run that is moved can still be trained.
    assert inputs["parameters"]["path"] == "identify/parameters.json"
    (log,) = strict_json(finished_run_dir / "identify" / "parameters.json")["logs"]
    recorded = manifest_of(finished_run_dir / "record")["outputs"]["log"]
    assert log == {"path": "record/session.mcap", "sha256": recorded["sha256"]}


@pytest.mark.night  # `make test` moves a run folder in test_run_folder.py
def test_a_run_that_was_copied_goes_on_without_its_origin(finished_run_dir, tmp_path, monkeypatch):
    """Neither the log nor anything outside of the run folder is needed to train, deploy, report and look at it."""
    run_dir = tmp_path / "elsewhere" / "pendulum" / "copy"
    shutil.copytree(finished_run_dir, run_dir)
    (run_dir / "record" / "session.mcap").unlink()
    monkeypatch.chdir(tmp_path)
    for path in run_dir.rglob("*.json"):
        typed = {"command", "config"} if path.name == "manifest.json" else set()  # as the user typed them
        told = {name: value for name, value in strict_json(path).items() if name not in typed}
        assert str(finished_run_dir.parent) not in json.dumps(told), path
    home = ["--run", str(run_dir), "--runs", "elsewhere"]
    tiny = [f.removeprefix("--train.") for f in TINY if f.startswith("--train.")]
    assert cli.main(["train", "pendulum", *home, *(f"--{f}" for f in tiny)]) == 0
    shutil.copy(finished_run_dir / "record" / "session.mcap", run_dir / "record")
    assert cli.main(["report", str(run_dir)]) == 0
    before, after = (Bundle.load(run_dir / n) for n in ("train", "train.2"))
    assert all(np.array_equal(before.weights[n], after.weights[n]) for n in before.weights)
    assert set(after.episodes.draws) == {"gain", "gravity", "damping", "friction", "round_trip_delay"}


def test_training_on_what_is_not_accepted_must_be_asked_for(finished_run_dir, tmp_path, capsys):
    """And ``--explain`` shows what episodes are drawn from, and trains nothing."""
    run_dir = tmp_path / "pendulum" / "copy"
    shutil.copytree(finished_run_dir, run_dir)
    file = run_dir / "identify" / "parameters.json"
    document = json.loads(file.read_text())
    document["verdict"] = {"status": "change the model", "reasons": ["friction is at its bound"], "next": "widen it"}
    document["parameters"][0]["state"] = "not determined"
    file.write_text(json.dumps(document))
    home = ["train", "pendulum", "--run", str(run_dir), "--runs", str(tmp_path), "--timelines=4", "--explain"]
    assert cli.main(home) == 1
    said = capsys.readouterr().err
    assert all(
        part in said for part in ("not accepted: change the model", "friction is at its bound", "widen it", "--force")
    )
    assert not (run_dir / "explain").exists()
    assert cli.main([*home, "--force"]) == 0
    shown = capsys.readouterr()
    assert "trains on an identification that is not accepted" in shown.err
    assert "left open by the log" in shown.out
    assert (run_dir / "explain" / "episodes.npz").is_file()
    drawn = Episodes.load(run_dir / "explain")
    assert (drawn.timelines, {n.field for n in drawn.noise}) == (4, {"th", "thdot"})
    assert not (run_dir / "train.2").exists()


@pytest.mark.night
def test_what_the_page_for_notebooks_has_runs(finished_run_dir, tmp_path, monkeypatch):
    """Each stage is a function of a robot and of the artifact of another one, opened from Python."""
    text = "\n".join(re.findall(r"^```python\n(.*?)^```", NOTEBOOK.read_text(), re.DOTALL | re.MULTILINE))
    monkeypatch.chdir(tmp_path)
    had: dict = {}
    text = text.replace("runs/pendulum/TIME/record", str(finished_run_dir / "record"))
    patient = r"\1\nGATE = replace(robot.defaults.record.gate, servo_watchdog_s=0.4)\n"
    text = re.sub(r"^(robot, folder = .*)$", patient, text, flags=re.MULTILINE)  # a busy machine is not what is tested
    exec(re.sub(r"duration_s=2.0", "duration_s=2.0, gate=GATE", text), had)
    robot, recording, found = had["robot"], had["recording"], had["identification"]
    assert (tmp_path / "notebook" / "session.mcap").is_file()
    assert recording.units["th"] == "rad"
    assert found.values.keys() == sim2real.Identification.load(finished_run_dir / "identify").values.keys()
    assert (found.pipeline, found.internal.world) == ("pendulum", None)
    assert found.timing.nodes["sensor"].steps == len(recording.episode.steps["sensor"])
    recorded = manifest_of(finished_run_dir / "record")["outputs"]["log"]
    assert [vars(log) for log in found.logs] == [{"path": "session.mcap", "sha256": recorded["sha256"]}]
    assert had["bundle"].contract.delays_s.keys() == {"sensor_delay", "actuator_delay"}
    assert len(had["deployment"].recordings) == len(had["deployment"].episodes) == 1
    ppo = replace(had["small"], total_steps=256)
    config = replace(robot.defaults.train, episode_s=2.0, timelines=4, ppo=ppo)
    nominal = sim2real.train(robot, config=replace(config, model="nominal", sensitivity=False))
    assert (nominal.contract.delays_s, nominal.summary["timelines drawn again"]) == ({}, 0)
    with pytest.raises(UsageError, match="needs an identification"):
        sim2real.train(robot, config=config)
    with pytest.raises(UsageError, match="another world, the robot's own, than 'moon'"):
        sim2real.train(had["robot"], found, replace(config, world="moon"))


@pytest.mark.night
def test_commands_about_runs_are_functions_too(run_copy, tmp_path):
    run = sim2real.run("pendulum", run_copy.parent.parent, resume=str(run_copy))
    assert run.folder == run_copy
    assert "record, identify, train, deploy" in repr(run)
    assert run.bundle.contract.rate_hz == 50.0
    assert run.deployment.recordings
    assert sim2real.report(run).is_file()
    assert sim2real.report(str(run_copy)).is_file()
    file = sim2real.export("pendulum", run.identification, tmp_path / "identified.json", "json")
    assert "friction" in json.dumps(strict_json(file))
    checked = sim2real.check("pendulum", run.recording)
    assert {p.name for p in checked.parameters} >= {"gain", "friction", "actuator_delay"}
    assert "friction" in checked._repr_html_()
    scored = sim2real.validate("pendulum", run_copy / "identify", recorded(tmp_path / "later.mcap", 7))
    assert scored.errors[0].error > 0.0
    assert scored.identified == run.identification.verdict.status
    with pytest.raises(UsageError, match="which these parameters were identified from"):
        sim2real.validate("pendulum", run_copy / "identify", run.recording)
