"""Runs that are killed at every stage, and what `run --resume` does then: stages that only write small files."""

import os
import signal
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real.artifacts.bundle import History
from sim2real.artifacts.deployment import Advice, Changed, Deployment, Drift, Gap, Scores
from sim2real.artifacts.identification import ROUND_TRIP, Estimate, Identification, Judgement
from sim2real.artifacts.run.iterations import Iterations
from sim2real.artifacts.run.run_folder import STAGES, Source, attempts, finished, newest, open_stage
from sim2real.artifacts.run.stage_status import TAKES, stage_status
from sim2real.commands.flags import RunFlags
from sim2real.commands.loop import run_loop
from sim2real.stages.pipeline.pipeline import load_pipeline

TRIP = Estimate(ROUND_TRIP, "s", "derived", "", 0.0, 0.02, "accepted")
NOT_DRIFTED = Drift((Changed("friction", "rad/s^2", 6.0, 12.0, 11.0, 13.0, 0.9, 0.8),), 0.05, (), 18.0)


class Stages:
    """Stages that take up what the real ones do, and leave small files; the process may die in one.

    Args:
        root: Folder of all runs.
        verdicts: Of each deployment that finishes.
        lacking: Identifications, by their number from 0, that show too little.
    """

    def __init__(self, root, verdicts=("re-identify", "fine"), lacking=()):
        self.root, self.verdicts, self.lacking = root, verdicts, lacking
        self.calls, self.die = [], None

    def __call__(self, stage, config, run_dir):
        here = len(self.calls)
        self.calls.append((stage, config))
        inputs = {}
        if stage == "identify" and config.log:
            inputs = {f"log_{i}": Path(log) for i, log in enumerate(config.log)}
        elif stage in TAKES:
            before, output = TAKES[stage]
            inputs = {output: newest(self.root, "pendulum", before, run_dir).output(output)}
        number = 0 if run_dir is None else sum(a.finished for a in attempts(run_dir, stage))
        with open_stage(self.root, "pendulum", stage, config, inputs, run_dir) as opened:
            self._die(here, "within")
            content = f"{opened.folder} {number}"  # no two outputs are the same
            if stage == "record":
                opened.output("log", "session.mcap").write_text(content)
            if stage == "identify":
                logs = tuple(Source.of(path, opened.run_dir) for path in inputs.values())
                status = "not identifiable" if number in self.lacking else "accepted"
                found = Identification("pendulum", logs, Judgement(status, (content,)), (TRIP,))
                found.write(opened.output("parameters", "parameters.json"))
            if stage == "train":
                opened.output("bundle", "bundle").mkdir()
                (opened.folder / "bundle" / "policy.json").write_text(content)
                good = np.ones((1, 1))
                History(np.ones(1), np.ones(1), good, good).save(opened.output("history", "history.json"))
            if stage == "deploy":
                opened.output("log_0", "episode_0.mcap").write_text(content)
                advice, gap = Advice(self.verdicts[number], ("why",)), (Gap("success", 0.5, 1.0, -0.5),)
                Deployment((Scores({}),), gap, drift=NOT_DRIFTED, advice=advice).save(opened.folder)
                opened.output("result", "result.json")
        self._die(here, "after")
        return opened.result

    def _die(self, call, when):
        if self.die == (call, when):
            os.kill(os.getpid(), signal.SIGKILL)

    def run(self, iterations=5, resume=None):
        pipeline = load_pipeline("pendulum")
        stages = {stage: getattr(pipeline, stage) for stage in STAGES}
        flags = RunFlags(iterations=iterations, runs=self.root, resume=resume, **stages)
        run_loop.run_all(pipeline, flags, self)
        (run_dir,) = (self.root / "pendulum").iterdir()
        return run_dir


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
    monkeypatch.setattr("sim2real.view.page.page.report", lambda run_dir: run_dir / "report.html")


def ran(run_dir):
    """What a run did: the finished attempts by stage with their seeds, and its rows without folders."""
    done = {s: [a.manifest["config"]["seed"] for a in reversed(attempts(run_dir, s)) if a.finished] for s in STAGES}
    return done, [(r.number, r.verdict, r.then, len(r.stages)) for r in Iterations.load(run_dir).rows]


