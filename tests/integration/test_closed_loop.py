"""A robot that changes between two iterations of a run: the verdict says so, and the run mends it by itself."""

import shutil
from dataclasses import replace

import pytest
from live_robots import TINY

from sim2real import cli
from sim2real.artifacts.deployment import Deployment
from sim2real.artifacts.iterations import Iterations
from sim2real.artifacts.run_folder import attempts, finished
from sim2real.stages.pipeline import load_pipeline
from sim2real.view.iterations import iterations_sections

pytestmark = [pytest.mark.realtime, pytest.mark.slow]
MORE_S = 0.030


def test_a_robot_that_became_later_is_identified_anew_and_deployed_again(tmp_path, completed, monkeypatch):
    """All stages are real; a run that was finished goes on with a robot that answers 30 ms later."""
    run_dir = tmp_path / "runs" / "pendulum" / completed.name
    shutil.copytree(completed, run_dir)
    shutil.rmtree(run_dir / "deploy")
    robot = load_pipeline("pendulum").load()
    emulator = robot.embedded.emulator
    later = replace(emulator, actuation_latency_s=emulator.actuation_latency_s + MORE_S)
    monkeypatch.setattr(type(robot), "embedded", replace(robot.embedded, emulator=later))
    flags = [flag for flag in TINY if flag != "--deploy.no-measure-delay"]
    flags += ["--record.duration-s=12", "--record.gate.servo-watchdog-s=0.4", "--deploy.force", "--iterations=2"]
    assert cli.main(["run", "pendulum", "--resume", str(run_dir), "--runs", str(tmp_path / "runs"), *flags]) == 0
    first, second = Iterations.load(run_dir).rows
    assert (first.stages, first.verdict) == (("deploy",), "re-identify")
    assert first.why.startswith("the robot has changed: round_trip_delay is ")
    assert first.then == "record, identify, train, deploy"
    assert second.stages == ("record.2", "identify.2", "train.2", "deploy.2")
    (before,) = (a for a in attempts(run_dir, "deploy") if a.folder.name == "deploy")
    named = Deployment.read(before.folder).drift.named
    assert named.now - named.before == pytest.approx(MORE_S, abs=0.010)
    assert "measured delay" in finished(run_dir, "deploy").manifest["summary"]
    (section,) = iterations_sections(run_dir)
    assert [row[0] for row in section.blocks[0].rows] == ["1", "2"]
    assert section.title in (run_dir / "report.html").read_text()
