"""The benches of whole runs, on a run that the tests of the stages share: what they read must be what stages write."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
import bench
from benches.runs import arm, stages
from shared_run import copied

from sim2real import cli
from sim2real.commands import command_kinds, run_commands

pytestmark = pytest.mark.process


@pytest.fixture
def commands(monkeypatch, finished_run_dir):
    """Commands that the benches ran; instead of running the stages again, a finished run of the pendulum is copied."""
    called = []

    def sim2real(command, pipeline, *flags):
        called.append([command, pipeline, *flags])
        if command == "run":
            copied(finished_run_dir, Path(flags[flags.index("--runs") + 1]) / pipeline / finished_run_dir.name)
        assert cli.main([command, pipeline, *flags]) == 0, "flags that the command does not have"

    monkeypatch.setattr(run_commands, "_run_stages", lambda *_: None)
    monkeypatch.setattr(command_kinds, "run_stage", lambda *_: None)
    monkeypatch.setattr(stages, "sim2real", sim2real)
    return called


def report_of(path):
    report = json.loads(path.read_text())
    return report, {row["name"]: row["value"] for row in report["rows"]}


@pytest.mark.night
def test_demo(commands, tmp_path):
    path = tmp_path / "report.json"
    assert bench.main(["demo", "--quick", "--json", str(path)]) == 0
    report, rows = report_of(path)
    assert [c[:2] for c in commands] == [["run", "pendulum"]]
    assert rows["demo/train_s"][0] > 0
    assert np.isfinite(rows["demo/prediction_over_true_model"]).all()
    assert len(rows["demo/upright/identified"]) == len(report["seeds"][0]["deployments"]) == 1


@pytest.mark.night
def test_demo_beside_the_nominal_model(commands, tmp_path):
    path = tmp_path / "report.json"
    keep = tmp_path / "runs"
    assert bench.main(["demo", "--seeds", "3", "4", "--keep", str(keep), "--json", str(path)]) == 0
    _, rows = report_of(path)
    assert [c[0] for c in commands] == ["run", "train", "deploy"] * 2
    assert len(rows["demo/upright/nominal"]) == len(rows["demo/total_s"]) == 2
    assert (keep / "seed4" / "nominal").is_dir()


@pytest.mark.night
@pytest.mark.parametrize("name", ["arm", pytest.param("so101", marks=pytest.mark.night)])
def test_arm(name, commands, tmp_path, monkeypatch):
    # The run at hand is the pendulum's: it has a success where the arm has a distance.
    monkeypatch.setattr(arm.stages, "deployed", lambda folder, quantity: [0.01, 0.03])
    path = tmp_path / "report.json"
    assert bench.main([name, "--quick", "--json", str(path)]) == 0
    _, rows = report_of(path)
    assert commands[0][:2] == ["run", name]
    assert rows[f"{name}/held_out_mae_mrad"][0] > 0
    assert rows[f"{name}/reached/identified"] == [1]
    assert rows[f"{name}/distance/identified"] == [20.0]


@pytest.mark.night
def test_the_arms_training_alone(commands, finished_run_dir, tmp_path):
    path = tmp_path / "report.json"
    flags = ["--ppo.num-envs", "1024"]
    run_dir = tmp_path / "runs" / "arm" / finished_run_dir.name
    copied(finished_run_dir, run_dir)
    for manifest in run_dir.glob("*/manifest.json"):
        manifest.write_text(json.dumps({**json.loads(manifest.read_text()), "pipeline": "arm"}))
    assert bench.main(["arm", "--train", str(run_dir), "--json", str(path), "--", *flags]) == 0
    _, rows = report_of(path)
    assert commands[0][:2] == ["train", "arm"]
    assert commands[0][-2:] == flags
    assert {"arm/train/compile_s", "arm/train/time_to_0.95_s", "arm/train/env_steps_per_s"} <= set(rows)


@pytest.mark.night
def test_legs(tmp_path):
    assert bench.main(["legs", "--quick", "--json", str(tmp_path / "report.json")]) == 0
    _, rows = report_of(tmp_path / "report.json")
    assert list(rows) == ["legs/policy_p99", *(f"legs/lateness/{node}_p99" for node in ("sensor", "agent", "actuator"))]
    assert rows["legs/policy_p99"] > 0
