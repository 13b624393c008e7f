"""Judging a recording before anything is searched: one log is linearised once, the rest is about what is said of it."""

import contextlib
import copy
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real import cli
from sim2real.errors import UsageError
from sim2real.stages.check import determination, sources
from sim2real.stages.check import stage as check_stage
from sim2real.stages.check.config import CheckConfig
from sim2real.stages.config import RecordConfig
from sim2real.stages.estimation import recording_advice
from sim2real.stages.excitation.signals import excitation
from sim2real.stages.excitation.simulated_log import simulate
from sim2real.stages.pipeline.pipeline import load_pipeline

COMMANDS = ("sim2real identify pendulum", "sim2real record pendulum")
LOG = Path(__file__).parents[2] / "datasets" / "pendulum" / "multisine.mcap"


@pytest.fixture(scope="module")
def judged():
    """What the command prints of a log, and its exit code."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = cli.main(["check", "pendulum", "--log", str(LOG), "--json"])
    return code, json.loads(out.getvalue())


def test_a_good_log_determines_everything_up_to_the_time_shift(judged):
    code, found = judged
    assert code == 0
    assert found["determined"]
    assert found["only_sum_of_delays"]
    assert found["undetermined"] == []
    assert found["messages"] == [
        "only sensor_delay + actuator_delay is determined: fix 1 of sensor_delay, actuator_delay, "
        "or accept what is determined"
    ]
    assert found["condition"] < 1000


def test_errors_to_expect_are_small_and_those_of_the_delays_are_of_their_sum(judged):
    rows = {p["name"]: p for p in judged[1]["parameters"]}
    for name in ("gain", "gravity", "damping", "friction"):
        assert rows[name]["determined"] == "alone"
        assert 0.0 < rows[name]["percent_of_nominal"] < 1.0
    assert rows["sensor_delay"]["determined"] == "in a group"
    assert rows["sensor_delay"]["standard_error_per_minute"] > 0.005
    assert rows["round_trip_delay"]["standard_error_per_minute"] < 0.001


def test_the_log_is_described(judged):
    (recording,) = judged[1]["recordings"]
    assert recording["name"].endswith("multisine.mcap")
    assert recording["sampling"]["rate_hz"] == pytest.approx(50.0, rel=0.01)
    (joint,) = recording["joints"]
    assert joint["moving"] > 0.5
    assert 0.3 < joint["forward"] < 0.7
    assert sum(joint["position"]["shares"]) == pytest.approx(1.0)
    (command,) = recording["commands"]
    assert command["name"] == "actuator.action"
    assert 0.5 < command["low_hz"] < command["high_hz"] < 3.0


def test_people_get_tables_and_a_recommendation(judged, capsys):
    check_stage.show(judged[1])
    said = capsys.readouterr().out
    assert "95 % of the power of actuator.action" in said
    assert "round_trip_delay" in said
    assert f"- next: sim2real identify pendulum --log {LOG}" in said
    assert "speed of th" in said


def spoiled(judged, **changes):
    found = copy.deepcopy(judged[1])
    found["recordings"][0]["joints"][0] |= changes
    return found


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"moving": 0.0}, "th does not move at all"),
        ({"moving": 0.1}, "th moves 10% of the time"),
        ({"forward": 0.99}, "almost only one way"),
        ({"position": {"covered": 0.2}}, "stays in 20% of its range"),
    ],
)
def test_what_is_wrong_with_a_motion_is_told(judged, changes, said):
    assert said in "\n".join(recording_advice.recommend(spoiled(judged, **changes), *COMMANDS))


def test_gaps_short_logs_and_constant_commands_are_told(judged):
    found = spoiled(judged)
    found["recordings"][0]["sampling"] |= {"gaps": 2, "longest_gap_s": 0.5, "duration_s": 8.0}
    found["recordings"][0]["commands"][0] |= {"low_hz": None, "high_hz": None}
    said = "\n".join(recording_advice.recommend(found, *COMMANDS))
    for part in ("only 8.0 s", "2 gaps", "no command changes"):
        assert part in said


def test_how_long_to_record_follows_from_the_worst_parameter(judged):
    found = spoiled(judged)
    found["parameters"][2]["percent_of_nominal"] = 3.0
    said = "\n".join(recording_advice.recommend(found, *COMMANDS))
    assert "damping is least certain: 3 % of nominal from a minute; 1% takes 9 min" in said


def test_an_open_direction_ends_with_code_1_and_names_it(judged, monkeypatch, capsys):
    found = {k: v for k, v in judged[1].items() if k not in ("pipeline", "recommendation")}
    found |= {"determined": False, "undetermined": [["gain", "friction"]]}
    monkeypatch.setattr(determination, "judge", lambda *_: found)
    assert cli.main(["check", "pendulum", "--log", str(LOG)]) == 1
    said = capsys.readouterr().out
    assert "some of gain, friction would be guesses" in said
    assert "next:" not in said


def test_what_is_planned_is_simulated_from_where_the_robot_hangs():
    pipeline = load_pipeline("pendulum")
    robot = pipeline.load()
    model = robot.identifiable(0.06)
    record = RecordConfig(duration_s=2.0, amplitude=1.0, low_hz=0.7, high_hz=2.0)
    table, fitting = model.parameters, replace(pipeline.identify, max_delay_s=0.06)
    signal = excitation(record, robot.rate_hz).reshape(-1, 1)
    episode = simulate(model, robot, signal, table.decode(table.start()), fitting)
    th = episode.outputs["sensor"]["th"]
    assert len(th) == len(episode.steps["sensor"])
    assert th[0] == pytest.approx(np.pi, abs=1e-3)
    assert np.ptp(th) > 0.05
    np.testing.assert_allclose(np.abs(episode.outputs["actuator"]["action"]).max(), 1.0, atol=0.35)
    assert determination.coverage(episode, model, {})["joints"][0]["moving"] > 0.1


def test_without_recording_and_plan_there_is_nothing_to_judge(tmp_path):
    pipeline = load_pipeline("disk")  # of recordings alone
    model = pipeline.load().identifiable(0.06)
    for config in (CheckConfig(runs=tmp_path), CheckConfig(plan=True)):
        with pytest.raises(UsageError) as caught:
            sources.find_source(pipeline, config, model, model.parameters, pipeline.identify)
        assert "--log FILE" in (caught.value.hint or "")


def test_a_plan_and_a_log_exclude_each_other():
    with pytest.raises(UsageError, match="exclude"):
        CheckConfig(plan=True, log=("a.mcap",))


def test_segments_lie_side_by_side_and_are_not_too_many(judged):
    pipeline = load_pipeline("pendulum")
    episode = sources.open_recording(LOG, pipeline).episode
    spans, length_s = determination.cut_segments([episode], pipeline.identify)
    assert len(spans) == judged[1]["segments"]
    assert np.diff([s.begin_s for s in spans]) == pytest.approx(length_s)
    many, _ = determination.cut_segments([episode] * 20, pipeline.identify)
    assert len(many) == 120
    assert {s.recording for s in many} == set(range(20))
