"""Judging a recording before anything is searched: one log is linearised once, the rest is about what is said of it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real import cli
from sim2real.errors import UsageError
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


def test_a_good_log_determines_everything(capsys):
    assert cli.main(["check", "pendulum", "--log", str(LOG), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["determined"]
    assert found["undetermined"] == []
    rows = {p["name"]: p for p in found["parameters"]}
    for name in ("gain", "gravity", "damping", "friction"):
        assert 0.0 < rows[name]["standard_error_per_minute"] < 0.01 * rows[name]["nominal"]
    (recording,) = found["recordings"]
    assert recording["rate_hz"] == pytest.approx(50.0, rel=0.01)
    (joint,), (command,) = recording["joints"], recording["commands"]
    assert joint["moving"] > 0.5
    assert 0.3 < joint["forward"] < 0.7
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


@pytest.mark.parametrize(("percent", "named"), [(3.0, "9 min"), (0.5, "enough")])
def test_how_long_to_record_follows_from_the_worst_parameter(percent, named):
    assert named in checked(percent).recommendation[-1]


def test_an_open_direction_ends_with_code_1_and_names_it(monkeypatch, capsys):
    found = checked(undetermined=(("swing",),))
    monkeypatch.setattr(check_stage, "determine", lambda *_: found)
    assert cli.main(["check", "pendulum", "--log", str(LOG)]) == 1
    verdict, following, *rest = capsys.readouterr().out.splitlines()
    assert "swing" in verdict
    assert following.startswith("next: sim2real check pendulum --plan")
    assert any("a slow sine" in line for line in rest)


def test_what_is_planned_is_simulated_from_where_the_robot_hangs():
    robot = load_robot("pendulum")
    model = robot.identifiable(0.06)
    record = RecordConfig(duration_s=2.0, amplitude=1.0, low_hz=0.7, high_hz=2.0)
    table, fitting = model.parameters, replace(robot.defaults.identify, max_delay_s=0.06)
    signal = excitation(record, robot.drive.rate_hz).reshape(-1, 1)
    episode = simulate(model, robot, signal, table.decode(table.start()), fitting)
    th = episode.outputs["sensor"]["th"]
    assert len(th) == len(episode.steps["sensor"])
    assert th[0] == pytest.approx(np.pi, abs=1e-3)
    assert np.ptp(th) > 0.05
    np.testing.assert_allclose(np.abs(episode.outputs["actuator"]["action"]).max(), 1.0, atol=0.35)
    assert coverage("plan", episode, model, {}).joints[0].moving > 0.1


def test_without_recording_and_plan_there_is_nothing_to_judge(tmp_path):
    for config in ({"runs": tmp_path}, {"plan": True}):
        with pytest.raises(UsageError) as caught:
            check_stage.check("disk", None, config)  # of recordings alone
        assert "--log FILE" in (caught.value.hint or "")
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