@pytest.mark.night
@pytest.mark.parametrize(
    "verdicts", [("re-identify", "fine"), pytest.param(("re-train", "fine"), marks=pytest.mark.night)]
)
def test_a_run_that_is_killed_at_any_stage_ends_as_if_it_had_not_been(tmp_path, verdicts):
    whole = Stages(tmp_path / "whole", verdicts)
    expected, calls = ran(whole.run()), len(whole.calls)
    assert calls == (7 if verdicts[0] == "re-identify" else 6)
    for call in range(calls):
        for when in ("within", "after"):
            root = tmp_path / f"{call}_{when}"
            run_dir = killed(Stages(root, verdicts), call, when)
            again = Stages(root, verdicts)
            again.run(resume=run_dir)
            assert ran(run_dir) == expected, (call, when)
            assert len(again.calls) == calls - call - (when == "after"), "no stage that finished runs again"
            assert Iterations.load(run_dir).plan is None


def test_a_killed_run_whose_own_logs_do_not_suffice_records_and_does_not_repeat_that(tmp_path):
    """Killed in the identification from the new recording: what was identified from the deployment's logs is stale."""
    run_dir = killed(Stages(tmp_path / "runs", lacking=(1, 2)), 6, "within")
    again = Stages(tmp_path / "runs", lacking=(1, 2))
    again.run(resume=run_dir)
    assert [stage for stage, _ in again.calls] == ["identify", "identify", "train", "deploy"]
    assert [len(attempts(run_dir, s)) for s in STAGES] == [2, 5, 2, 2]


def test_the_plan_is_on_disk_before_the_iteration_starts(tmp_path):
    run_dir = killed(Stages(tmp_path / "runs"), 4, "within")
    left = Iterations.load(run_dir)
    assert [r.number for r in left.rows] == [1]
    assert left.plan is not None
    assert left.plan.stages == ("identify", "train", "deploy")
    assert left.plan.log == ("deploy/episode_0.mcap", "record/session.mcap")
    assert (left.plan.seed, left.plan.before) == (1, STAGES)


def test_a_run_without_iterations_says_that_one_was_interrupted(tmp_path, capsys):
    run_dir = killed(Stages(tmp_path / "runs", ("re-train", "fine")), 4, "within")
    once = Stages(tmp_path / "runs")
    once.run(iterations=1, resume=run_dir)
    assert once.calls == []
    assert "an iteration of this run was interrupted (train with another seed, deploy)" in capsys.readouterr().err


def test_a_deployment_has_one_row_however_often_its_run_is_resumed(tmp_path):
    stages = Stages(tmp_path / "runs", ("re-train", "re-train", "fine"))
    run_dir = stages.run(iterations=2)
    for _ in range(2):
        stages.run(iterations=2, resume=run_dir)
    assert [r.number for r in Iterations.load(run_dir).rows] == [1, 2]
    stages.run(iterations=3, resume=run_dir)
    assert [(r.number, r.verdict) for r in Iterations.load(run_dir).rows] == [
        (1, "re-train"), (2, "re-train"), (3, "fine"),
    ]  # fmt: skip


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
    stages(by_hand, getattr(load_pipeline("pendulum"), by_hand), run_dir)
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
    usual = load_pipeline("pendulum")
    stages("record", usual.record, run_dir)
    stages("identify", replace(usual.identify, log=(str(run_dir / log),)), run_dir)
    assert (not stage_status(run_dir)["identify"].stale) == current
    stages("record", usual.record, run_dir)
    assert stage_status(run_dir)["identify"].stale


def test_a_policy_of_the_nominal_model_and_a_run_without_a_recording_are_not_stale(tmp_path):
    stages, usual = Stages(tmp_path / "runs", ("fine",)), load_pipeline("pendulum")
    run_dir = stages.run(1)
    stages("identify", usual.identify, run_dir)
    with open_stage(stages.root, "pendulum", "train", replace(usual.train, model="nominal"), {}, run_dir) as opened:
        opened.output("bundle", "bundle").mkdir()
    assert not stage_status(run_dir)["train"].stale
    assert stage_status(run_dir)["deploy"].stale
    (tmp_path / "log").write_text("log")
    alone = Stages(tmp_path / "alone")
    done = alone("identify", replace(usual.identify, log=(str(tmp_path / "log"),)), None)
    assert [s.stale for s in stage_status(done.run_dir).values()] == [""]
    assert finished(done.run_dir, "record") is None
