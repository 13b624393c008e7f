"""The delay between a command and its answer, from steps whose delay is known."""

import numpy as np
import pytest

from sim2real.errors import Sim2RealError
from sim2real.robots.probe import delays_of

T_S = np.arange(0.0, 0.16, 0.004)
COUNT_RAD = 2 * np.pi / 4096


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


def test_a_robot_that_does_not_answer_has_no_delay():
    rng = np.random.default_rng(2)
    with pytest.raises(Sim2RealError, match=r"(?s)does not answer the steps.*hint: "):
        delays_of([answer(0.045, rng, acceleration=0.1, jerk=0.0) for _ in range(8)])
