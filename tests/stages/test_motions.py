"""What ``record`` plays: signals, and with ``--excitation FILE`` a motion within the robot's limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim2real import cli
from sim2real.errors import UsageError
from sim2real.log.reader import read_log
from sim2real.stages.config import RecordConfig
from sim2real.stages.load import load_module, load_robot
from sim2real.stages.session.excitation import excitation, played

ARM = load_robot("so101")
SERVOS = ARM.drive.servos
LOW, HIGH = np.array(SERVOS.low), np.array(SERVOS.high)
T_S = np.arange(0.0, 4.0, 1 / 30)
CHIRP = Path(__file__).parents[2] / "datasets" / "pendulum" / "chirp.mcap"


def wave(reach=0.8):
    """Return a motion around the middle of the limits, ``(N, 6)`` [rad]."""
    phases = np.arange(6)
    return (LOW + HIGH) / 2 + reach / 2 * (HIGH - LOW) * np.sin(2 * np.pi * 0.2 * T_S[:, None] + phases)


def write(path, pose, order=range(6), unit="deg"):
    """Write a motion as a table of columns in any order."""
    scale = np.rad2deg(1.0) if unit == "deg" else 1.0
    header = ",".join(["t_s", *(f"action_{SERVOS.names[i]}_{unit}" for i in order)])
    rows = np.column_stack([T_S[: len(pose)], scale * pose[:, list(order)]])
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    return path


def goals(path, **settings):
    config = replace(ARM.defaults.record, excitation=str(path), **settings)
    return played(config, ARM, announce=True) + ARM.drive.centre


def at_the_robots_rate(pose):
    t_s = np.arange(0.0, T_S[-1], 1 / 50)
    return np.stack([np.interp(t_s, T_S, joint) for joint in pose.T], axis=1)


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_columns_are_found_by_joint_in_any_order_and_unit(tmp_path, unit, capsys):
    path = write(tmp_path / "motion.csv", wave(), order=[3, 0, 5, 1, 2, 4], unit=unit)
    np.testing.assert_allclose(goals(path), at_the_robots_rate(wave()), atol=1e-6)
    assert len(goals(path, duration_s=2.0)) == 100
    taught = tmp_path / "teleoperated.npz"  # goals come before measurements
    np.savez(taught, t_s=T_S, names=np.array(SERVOS.names), position_rad=0.5 * wave(), goal_rad=wave())
    np.testing.assert_allclose(goals(taught), at_the_robots_rate(wave()), atol=1e-6)
    holes = wave()
    holes[10:13, 2] = np.nan
    np.savez(taught, t_s=T_S, names=np.array(SERVOS.names), goal_rad=holes)
    np.testing.assert_allclose(goals(taught), at_the_robots_rate(wave()), atol=5e-3)
    assert "warning" not in capsys.readouterr().err
    holes[31:60, 2] = np.nan
    np.savez(taught, t_s=T_S, names=np.array(SERVOS.names), goal_rad=holes)
    assert np.isfinite(goals(taught)).all()
    assert "warning: the file has no values from 1.0 to 2.0 s" in capsys.readouterr().err


def test_a_log_is_played_as_it_was_sent():
    robot, log = load_robot("pendulum"), read_log(CHIRP)
    volts = played(replace(robot.defaults.record, excitation=str(CHIRP), duration_s=5.0), robot, announce=False)
    sent_s = 1e-6 * log.steps["actuator"].end
    expected = np.interp(np.arange(len(volts)) / 50.0, sent_s - sent_s[0], log.outputs["actuator"]["action"].ravel())
    assert len(volts) == 250
    np.testing.assert_allclose(volts.ravel(), expected, atol=1e-6)


def test_the_ends_outside_of_the_limits_are_not_played(tmp_path, capsys):
    pose = wave()
    pose[:16, 1] = np.linspace(LOW[1] - 0.3, pose[15, 1], 16)
    pose[-31:, 2] = np.linspace(pose[-31, 2], HIGH[2] + 1.0, 31)
    rows = goals(write(tmp_path / "motion.csv", pose))
    assert (rows >= LOW - 1e-5).all()
    assert (rows <= HIGH + 1e-5).all()
    assert 3.0 < len(rows) / 50 < 3.5
    assert "s at its ends are outside of the limits, and are not played" in capsys.readouterr().err


def wrong(tmp_path, change, unit="rad"):
    pose = wave()
    change(pose)
    with pytest.raises(UsageError) as caught:
        goals(write(tmp_path / "motion.csv", pose, unit=unit))
    return str(caught.value)


def test_a_motion_that_leaves_the_limits_or_is_too_fast_is_refused_by_joint_and_time(tmp_path):
    def beyond(pose):
        pose[60:66, 3] = HIGH[3] + 0.2

    def leap(pose):
        pose[60:, 0] = np.where(pose[60:, 0] > 0, LOW[0], HIGH[0])

    assert "wrist_flex is -0.8 rad at 2." in wrong(tmp_path, beyond)
    assert "too fast: shoulder_pan moves at" in wrong(tmp_path, leap)
    with pytest.raises(UsageError, match=r"outside of the limits everywhere: .* must lie in"):
        goals(write(tmp_path / "motion.csv", wave() + 3.0))
    with pytest.raises(UsageError, match=r"shoulder_lift is -1.6. rad at 2.9. s, and must lie in \[-1.5, -0.3\]"):
        goals(write(tmp_path / "motion.csv", wave(0.95)), gate=replace(ARM.defaults.record.gate, limit=1.5))


def test_files_without_a_motion_are_refused(tmp_path):
    (tmp_path / "other.csv").write_text("t_s,lift_rad,twist_rad\n" + "".join(f"{i},0.1,{i}\n" for i in range(9)))
    with pytest.raises(UsageError, match=r"no columns for shoulder_pan, .*Columns: t_s, lift_rad, twist_rad"):
        goals(tmp_path / "other.csv")
    with pytest.raises(UsageError, match="there is no motion"):
        goals(tmp_path / "none.csv")
    with pytest.raises(UsageError, match="has no 'goal' of 'actuator'"):
        goals(CHIRP)
    with pytest.raises(UsageError, match="does not stand on legs"):
        goals("standing")
    with pytest.raises(UsageError, match="shorter than 1 s"):
        goals(write(tmp_path / "short.csv", wave()[:20]))
    with pytest.raises(UsageError, match="neither multisine, chirp, steps, hand nor standing, nor a file"):
        replace(ARM.defaults.record, excitation="wobble")


def test_a_log_is_a_motion_that_the_arm_reaches_slowly(tmp_path):
    """As a recording by hand: a column of positions, here from a table."""
    path = write(tmp_path / "motion.csv", wave(0.7), unit="rad")
    rows = goals(path)
    assert cli.main(["record", "so101", "--excitation", str(path), "--dry-run", "--runs", str(tmp_path)]) == 0
    (folder,) = tmp_path.glob("so101/*/record")
    planned = read_log(folder / "session.mcap").outputs["agent"]["command"]
    start = np.array(load_module(ARM.name, "plant").SO101Plant().data.qpos)
    np.testing.assert_allclose(planned[0], start, atol=0.02)
    assert np.abs(np.diff(planned, axis=0)).max() * 50 < 8.0
    settled = int(np.ceil(np.abs(start - rows[0]).max() * 50)) + 1
    np.testing.assert_allclose(planned[settled : len(rows) - 5], rows[settled : len(rows) - 5], atol=1e-6)


def test_frequencies_beyond_the_rate_are_refused():
    with pytest.raises(UsageError, match="above half the command rate"):
        excitation(RecordConfig(high_hz=26.0), 50.0)


@pytest.mark.parametrize("kind", ["multisine", "chirp", "steps"])
def test_several_commands_are_independent_and_each_keeps_to_the_limits(kind):
    config = RecordConfig(excitation=kind, duration_s=30.0, amplitude=1.5, low_hz=0.7, high_hz=2.0, seed=3)
    signals = excitation(config, 50.0, commands=3)
    assert signals.shape == (1500, 3)
    np.testing.assert_array_equal(signals[0], np.zeros(3))
    ramp = 1.5 * np.minimum(1.0, np.arange(1500) / 25.0)
    assert (np.abs(signals) <= ramp[:, None] + 1e-12).all()
    assert (np.abs(signals).max(axis=0) > 1.3).all()
    power, hz = np.abs(np.fft.rfft(signals[:, 0])) ** 2, np.fft.rfftfreq(1500, 0.02)
    if kind != "steps":  # steps have edges
        assert power[(hz > 0.4) & (hz < 2.5)].sum() > 0.9 * power.sum()
    assert np.abs(signals - excitation(replace(config, seed=4), 50.0, commands=3)).max() > 0.5
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(signals[:, one] - signals[:, other]).max() > 0.5
        if kind != "chirp":  # two sweeps differ by a phase alone
            assert abs(np.corrcoef(signals[:, one], signals[:, other])[0, 1]) < 0.5
    np.testing.assert_array_equal(signals[:, 0], excitation(config, 50.0), "the first is what one command gets")
    np.testing.assert_array_equal(signals, excitation(config, 50.0, commands=3))
