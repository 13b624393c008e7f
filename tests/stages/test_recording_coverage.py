"""What a recording shows of a robot, told from arrays alone."""

import numpy as np
import pytest

from sim2real.stages.check.stage import motion_of, sampling, speed

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
