"""The verdict on a deployment: which finding decides, and the command that follows."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.deployment import AS_HERE, Changed, Deployment, Drift, EpisodeRow, Finding, Reason, Verdict
from sim2real.artifacts.identification import ComparedError, Noise
from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, Steps
from sim2real.stages.deploy import replay, simulation, verdict
from sim2real.stages.deploy.verdict import decide, next_command, terms_to_identify
from sim2real.stages.load import load_robot

FRICTION = Changed("friction", "rad/s^2", 6.0, 12.0, 11.0, 13.0, 0.9, 1e-20)
STEADY = Drift((replace(FRICTION, now=6.1, explains=0.01, p=0.8),), 0.05, (), 20.0)
ALARM = Drift((FRICTION,), 0.05, ("friction",), 20.0)
LIKELY = Drift((replace(FRICTION, p=0.03), replace(FRICTION, name="gain", explains=0.4, p=0.01)), 0.05, (), 20.0)
BUNDLE = SimpleNamespace(
    contract=SimpleNamespace(rate_hz=50.0, delays_s={"sensor_delay": 0.02, "actuator_delay": 0.03}),
    episodes=SimpleNamespace(drawn_s={"agent": np.full(100, 0.001)}),
)


def episode(seconds=10.0, took_s=0.001):
    at = np.arange(0, round(seconds * 1e6), 20_000)
    steps = Steps(scheduled=at, start=at, woken=at, ts_overwrite=0 * at - 1, end=at + round(1e6 * took_s), drift=0 * at)
    return Episode(steps={"agent": steps}, messages={}, outputs={})


def deployed(
    identified=0.01, here=0.01, success=1.0, simulated=1.0, drift=STEADY, took_s=0.001, seconds=10.0, expected=0.01
):
    """A deployment: how far models are off, how well it went, what has changed, and how long steps took."""
    models = {"baselines": {AS_HERE: here, "standing still": 0.5}, "expected": expected}
    rows = (ComparedError("this deployment", "hinge", "rad", 0.1, identified, **models),)
    logs = tuple(Recording(Path(f"runs/pendulum/T/deploy/episode_{i}.mcap"), episode(seconds, took_s)) for i in (0, 1))
    real, late = {"success": success}, [simulation.late_shares(log, BUNDLE) for log in logs]
    table = tuple(EpisodeRow(real, {"success": simulated}, shares) for shares in late)
    return Deployment(table, recordings=logs, replay=rows, drift=drift)


@pytest.mark.parametrize(
    ("found", "status", "said", "findings"),
    [
        ({}, "fine", "success is 1.00, in simulation 1.00", "SUCCESS HOLDS"),
        ({"identified": 0.01}, "fine", "success is 1.00", "SUCCESS HOLDS"),
        ({"drift": ALARM, "identified": 0.011}, "re-identify", "friction is 12 rad/s^2", "CHANGED"),
        ({"drift": ALARM, "success": 0.7}, "re-identify", "friction is 12 rad/s^2", "CHANGED"),
        # A change that harms nobody is said, and decides nothing.
        ({"drift": ALARM}, "fine", "success is 1.00", "SUCCESS CHANGED"),
        ({"identified": 0.5, "here": 0.4, "expected": None}, "fine", "success is 1.00", "SUCCESS HOLDS"),
        ({"identified": 0.0101}, "re-identify", "10 mrad were expected", "WRONG"),
        ({"identified": 0.02, "drift": LIKELY}, "re-identify", "10 mrad were expected", "WRONG LIKELY"),
        ({"identified": None}, "re-identify", "hinge diverges", "WRONG"),
        ({"took_s": 0.0025}, "fine", "success is 1.00", "SUCCESS HOLDS"),
        ({"success": None}, "fine", "no success", "SUCCESS HOLDS"),
        ({"took_s": 0.004}, "fine", "success is 1.00", "SUCCESS HOLDS LATE"),
        ({"took_s": 0.004, "success": 0.7}, "re-train", "100.0% of the steps of agent take longer than in training",
         "LATE SUCCESS HOLDS"),
        ({"took_s": 0.004, "success": None}, "re-train", "100.0% of the steps of agent take", "LATE HOLDS"),
        ({"success": 0.7}, "re-train", "success is 0.70, in simulation 1.00", "SUCCESS HOLDS"),
        ({"success": 0.85, "simulated": 0.9}, "re-train", "success is 0.85, in simulation 0.90", "SUCCESS HOLDS"),
        ({"identified": 0.5, "here": 0.2, "drift": ALARM}, "re-identify", "friction is 12 rad/s^2", "CHANGED"),
        ({"identified": 0.5, "here": 0.4, "drift": ALARM}, "look at this joint",
         "no parameters explain how hinge moves", "UNEXPLAINED"),
    ],
)  # fmt: skip
def test_one_finding_decides_and_the_others_are_named(found, status, said, findings):
    found = deployed(**found)
    told = decide(found)
    assert told.status == status
    assert said in found.sentence(told.reasons[0])
    assert [r.finding for r in told.reasons] == [Finding[name] for name in findings.split()]


def test_of_several_joints_the_worst_is_named_first():
    (row,) = deployed(identified=0.02).replay
    several = [replace(row, joint=name, error=error) for name, error in (("pan", 0.02), ("lift", 0.05), ("roll", None))]
    reasons = decide(replace(deployed(), replay=tuple(several))).reasons
    assert [r.about for r in reasons if r.finding is Finding.WRONG] == ["roll", "lift", "pan"]


@pytest.mark.parametrize(
    ("paused_s", "success", "status"), [(0.4, 0.7, "not judged"), (0.4, 1.0, "fine"), (0.05, 0.7, "re-train")]
)
def test_a_policy_that_fails_where_its_nodes_paused_is_not_judged(folder, paused_s, success, status):
    """No simulation has such pauses. A step that is a little late is no pause."""
    found = deployed(success=success)
    steps = found.recordings[1].episode.steps["agent"]
    paused = np.where(steps.start >= 2_000_000, steps.start + round(1e6 * paused_s), steps.start + 5_000)
    late = replace(steps, start=paused, end=paused + 1_000)
    one = replace(found.recordings[1], episode=Episode(steps={"agent": late}, messages={}, outputs={}))
    second = replace(found.episodes[1], paused_s=simulation.paused_s(one))
    found = replace(found, episodes=(found.episodes[0], second))
    told = decide(found)
    assert told.status == status
    if status == "not judged":
        again = next_command(told, found, load_robot("pendulum"), IDENTIFIED, folder)
        assert again == "sim2real deploy pendulum --run runs/pendulum/T"


@pytest.mark.parametrize(
    ("drift", "likely"),
    [
        (LIKELY, "friction"),
        (ALARM, None),
        (STEADY, None),
        (replace(LIKELY, changes=(replace(FRICTION, p=0.11),)), None),
        (replace(LIKELY, changes=(replace(FRICTION, explains=0.4, p=0.01),)), None),
        (replace(LIKELY, changes=()), None),
    ],
)
def test_a_likely_change_explains_much_and_is_rare(drift, likely):
    assert (drift.likely.name if drift.likely else None) == likely


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The deployment's folder in a run with a recording."""
    monkeypatch.chdir(tmp_path)
    run = tmp_path / "runs" / "pendulum" / "T"
    (run / "record").mkdir(parents=True)
    (run / "record" / "session.mcap").touch()
    (run / "deploy").mkdir()
    (run / "deploy" / "manifest.json").write_text('{"stage": "deploy"}')
    return run / "deploy"


