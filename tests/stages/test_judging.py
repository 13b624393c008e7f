"""The verdict on a deployment: which finding decides, and the command that follows."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.artifacts.deployment import Advice, Changed, Deployment, Drift, Gap, Replay, Scores
from sim2real.artifacts.identification import Noise
from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode, Steps
from sim2real.stages.deploy import replay, verdict
from sim2real.stages.deploy.verdict import with_command
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


def deployed(identified=0.01, here=0.01, success=1.0, simulated=1.0, drift=STEADY, took_s=0.001, seconds=10.0):
    """A deployment: how far models are off, how well it went, what has changed, and how long steps took."""
    rows = (Replay("hinge", "rad", 0.1, {"identified": identified, verdict.AS_HERE: here, "hold": 0.5}, 0.01),)
    logs = tuple(Recording(Path(f"runs/pendulum/T/deploy/episode_{i}.mcap"), episode(seconds, took_s)) for i in (0, 1))
    gap = (Gap("success", success, simulated),)
    return Deployment((Scores({}),) * 2, gap, recordings=logs, replay=rows, drift=drift)


@pytest.mark.parametrize(
    ("found", "status", "said"),
    [
        ({}, "fine", "is the one that was identified"),
        ({"drift": ALARM, "identified": 0.011}, "re-identify", "friction is 12 rad/s^2"),
        ({"drift": ALARM, "success": 0.7}, "re-identify", "friction is 12 rad/s^2"),
        ({"drift": ALARM}, "fine", "errors are the expected ones"),
        ({"identified": 0.012}, "fine", "is the one that was identified"),
        ({"identified": 0.013}, "re-identify", "expected were 0.01 rad"),
        ({"identified": 0.04}, "re-identify", "expected were 0.01 rad"),
        ({"identified": None}, "re-identify", "it diverges"),
        ({"took_s": 0.0025}, "fine", "as fast as in training"),
        ({"took_s": 0.004}, "fine", "and the policy succeeds"),
        ({"took_s": 0.004, "success": 0.7}, "re-train",
         "100.0% of the steps of agent take longer than the 1.0 ms of training"),
        ({"took_s": 0.004, "success": None}, "re-train", "100.0% of the steps of agent take longer"),
        ({"success": 0.7}, "re-train", "success is 0.70, in simulation 1.00"),
        ({"success": 0.85, "simulated": 0.9}, "re-train", "as in simulation"),
        ({"identified": 0.5, "here": 0.2, "drift": ALARM}, "re-identify", "friction is 12 rad/s^2"),
        ({"identified": 0.5, "here": 0.4, "drift": ALARM}, "look at this joint",
         "no parameters explain how hinge moves"),
    ],
)  # fmt: skip
def test_one_finding_decides(found, status, said):
    told = verdict.verdict(deployed(**found), BUNDLE)
    assert told.status == status
    assert said in told.reasons[0]
    assert told.joint == ("hinge" if status == "look at this joint" else "")


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
    found = replace(found, recordings=(found.recordings[0], one))
    told = verdict.verdict(found, BUNDLE)
    assert told.status == status
    if status == "not judged":
        again = with_command(told, load_robot("pendulum"), IDENTIFIED, folder, found)
        assert again.next == "sim2real deploy pendulum --run runs/pendulum/T"


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


IDENTIFIED = SimpleNamespace(logs=[SimpleNamespace(path="record/session.mcap")], terms=None, world=None)
OWN = "--log runs/pendulum/T/deploy/episode_0.mcap --log runs/pendulum/T/deploy/episode_1.mcap"


@pytest.mark.parametrize(
    ("told", "found", "command"),
    [
        (Advice("fine", ()), {}, ""),
        (Advice("re-identify", ()), {"drift": ALARM}, f"sim2real identify pendulum {OWN} --run runs/pendulum/T"),
        (Advice("re-identify", ()), {"drift": replace(ALARM, seconds=8.0)}, "sim2real record pendulum"),
        (Advice("re-identify", ()), {},
         f"sim2real identify pendulum {OWN} --log runs/pendulum/T/record/session.mcap --run runs/pendulum/T"),
        (Advice("re-train", ("success is 0.7",)), {}, "sim2real train pendulum --run runs/pendulum/T"),
        (Advice("re-train", ("10% of the steps take longer than 1 ms",)), {},
         f"sim2real identify pendulum {OWN} --log runs/pendulum/T/record/session.mcap --run runs/pendulum/T"
         " && sim2real train pendulum --run runs/pendulum/T"),
        (Advice("look at this joint", (), joint="hinge"), {}, ""),
    ],
)  # fmt: skip
def test_the_command_can_be_typed(told, found, command, folder):
    """Where the robot has changed, recordings of before are left out."""
    assert with_command(told, load_robot("pendulum"), IDENTIFIED, folder, deployed(**found)).next == command


LADEN = Drift((replace(FRICTION, name="payload", unit="kg", before=0.0, now=0.15),), 0.05, ("payload",), 20.0)


@pytest.mark.parametrize(
    ("drift", "terms", "command"),
    [
        (LADEN, None, f"sim2real identify arm --terms payload {OWN.replace('pendulum', 'arm')} --run runs/arm/T"),
        (replace(LADEN, seconds=8.0), None, "sim2real record arm && sim2real identify arm --terms payload"),
        (replace(ALARM, seconds=8.0), ("payload",), "sim2real record arm && sim2real identify arm --terms payload"),
        (replace(ALARM, seconds=8.0), None, "sim2real record arm"),
    ],
)
def test_what_an_arm_holds_is_identified_from_then_on(drift, terms, command, tmp_path, monkeypatch):
    """Without it the other parameters bend to make up for it, and the verdict need not notice."""
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "runs" / "arm" / "T" / "deploy"
    folder.mkdir(parents=True)
    (folder / "manifest.json").write_text('{"stage": "deploy"}')
    logs = tuple(Recording(folder.relative_to(tmp_path) / f"episode_{i}.mcap", episode()) for i in (0, 1))
    found = replace(deployed(drift=drift), recordings=logs)
    told = with_command(Advice("re-identify", ()), load_robot("arm"), replace_terms(terms), folder, found)
    assert sorted(told.next.split()) == sorted(command.split())


def replace_terms(terms):
    """An identification with some optional terms."""
    return SimpleNamespace(logs=IDENTIFIED.logs, terms=terms, world=None)


def test_a_deployment_without_an_identification_says_so(folder):
    told = verdict.judge(deployed(), load_robot("pendulum"), BUNDLE, None, folder).advice
    assert (told.status, told.next) == ("not judged", "sim2real identify pendulum --run runs/pendulum/T")


def test_a_policy_that_does_not_move_is_trained_again_though_its_model_cannot_be_tested(folder, monkeypatch):
    def too_little(*_):
        raise Sim2RealError("0.0 s of them in motion")

    monkeypatch.setattr(replay, "tested", too_little)
    pipeline = load_robot("pendulum")
    told = verdict.judge(deployed(success=0.0), pipeline, BUNDLE, IDENTIFIED, folder).advice
    assert (told.status, told.next) == ("re-train", "sim2real train pendulum --run runs/pendulum/T")
    assert told.reasons == ("success is 0.00, in simulation 1.00", "0.0 s of them in motion")
    assert verdict.judge(deployed(), pipeline, BUNDLE, IDENTIFIED, folder).advice.status == "not judged"


def test_the_verdict_is_in_the_artifact(tmp_path):
    told = replace(deployed(drift=ALARM), recordings=(), advice=Advice("re-identify", ("why",), "sim2real identify"))
    told = replace(told, episodes=(Scores({}),))
    told.save(tmp_path)
    from sim2real.artifacts.files import read_json

    found = read_json(tmp_path / "result.json", Deployment)
    assert (found.advice, found.drift, found.replay) == (told.advice, told.drift, told.replay)


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
