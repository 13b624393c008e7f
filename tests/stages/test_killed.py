"""Runs that are killed at every stage, and what `run --resume` does then: stages that only write small files."""

import os
import signal
import warnings
from dataclasses import replace

import pytest
from loop_stages import Stages

from sim2real.artifacts.iterations import iterations
from sim2real.artifacts.run import STAGES, attempts, finished, open_stage, stage_status
from sim2real.errors import UsageError
from sim2real.stages.load import defaults_of, load_robot


def killed(stages, call, when, **options):
    """Run in a process of its own, which is killed in a call of a stage, or right after it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX warns of forks; the child computes nothing with it
        child = os.fork()
    if not child:
        try:
            stages.die = (call, when)
            stages.run(**options)
        finally:
            os._exit(0)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    (run_dir,) = (stages.root / "pendulum").iterdir()
    return run_dir


@pytest.fixture(autouse=True)
def quick(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sim2real.view.page.report", lambda run_dir: run_dir / "report.html")


def ran(run_dir):
    """What a run did: the finished attempts by stage with their seeds, and its rows without folders."""
    done = {s: [a.manifest.config["seed"] for a in reversed(attempts(run_dir, s)) if a.finished] for s in STAGES}
    return done, [(r.verdict, r.why, len(r.stages)) for r in iterations(run_dir)]


@pytest.mark.night
@pytest.mark.parametrize(
    "verdicts", [("re-identify", "fine"), pytest.param(("re-train", "fine"), marks=pytest.mark.night)]
)
def test_a_run_that_is_killed_at_any_stage_ends_as_if_it_had_not_been(tmp_path, verdicts):
    whole = Stages(tmp_path / "whole", verdicts)
    expected, calls = ran(whole.run()), len(whole.calls)
    assert calls == (8 if verdicts[0] == "re-identify" else 6)
    for call in range(calls):
        for when in ("within", "after"):
            root = tmp_path / f"{call}_{when}"
            run_dir = killed(Stages(root, verdicts), call, when)
            again = Stages(root, verdicts)
            again.run(resume=run_dir)
            assert ran(run_dir) == expected, (call, when)
            assert len(again.calls) == calls - call - (when == "after"), "no stage that finished runs again"


def test_a_dry_deployment_is_refused_before_anything_moves(tmp_path):
    stages = Stages(tmp_path / "runs")
    with pytest.raises(UsageError, match="dry"):
        stages.run(deploy=replace(defaults_of("pendulum").deploy, dry_run=True))
    assert stages.calls == []


def test_a_deployment_has_one_row_however_often_its_run_is_resumed(tmp_path):
    stages = Stages(tmp_path / "runs", ("re-train", "re-train", "fine"))
    run_dir = stages.run(iterations=2)
    for _ in range(2):
        stages.run(iterations=2, resume=run_dir)
    assert len(iterations(run_dir)) == 2
    stages.run(iterations=3, resume=run_dir)
    assert [r.verdict for r in iterations(run_dir)] == ["re-train", "re-train", "fine"]


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize(
    ("by_hand", "follows"),
    [
        ("record", ["identify", "train", "deploy"]),
        ("identify", ["train", "deploy"]),
        ("train", ["deploy"]),
        ("deploy", []),
    ],
)
def test_what_was_made_from_an_older_stage_is_made_again(tmp_path, by_hand, follows, iterations):
    stages = Stages(tmp_path / "runs", ("fine",) * 3)
    run_dir = stages.run(iterations)
    stages(by_hand, getattr(load_robot("pendulum").defaults, by_hand), run_dir)
    assert [stage for stage, s in stage_status(run_dir).items() if s.stale] == follows
    again = Stages(tmp_path / "runs", ("fine",) * 3)
    again.run(iterations, resume=run_dir)
    assert [stage for stage, _ in again.calls] == follows
    assert not any(s.stale for s in stage_status(run_dir).values())


@pytest.mark.parametrize(
    ("log", "current"),
    [("outside.mcap", True), ("record/session.mcap", False), ("deploy/episode_0.mcap", True)],
)
def test_an_identification_of_other_logs_is_current_until_the_robot_is_recorded_again(tmp_path, log, current):
    """That of an older recording of the same run is not: its newer one was made to be used."""
    stages = Stages(tmp_path / "runs", ("fine",))
    run_dir = stages.run(1)
    (run_dir / "outside.mcap").write_text("of another recorder")
    usual = load_robot("pendulum")
    stages("record", usual.defaults.record, run_dir)
    stages("identify", replace(usual.defaults.identify, log=(str(run_dir / log),)), run_dir)
    assert (not stage_status(run_dir)["identify"].stale) == current
    stages("record", usual.defaults.record, run_dir)
    assert stage_status(run_dir)["identify"].stale


def test_a_policy_of_the_nominal_model_and_a_run_without_a_recording_are_not_stale(tmp_path):
    stages, usual = Stages(tmp_path / "runs", ("fine",)), load_robot("pendulum")
    run_dir = stages.run(1)
    stages("identify", usual.defaults.identify, run_dir)
    with open_stage(
        stages.root, "pendulum", "train", replace(usual.defaults.train, model="nominal"), {}, run_dir
    ) as opened:
        opened.output("bundle", "bundle").mkdir()
    assert not stage_status(run_dir)["train"].stale
    assert stage_status(run_dir)["deploy"].stale
    (tmp_path / "log").write_text("log")
    alone = Stages(tmp_path / "alone")
    done = alone("identify", replace(usual.defaults.identify, log=(str(tmp_path / "log"),)), None)
    assert [s.stale for s in stage_status(done.run_dir).values()] == [""]
    assert finished(done.run_dir, "record") is None