IDENTIFIED = SimpleNamespace(
    logs=[SimpleNamespace(path="record/session.mcap")], used_terms=None, internal=SimpleNamespace(world=None)
)
OFF = {"identified": 0.02, "success": 0.5}
OWN = "--log runs/pendulum/T/deploy/episode_0.mcap --log runs/pendulum/T/deploy/episode_1.mcap"


@pytest.mark.parametrize(
    ("found", "status", "command"),
    [
        ({}, "fine", ""),
        ({"drift": ALARM, **OFF}, "re-identify", f"sim2real identify pendulum {OWN} --run runs/pendulum/T"),
        ({"drift": replace(ALARM, seconds=12.0), **OFF}, "re-identify",
         f"sim2real identify pendulum {OWN} --run runs/pendulum/T"),
        ({"drift": replace(ALARM, seconds=11.9), **OFF}, "re-identify", "sim2real record pendulum"),
        (OFF, "re-identify",
         f"sim2real identify pendulum {OWN} --log runs/pendulum/T/record/session.mcap --run runs/pendulum/T"),
        ({"success": 0.7}, "re-train", "sim2real train pendulum --run runs/pendulum/T"),
        ({"success": 0.7, "drift": replace(LIKELY, seconds=8.0)}, "re-train",
         "sim2real train pendulum --run runs/pendulum/T"),
        ({"success": 0.7, "took_s": 0.004}, "re-train",
         f"sim2real identify pendulum {OWN} --log runs/pendulum/T/record/session.mcap --run runs/pendulum/T"
         " && sim2real train pendulum --run runs/pendulum/T"),
        ({"identified": 0.5, "here": 0.4}, "look at this joint", ""),
    ],
)  # fmt: skip
def test_the_command_can_be_typed(found, status, command, folder):
    """Where the robot has changed, recordings of before are left out."""
    found = deployed(**found)
    told = decide(found)
    assert told.status == status
    told = replace(told, terms="own")
    assert next_command(told, found, load_robot("pendulum"), IDENTIFIED, folder) == command


LADEN = Drift((replace(FRICTION, name="payload", unit="kg", before=0.0, now=0.15),), 0.05, ("payload",), 20.0)


