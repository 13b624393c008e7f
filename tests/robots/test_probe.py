"""The delay between a command and its answer, from steps whose delay is known."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.hardware.device import OperatingMode
from sim2real.robots.probe import delays_of
from sim2real.stages.load import load_robot

T_S = np.arange(0.0, 0.16, 0.004)
COUNT_RAD = 2 * np.pi / 4096
POSITION = OperatingMode.POSITION


def answer(delay_s, rng, acceleration=24.0, jerk=-60.0):
    """Return an answer as an encoder of 12 bits gives it, sampled a little unevenly."""
    t_s = T_S + rng.uniform(0.0, 0.001, T_S.size)
    since = np.maximum(0.0, t_s - delay_s)
    motion = acceleration / 2 * since**2 + jerk / 6 * since**3
    return np.stack([t_s, np.round(motion / COUNT_RAD) * COUNT_RAD], axis=1)


@pytest.mark.parametrize("delay_s", [0.005, 0.020, 0.045, 0.060])
def test_the_delay_is_found(delay_s):
    rng = np.random.default_rng(0)
    found = delays_of([answer(delay_s, rng) for _ in range(8)])
    assert found.delay_s == pytest.approx(delay_s, abs=0.0015)
    assert found.jitter_s < 0.002


def test_answers_of_a_joint_that_came_to_rest_elsewhere_are_no_jitter():
    """Weight and friction help some steps and hinder others: their motion differs, not their delay."""
    rng = np.random.default_rng(3)
    found = delays_of([answer(0.045, rng, acceleration=a, jerk=-2.5 * a) for a in (44, 36, 29, 24, 22, 21, 20, 19)])
    assert found.delay_s == pytest.approx(0.045, abs=0.0015)
    assert np.ptp(found.delays_s) < 0.004


def test_jitter_is_told_from_delay():
    rng = np.random.default_rng(1)
    found = delays_of([answer(0.045 + off, rng) for off in rng.uniform(-0.02, 0.02, 16)])
    assert found.delay_s == pytest.approx(0.045, abs=0.008)
    assert 0.010 < found.jitter_s < 0.030


def test_a_fast_joint_without_a_delay_has_one_of_nothing():
    """It is beyond the fitted angle after four samples: the search had no delay to choose from."""
    rng = np.random.default_rng(0)
    found = delays_of([answer(0.0, rng, acceleration=400.0, jerk=0.0) for _ in range(8)])
    assert found.delay_s == pytest.approx(0.0, abs=0.004)


def answers_of(plant, step, mode, settings=()):
    """Step the first joint of a plant to and fro 30 ms late; return its answers as ``measure_delay`` samples them."""
    rng, ids, rows = np.random.default_rng(0), plant.servo_ids, []
    position = mode == POSITION
    rest = [plant.measure(i)[0] if position else 0.0 for i in ids]
    for servo_id, goal in zip(ids, rest, strict=True):
        plant.command(servo_id, mode, goal)
        if settings:
            plant.configure(servo_id, *settings)
    begin_s = 1.5
    plant.advance(begin_s)
    for k in range(8):
        sign = 1 if k % 2 == 0 else -1
        from_rad = plant.measure(ids[0])[0]
        plant.command(ids[0], mode, rest[0] + (step if sign == 1 else 0.0) if position else sign * step)
        late_s = 0.0005 * rng.integers(0, 3)
        answer = []
        for j in range(40):
            t_s = begin_s + 0.004 * j + late_s
            plant.advance(t_s)
            answer.append((t_s - begin_s + 0.03, sign * (plant.measure(ids[0])[0] - from_rad)))
        rows.append(np.array(answer))
        if not position:
            plant.command(ids[0], mode, 0.0)
        begin_s = round(begin_s + (0.8 if position else 3.2), 4)
        plant.advance(begin_s)
    return rows


@pytest.mark.parametrize(
    ("name", "arguments", "mode", "settings"),
    [
        pytest.param(*case, marks=() if case[0] == "arm" or case[1].get("friction") == 2.0 else pytest.mark.night)
        for case in (
            *(("arm", {"coulomb": [1.5 * f, 1.9 * f, 1.2 * f]}, POSITION, (800, 0, 5.0)) for f in (0.5, 1.0)),
            *(("so101", {"friction": f, "start": [0, -1.65, 1.6, -1.4, 0, -0.6]}, POSITION, ()) for f in (0.5, 2.0)),
            *(("pendulum", {"friction": f}, OperatingMode.PWM, ()) for f in (0.8, 3.2)),
        )
    ],
)
def test_the_lag_of_a_robot_holds_at_half_and_at_twice_its_friction(name, arguments, mode, settings):
    """It was one number, measured on the embedded robot, and decided on the real one."""
    drive = load_robot(name).drive
    plant = drive.embedded().plant(**arguments)
    step = drive.probe.step if mode == POSITION else drive.probe.step / 5.0
    found = replace(delays_of(answers_of(plant, step, mode, settings)), lag_s=drive.probe.lag_s)
    assert found.between_s[0] - 0.001 <= 0.03 <= found.between_s[1] + 0.001


def test_a_robot_that_does_not_answer_has_no_delay():
    rng = np.random.default_rng(2)
    with pytest.raises(Sim2RealError, match=r"(?s)does not answer the steps.*hint: "):
        delays_of([answer(0.045, rng, acceleration=0.1, jerk=0.0) for _ in range(8)])
