"""Judging a recording before anything is searched: what it shows of a robot, and what is said of it."""

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
    motion_of,
    sampling,
    speed,
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


def test_an_error_with_jax_is_not_reported_as_a_missing_package(monkeypatch):
    monkeypatch.setattr(check_stage, "determine", lambda *_: [].a_defect)
    with pytest.raises(AttributeError, match="a_defect"):
        check_stage.check("pendulum", LOG)


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


T = np.arange(0, 40, 0.02)


def test_gaps_are_counted_and_the_longest_is_told():
    gaps, longest_s, rate_hz = sampling(np.delete(T, np.r_[100:110, 500:600]))
    assert gaps == 2
    assert rate_hz == pytest.approx(50.0)
    assert longest_s == pytest.approx(2.02)
    assert sampling(np.array([1.0])) == (0, 0.0, 0.0)


def test_speed_of_a_position_survives_equal_stamps():
    assert speed(T, 3.0 * T)[100] == pytest.approx(3.0)
    t = T.copy()
    t[50] = t[49]
    assert np.isfinite(speed(t, 3.0 * T)).all()
    assert speed(T[:2], T[:2]).tolist() == [0.0, 0.0]


def moved(amplitude, hz, rate_hz=200.0, noise=0.0, step=0.0, seed=0):
    """Return times and positions of a sine for 20 s, with noise, rounded to a step."""
    t = np.arange(0.0, 20.0, 1 / rate_hz)
    q = amplitude * np.sin(2 * np.pi * hz * t) + noise * np.random.default_rng(seed).normal(size=len(t))
    return t, np.round(q / step) * step if step else q


@pytest.mark.parametrize("rate_hz", [50.0, 200.0, 1000.0])
@pytest.mark.parametrize(
    ("amplitude", "hz", "noise", "step", "moving"),
    [
        (0.125, 0.16, 1e-6, 0.0, 0.96),  # an axis of 0.25 m at 0.13 m/s
        (0.01, 0.05, 1e-5, 0.0, 0.83),  # 3 mm/s; three deviations of a speed are 1 mm/s
        (0.5, 0.7, 1e-3, 0.0, 0.9),
        (0.5, 0.7, 0.0, 2 * np.pi / 4096, 0.9),
        (0.5, 3.0, 0.0, 0.0, 0.96),
        (0.0, 1.0, 1e-3, 0.0, 0.0),  # stands still, and is measured with noise
        (0.0, 1.0, 1e-6, 0.0, 0.0),
        (0.0, 1.0, 1e-3, 2 * np.pi / 4096, 0.0),  # between two counts
        (0.0, 1.0, 0.0, 0.0, 0.0),
    ],
)
def test_slow_motion_is_told_from_noise_by_the_log(rate_hz, amplitude, hz, noise, step, moving):
    found, forward = motion_of(*moved(amplitude, hz, rate_hz, noise, step))
    assert found == pytest.approx(moving, abs=0.09 if moving else 1e-9)
    if moving:
        assert forward == pytest.approx(0.5, abs=0.05)


def test_a_joint_that_moves_half_of_the_time():
    t, q = moved(0.1, 0.5, noise=1e-4)
    found = motion_of(t, np.where(t < 10, q, q[0]) + 1e-4 * np.random.default_rng(1).normal(size=len(t)))
    assert found[0] == pytest.approx(0.48, abs=0.03)


def test_glitches_are_no_motion_and_hide_none():
    t, q = moved(0.0, 1.0, noise=1e-4)
    q[::500] = -3.14
    assert motion_of(t, q)[0] < 0.1
    t, q = moved(0.1, 0.5, noise=1e-4)
    q[::500] = np.nan
    assert motion_of(t, q)[0] > 0.9