@pytest.mark.parametrize(
    ("drift", "terms", "command"),
    [
        (LADEN, None, f"sim2real identify arm --terms payload {OWN.replace('pendulum/T', 'arm')} --run runs/arm"),
        (replace(LADEN, seconds=8.0), None, "sim2real record arm && sim2real identify arm --terms payload"),
        (replace(ALARM, seconds=8.0), ("payload",), "sim2real record arm && sim2real identify arm --terms payload"),
        (replace(ALARM, seconds=8.0), None, "sim2real record arm"),
    ],
)
def test_what_an_arm_holds_is_identified_from_then_on(drift, terms, command, folder):
    """Without it the other parameters bend to make up for it, and the verdict need not notice."""
    run = folder.parent.rename(folder.parents[2] / "arm")
    logs = tuple(Recording(Path(f"runs/arm/deploy/episode_{i}.mcap"), episode()) for i in (0, 1))
    found = replace(deployed(drift=drift), recordings=logs)
    robot, identified = load_robot("arm"), SimpleNamespace(**vars(IDENTIFIED) | {"used_terms": terms})
    wanted = terms_to_identify(robot.defaults.identify, robot, identified, drift)
    told = Verdict("re-identify", (), ("identify",), wanted)
    assert sorted(next_command(told, found, robot, identified, run / "deploy").split()) == sorted(command.split())


@pytest.mark.parametrize("recorded", [True, False])
def test_a_deployment_without_an_identification_says_so(folder, recorded, monkeypatch):
    """A run that another run's bundle was deployed into has no recording to identify from."""
    monkeypatch.setattr(verdict, "finished", lambda run, stage: "a recording" if recorded else None)
    pipeline, found = load_robot("pendulum"), deployed()
    alone = replace(found, episodes=tuple(replace(e, simulation={}) for e in found.episodes))
    told = verdict.judge(alone, pipeline, None, folder).verdict
    first = "" if recorded else "sim2real record pendulum --run runs/pendulum/T && "
    assert (told.status, told.next) == ("not judged", f"{first}sim2real identify pendulum --run runs/pendulum/T")
    # A robot that is simulated in plain MuJoCo needs none.
    assert verdict.judge(found, pipeline, None, folder).verdict.status == "fine"


def test_a_policy_that_does_not_move_is_trained_again_though_its_model_cannot_be_tested(folder, monkeypatch):
    def too_little(*_):
        raise Sim2RealError("0.0 s of them in motion")

    monkeypatch.setattr(replay, "tested", too_little)
    pipeline = load_robot("pendulum")
    still = replace(deployed(success=0.0), replay=(), drift=None)
    found = verdict.judge(still, pipeline, IDENTIFIED, folder)
    told = found.verdict
    assert (told.status, told.next) == ("re-train", "sim2real train pendulum --run runs/pendulum/T")
    assert found.reasons == ("success is 0.00, in simulation 1.00", "0.0 s of them in motion")
    paused = replace(still, episodes=tuple(replace(e, paused_s=0.4) for e in still.episodes))
    told = verdict.judge(paused, pipeline, IDENTIFIED, folder).verdict
    assert (told.status, told.stages, told.reasons[0]) == ("not judged", ("deploy",), Reason(Finding.PAUSED))
    moved = replace(deployed(), replay=(), drift=None)
    assert verdict.judge(moved, pipeline, IDENTIFIED, folder).verdict.status == "not judged"


def test_the_verdict_is_in_the_artifact(folder):
    """The run's folder may move, so the next command names it only when it is read."""
    found = verdict.judge(replace(deployed(success=0.5), recordings=()), load_robot("pendulum"), None, folder)
    found.save(folder)
    moved = folder.parents[1] / "moved" / "deploy"
    folder.parent.rename(moved.parent)
    read = Deployment.read(moved)
    assert read.reasons == found.reasons
    assert read.verdict.next == found.verdict.next.replace("pendulum/T", "pendulum/moved")
    assert replace(read, verdict=found.verdict) == replace(found, recordings=())


@pytest.mark.parametrize(("errors", "limit"), [([0.1] * 16, 0.1), ([0.1] * 14 + [math.nan, math.inf], math.inf)])
def test_a_prediction_that_diverges_is_infinitely_wrong(monkeypatch, errors, limit):
    left = iter(errors)
    monkeypatch.setattr(replay.prediction, "samples", lambda *_: {})
    th = replay.Position("th", "th", "rad", 1e-6)
    row = lambda *_: replay.prediction.ranked({th: {"identified": next(left)}}, 1.0)  # noqa: E731
    monkeypatch.setattr(replay.prediction, "errors", row)
    problem = SimpleNamespace(ts=np.zeros((1, 3)), segments=1, readings={"th": np.zeros((1, 3))})
    problem.with_readings = lambda readings: problem
    noise = (Noise("th", "rad", 0.01, 0.0, 0.0),)
    found = replay._of_noise(problem, [th], {"th_identified": np.zeros(3)}, noise, {}, 0.3, 1.0)
    assert found == {"th": pytest.approx(limit)}
