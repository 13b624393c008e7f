"""Around the loop: what each verdict makes a run do again, when it stops, and what ``--resume`` does after a kill.

The stages take up what the real ones do, and leave small files.
"""

import os
import signal
import warnings
from dataclasses import replace
from pathlib import Path

import pytest

from sim2real.artifacts.deployment import Changed, Deployment, Drift, EpisodeRow, Finding, Reason, Verdict
from sim2real.artifacts.identification import ROUND_TRIP, Estimate, Identification, Judgement
from sim2real.artifacts.iterations import iterations
from sim2real.artifacts.run import (
    STAGES,
    TAKES,
    Source,
    attempts,
    finished,
    newest,
    open_stage,
    portable,
    sha256,
    stage_status,
)
from sim2real.commands.loop import run_all
from sim2real.commands.stages import RunFlags
from sim2real.errors import DelayChanged, UsageError
from sim2real.stages.load import defaults_of, load_robot
from sim2real.view.sections import iterations_sections

TRIP = Estimate(ROUND_TRIP, "s", "derived", "", 0.0, 0.02, "ok")
FRICTION = Changed("friction", "rad/s^2", 6.0, 12.0, 11.0, 13.0, 0.9, 1e-20)


STAGES_OF = {"re-identify": ("identify",), "re-train": ("train",)}


def verdict(status, success=0.5, reason="why", seconds=18.0, drift=False, stages=None):
    """Return a deployment that was judged so."""
    alarms = Drift((FRICTION if drift else replace(FRICTION, p=0.8),), 0.05, ("friction",) if drift else (), seconds)
    judged = Verdict(status, (Reason(Finding.UNTESTED, reason),), stages or STAGES_OF.get(status, ()))
    return Deployment((EpisodeRow({"success": success}, {"success": 1.0}),), drift=alarms, verdict=judged)


class Stages:
    """Stages that only write small files; the process may die in one.

    Args:
        root: Folder of all runs.
        verdicts: Of each deployment that finishes: a status, a deployment, or an error that is raised.
    """

    def __init__(self, root, verdicts=("re-identify", "fine")):
        self.root, self.verdicts = root, [*verdicts]
        self.calls, self.die, self.refused = [], None, 0

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
                logs = tuple(Source(portable(path, opened.run_dir), sha256(path)) for path in inputs.values())
                Identification("pendulum", logs, Judgement("accepted", (content,)), (TRIP,)).write(
                    opened.output("parameters", "parameters.json")
                )
            if stage == "train":
                opened.output("bundle", "bundle").mkdir()
                (opened.folder / "bundle" / "policy.json").write_text(content)
            if stage == "deploy":
                opened.output("log_0", "episode_0.mcap").write_text(content)
                found = self.verdicts[number + self.refused]
                if isinstance(found, Exception):
                    self.refused += 1
                    raise found
                (verdict(found) if isinstance(found, str) else found).save(opened.folder)
                opened.output("result", "result.json")
        self._die(here, "after")
        return opened.result

    def _die(self, call, when):
        if self.die == (call, when):
            os.kill(os.getpid(), signal.SIGKILL)

    def run(self, iterations=5, resume=None, train=None, deploy=None, **told):
        """Run; return the run folder."""
        robot = load_robot("pendulum")
        stages = {stage: getattr(robot.defaults, stage) for stage in STAGES}
        stages["train"] = replace(robot.defaults.train, **(train or {}))
        stages["deploy"] = deploy or robot.defaults.deploy
        flags = RunFlags(iterations=iterations, runs=self.root, resume=resume, **stages, **told)
        run_all(robot, flags, self)
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


@pytest.fixture
def world(tmp_path):
    """Stages; ``go`` plays a run with these verdicts, and returns the stages after the first four and its rows."""
    stages = Stages(tmp_path / "runs")

    def go(*verdicts, **options):
        stages.verdicts, stages.refused = list(verdicts), 0
        run_dir = stages.run(**options)
        return [s for s, _ in stages.calls[4:]], iterations(run_dir)

    stages.go = go
    return stages


def test_a_fine_robot_ends_the_loop(world, capsys):
    again, rows = world.go(verdict("re-train", 0.6), verdict("fine", 1.0))
    assert again == ["train", "deploy"]
    assert [(r.verdict, r.real) for r in rows] == [("re-train", 0.6), ("fine", 1.0)]
    assert rows[0].stages == STAGES
    assert rows[1].stages == ("train.2", "deploy.2")
    assert [c.seed for s, c in world.calls if s == "train"] == [0, 1], "the same seed would train the same policy"
    (folder,) = (world.root / "pendulum").iterdir()
    (section,) = iterations_sections(folder)
    assert (section.box.tone, section.box.title) == ("good", "Fine")
    assert [row[:3] for row in section.blocks[0].rows] == [
        ["1", "record, identify, train, deploy", "0.6000"],
        ["2", "train.2, deploy.2", "1.000"],
    ]
    assert "stop: the policy works on the robot" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("found", "stages"),
    [
        (verdict("re-identify"), STAGES),
        (verdict("re-identify", drift=True), STAGES),
        (verdict("re-train", stages=("identify", "train")), STAGES),
        (verdict("re-train"), ("train", "deploy")),
    ],
)
def test_the_verdict_says_what_is_done_again(world, found, stages):
    again, _ = world.go(found, verdict("fine", 1.0))
    assert again == list(stages)
    assert all(config.log == () for stage, config in world.calls if stage == "identify"), "the newest recording"


LATER = DelayChanged("the delay is 60 ms", hint="record, identify and train again")


def test_a_robot_that_became_later_is_recorded_and_trained_for_anew(world):
    """Its policy was refused before it moved anything, so nothing is known of the robot as it is now."""
    again, rows = world.go(LATER, verdict("fine", 1.0))
    assert again == ["record", "identify", "train", "deploy"]
    assert [(r.verdict, r.why, r.stages) for r in rows] == [
        ("re-identify", "the delay is 60 ms", STAGES),
        ("fine", "why", tuple(f"{stage}.2" for stage in STAGES)),
    ]
    assert dict(world.calls[4:])["identify"].log == ()


def test_the_loop_ends_as_a_deployment_does_that_is_refused_to_the_end(world):
    with pytest.raises(UsageError, match="iterations must be at least 1"):
        RunFlags(iterations=0)
    with pytest.raises(DelayChanged):
        world.go(LATER, iterations=1)
    with pytest.raises(DelayChanged):
        world.go(verdict("re-train"), LATER, iterations=2)


@pytest.mark.parametrize("status", ["look at this joint", "not judged"])
def test_what_nobody_can_mend_unattended_ends_the_loop(world, status, capsys):
    again, (row,) = world.go(verdict(status, reason="it is loose"))
    assert (again, row.why) == ([], "it is loose")
    assert "stop: it is loose" in capsys.readouterr().err


def test_a_deployment_that_does_not_say_what_it_took_is_not_repeated_for_ever(world, monkeypatch):
    """Nothing says that it is current, so it counts as stale. Only the iterations bound how often a robot moves."""
    monkeypatch.setitem(globals(), "TAKES", {})
    again, rows = world.go(*(verdict("re-identify") for _ in range(9)), iterations=2)
    assert again == list(STAGES)
    assert len(rows) == 2
