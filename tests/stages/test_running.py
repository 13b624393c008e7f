"""Around the loop: what each verdict makes a run do again, and when it stops."""

import pytest
from loop_stages import Stages, verdict

from sim2real.artifacts.iterations import iterations
from sim2real.artifacts.run import STAGES
from sim2real.commands.stages import RunFlags
from sim2real.errors import DelayChanged, UsageError
from sim2real.view.sections import iterations_sections


@pytest.fixture
def world(tmp_path, monkeypatch):
    """Stages; ``go`` plays a run with these verdicts, and returns the stages after the first four and its rows."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sim2real.view.page.report", lambda run_dir: run_dir / "report.html")
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
    with pytest.raises(UsageError, match="at least once"):
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
    monkeypatch.setattr("loop_stages.TAKES", {})
    again, rows = world.go(*(verdict("re-identify") for _ in range(9)), iterations=2)
    assert again == list(STAGES)
    assert len(rows) == 2
