"""Judging a recording before anything is searched: one log is linearised once, the rest is about what is said of it."""

import contextlib
import io
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real import cli, pytree
from sim2real.errors import NotInstalled, UsageError
from sim2real.stages.check import stage as check_stage
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.check.stage import (
    Checked,
    Coverage,
    ParameterCheck,
    SignalCoverage,
    coverage,
)
from sim2real.stages.config import RecordConfig
from sim2real.stages.load import load_robot
from sim2real.stages.session.excitation import excitation
from sim2real.stages.session.simulated_log import simulate
from sim2real.stages.shared.arguments import open_recording

LOG = Path(__file__).parents[2] / "datasets" / "pendulum" / "multisine.mcap"
JOINT = SignalCoverage("th", "rad", -1.0, 1.0, 3.0, 0.9, 0.5)
GOOD = Coverage("a.mcap", 2000, 40.0, 50.0, 0, 0.0, (JOINT,), (SignalCoverage("goal", "rad", -1.0, 1.0),))


@pytest.fixture(scope="module")
def judged():
    """What the command prints of a log, and its exit code."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = cli.main(["check", "pendulum", "--log", str(LOG), "--json"])
    return code, json.loads(out.getvalue())


def test_a_good_log_determines_everything(judged):
    code, found = judged
    assert code == 0
    assert found["determined"]
    assert found["undetermined"] == []
    rows = {p["name"]: p for p in found["parameters"]}
    for name in ("gain", "gravity", "damping", "friction"):
        assert 0.0 < rows[name]["standard_error_per_minute"] < 0.01 * rows[name]["nominal"]


def test_the_log_is_described(judged):
    (recording,) = judged[1]["recordings"]
    assert recording["name"].endswith("multisine.mcap")
    assert recording["rate_hz"] == pytest.approx(50.0, rel=0.01)
    (joint,) = recording["joints"]
    assert joint["moving"] > 0.5
    assert 0.3 < joint["forward"] < 0.7
    (command,) = recording["commands"]
    assert command["name"] == "actuator.action"
    assert command["low"] < command["high"]


def test_commands_that_are_logged_too_seldom_decide():
    slow = replace(GOOD, too_seldom=("10 goals a second are too few",))
    found = Checked("arm", (GOOD, slow), (), (), ())
    assert not found.determined
    assert found.verdict.startswith("record again")
    assert any("10 goals" in text for text in found.recommendation)
    assert Checked("arm", (GOOD,), (), (), ()).determined


@pytest.mark.parametrize(
    ("found", "named"),
    [
        (GOOD, None),
        (replace(GOOD, duration_s=8.0), "8.0 s"),
        (replace(GOOD, gaps=2, longest_gap_s=0.5), "2 gaps"),
        (replace(GOOD, doubts=("tau is measured",)), "tau"),
        (replace(GOOD, commands=(SignalCoverage("goal", "rad", 1.0, 1.0),)), "no command changes"),
        (replace(GOOD, joints=(replace(JOINT, moving=0.0),)), "th does not move"),
        (replace(GOOD, joints=(replace(JOINT, moving=0.1),)), "th moves 10%"),
        (replace(GOOD, joints=(replace(JOINT, forward=0.99),)), "th moves almost only one way"),
    ],
)
def test_what_is_wrong_with_a_recording_is_named(found, named):
    *texts, _ = checked(recordings=(found,)).recommendation
    assert len(texts) == (named is not None)
    assert all(named in text for text in texts)
    *several, _ = checked(recordings=(found, GOOD)).recommendation
    assert all(text.startswith("a.mcap: ") for text in several if "only" not in text)


def checked(percent=0.5, undetermined=(), recordings=(GOOD,)):
    rows = (
        ParameterCheck("gain", "1", 2.0, 0.02 * percent),
        ParameterCheck("swing", "1", None, 9.0, "a slow sine"),
    )
    return Checked("arm", recordings, undetermined, (), rows)


def test_how_long_to_record_follows_from_the_worst_parameter():
    assert "9 min" in checked(3.0).recommendation[-1]
    assert "gain" in checked(3.0).recommendation[-1]
    assert "enough" in checked().recommendation[-1]


def test_an_open_direction_ends_with_code_1_and_names_it(monkeypatch, capsys):
    found = checked(undetermined=(("swing",),))
    monkeypatch.setattr(check_stage, "determine", lambda *_: found)
    assert cli.main(["check", "pendulum", "--log", str(LOG)]) == 1
    verdict, following, *rest = capsys.readouterr().out.splitlines()
    assert "swing" in verdict
    assert following.startswith("next: sim2real check pendulum --plan")
    assert any("a slow sine" in line for line in rest)


def test_without_jax_the_coverage_is_printed(monkeypatch, capsys):
    monkeypatch.setattr(check_stage, "has_jax", lambda: False)
    with pytest.raises(NotInstalled):
        check_stage.check("pendulum", LOG, {"json": True})
    assert json.loads(capsys.readouterr().out)["recordings"][0]["joints"][0]["name"] == "hinge"


def test_an_error_with_jax_is_not_reported_as_a_missing_package(monkeypatch):
    def broken(*_):
        raise AttributeError("a defect")

    monkeypatch.setattr(check_stage, "determine", broken)
    with pytest.raises(AttributeError, match="a defect"):
        check_stage.check("pendulum", LOG)


def test_what_is_planned_is_simulated_from_where_the_robot_hangs():
    pipeline = load_robot("pendulum")
    robot = pipeline
    model = robot.identifiable(0.06)
    record = RecordConfig(duration_s=2.0, amplitude=1.0, low_hz=0.7, high_hz=2.0)
    table, fitting = model.parameters, replace(pipeline.defaults.identify, max_delay_s=0.06)
    signal = excitation(record, robot.drive.rate_hz).reshape(-1, 1)
    episode = simulate(model, robot, signal, table.decode(table.start()), fitting)
    th = episode.outputs["sensor"]["th"]
    assert len(th) == len(episode.steps["sensor"])
    assert th[0] == pytest.approx(np.pi, abs=1e-3)
    assert np.ptp(th) > 0.05
    np.testing.assert_allclose(np.abs(episode.outputs["actuator"]["action"]).max(), 1.0, atol=0.35)
    assert coverage("plan", episode, model, {}).joints[0].moving > 0.1


def test_commands_of_several_joints_have_their_names():
    model = load_robot("arm").identifiable(0.06)
    names = [channel.name for channel in model.channels]
    ((node, message),) = model.given.items()
    t = np.arange(200) / 50.0
    swings = np.sin(t)[:, None] * np.ones(len(names))
    outputs = {model.sensor: {f: swings for c in model.channels for f, _ in c.fields}}
    outputs[node] = dict.fromkeys(pytree.leaves(message), swings)
    steps = dict.fromkeys((model.sensor, node), SimpleNamespace(begun_s=t))
    episode = SimpleNamespace(steps=steps, outputs=outputs, metadata={}, units={})
    commands = coverage("a", episode, model, {}).commands
    assert [c.name.rpartition(" of ")[2] for c in commands[: len(names)]] == names


def test_without_recording_and_plan_there_is_nothing_to_judge(tmp_path):
    for config in ({"runs": tmp_path}, {"plan": True}):
        with pytest.raises(UsageError) as caught:
            check_stage.check("disk", None, config)  # of recordings alone
        assert "--log FILE" in (caught.value.hint or "")


def test_a_plan_and_a_log_exclude_each_other():
    with pytest.raises(UsageError, match="exclude"):
        CheckConfig(plan=True, log=("a.mcap",))


def test_segments_lie_side_by_side_and_are_not_too_many():
    pipeline = load_robot("pendulum")
    episode = open_recording(LOG, pipeline).episode
    spans, length_s = check_stage.cut_segments([episode], pipeline.defaults.identify)
    assert len(spans) == 14  # of 1.3 s, in 20.0 s without their edges
    assert np.diff([s.begin_s for s in spans]) == pytest.approx(length_s)
    many, _ = check_stage.cut_segments([episode] * 20, pipeline.defaults.identify)
    assert len(many) == 120
    assert {s.recording for s in many} == set(range(20))
