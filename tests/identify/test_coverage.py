"""What a recording shows of a robot, told from arrays alone."""

import numpy as np
import pytest

from sim2real.identify.uncertainty.recording_coverage import band, motion, motion_of, sampling, speed, spread

T = np.arange(0, 40, 0.02)


def test_gaps_are_counted_and_the_longest_is_told():
    t = np.delete(T, np.r_[100:110, 500:600])
    found = sampling(t)
    assert (found.samples, found.gaps) == (len(T) - 110, 2)
    assert found.rate_hz == pytest.approx(50.0)
    assert found.longest_gap_s == pytest.approx(2.02)
    assert found.duration_s == pytest.approx(39.98)


def test_one_sample_has_no_rate():
    assert sampling(np.array([1.0])).rate_hz == 0.0


def test_a_uniform_signal_covers_its_range_and_a_spike_does_not():
    even = spread(np.linspace(-1, 3, 1000))
    assert (even.low, even.high, even.covered) == (-1.0, 3.0, 1.0)
    np.testing.assert_allclose(even.shares, 0.1)
    spiked = spread(np.r_[np.zeros(999), 5.0])
    assert spiked.covered == pytest.approx(0.1)
    assert sum(spiked.shares) == pytest.approx(1.0)


def test_a_constant_does_not_move():
    still = spread(np.full(50, 2.0))
    assert not still.moves
    assert still.covered == pytest.approx(0.1)
    assert motion(np.zeros(50)).moving == 0.0
    assert band(T, np.full(len(T), 2.0)) is None


def test_motion_is_told_from_noise():
    rng = np.random.default_rng(0)
    noise = rng.normal(scale=0.05, size=len(T))
    assert motion(noise, 0.05).moving < 0.01
    half = np.where(T < 20, 2.0, 0.0) + noise
    found = motion(half, 0.05)
    assert found.moving == pytest.approx(0.5, abs=0.02)
    assert found.forward == pytest.approx(1.0, abs=0.01)


def test_both_directions_and_reversals():
    found = motion(np.sin(2 * np.pi * 0.5 * T))
    assert found.forward == pytest.approx(0.5, abs=0.01)
    assert found.reversals == 39


def test_speed_of_a_position_survives_equal_stamps():
    assert speed(T, 3.0 * T)[100] == pytest.approx(3.0)
    t = T.copy()
    t[50] = t[49]
    assert np.isfinite(speed(t, 3.0 * T)).all()
    assert speed(T[:2], T[:2]).tolist() == [0.0, 0.0]


@pytest.mark.parametrize("hz", [0.5, 2.0, 7.0])
def test_the_band_of_a_sine_is_narrow(hz):
    found = band(T, 4.0 + np.sin(2 * np.pi * hz * T))
    assert found is not None
    assert found.low_hz == pytest.approx(hz, abs=0.1)
    assert found.high_hz == pytest.approx(hz, abs=0.1)


def test_the_band_of_a_sweep_is_that_of_the_sweep_at_irregular_times_too():
    rng = np.random.default_rng(1)
    t = T + rng.uniform(0, 0.004, len(T))
    found = band(t, np.sin(2 * np.pi * (1.0 * t + 0.05 * t**2)))  # 1 to 5 Hz
    assert found is not None
    assert 1.0 < found.low_hz < 2.0
    assert 4.0 < found.high_hz < 5.2


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
    found = motion_of(*moved(amplitude, hz, rate_hz, noise, step))
    assert found.moving == pytest.approx(moving, abs=0.09 if moving else 1e-9)
    if moving:
        assert found.forward == pytest.approx(0.5, abs=0.05)


def test_a_joint_that_moves_half_of_the_time():
    t, q = moved(0.1, 0.5, noise=1e-4)
    found = motion_of(t, np.where(t < 10, q, q[0]) + 1e-4 * np.random.default_rng(1).normal(size=len(t)))
    assert found.moving == pytest.approx(0.48, abs=0.03)


def test_glitches_are_no_motion_and_hide_none():
    t, q = moved(0.0, 1.0, noise=1e-4)
    q[::500] = -3.14
    assert motion_of(t, q).moving < 0.1
    t, q = moved(0.1, 0.5, noise=1e-4)
    q[::500] = np.nan
    assert motion_of(t, q).moving > 0.9
