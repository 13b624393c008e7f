"""What numbers say by themselves: lags, orders, signs, units, encoders."""

import followers
import numpy as np
import pytest

from sim2real.log.importing import command_response, evidence


@pytest.fixture(scope="module")
def recorded():
    return followers.motion()


def found(t, goal, q):
    held, joined, period_s = command_response.on_grid(t, goal, t, q)
    return command_response.following(held, joined, period_s)


def test_lag_slope_and_correlation_are_those_of_the_recording(recorded):
    t, goal, q = recorded
    f = found(t, goal, 2.0 * q)
    np.testing.assert_allclose(np.diag(f.lag_s), followers.LATE_S, atol=1e-3)
    np.testing.assert_allclose(np.diag(f.slope), 2.0, rtol=0.02)
    assert np.diag(f.r).min() > 0.99
    assert np.abs(f.r - np.diag(np.diag(f.r))).max() < 0.7


def test_lags_between_samples_are_seen(recorded):
    t, goal, q = recorded
    f = found(t, goal[:, :1], np.interp(t - 0.0022, t, q[:, 0])[:, None])
    assert float(f.lag_s[0, 0]) == pytest.approx(followers.LATE_S + 0.0022, abs=4e-4)


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 0, 2]])
def test_the_order_of_commands_is_found(recorded, order):
    t, goal, q = recorded
    places = evidence.order(found(t, goal[:, order], q))
    assert [order[p] for p in places] == [0, 1, 2]


def test_commands_that_are_alike_keep_their_order(recorded):
    t, goal, q = recorded
    same = np.repeat(goal[:, :1], 3, axis=1)
    np.testing.assert_array_equal(evidence.order(found(t, same, np.repeat(q[:, :1], 3, axis=1))), [0, 1, 2])


def test_a_joint_that_rests_follows_nothing(recorded):
    t, goal, q = recorded
    still = q.copy()
    still[:, 1] = 0.3
    f = found(t, goal, still)
    assert not f.moved[1].any()
    assert not f.r[1].any()


def test_torque_that_is_off_says_nothing(recorded):
    t, goal, q = recorded
    acting = t < 6.0
    fallen = np.where(acting[:, None], q, -1.5)
    held, joined, period_s = command_response.on_grid(t, goal, t, fallen, acting)
    assert np.diag(command_response.following(held, joined, period_s).r).min() > 0.97


@pytest.mark.parametrize(
    ("slopes", "ratio"),
    [([0.9, -1.1], 1.0), ([55.0], evidence.DEGREES), ([0.015], 1 / evidence.DEGREES), ([650.0], None), ([], None)],
)
def test_ratios_of_units(slopes, ratio):
    assert evidence.unit_ratio(np.array(slopes)) == ratio


def test_an_encoders_steps_tell_its_unit(recorded):
    q = recorded[2][:, 0]
    step = 2 * np.pi / 4096
    rounded = np.round(q / step) * step
    assert evidence.turn(rounded) == ("rad", 4096)
    assert evidence.turn(np.degrees(rounded)) == ("deg", 4096)
    assert evidence.turn(q) is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda goal: goal, []),
        (lambda goal: goal[:, [1, 0, 2]], ["joint 0 follows the command of joint 1", "joint 1 follows the command"]),
        (lambda goal: goal * [1, 1, -1], ["joint 2 moves against its command"]),
        (lambda goal: np.degrees(goal), ["one is in degrees"] * 3),
    ],
)
def test_contradictions_are_named(recorded, change, said):
    t, goal, q = recorded
    told = evidence.contradictions((t, t), change(goal), q)
    assert len(told) == len(said)
    assert all(s in line for s, line in zip(said, told, strict=True))


def test_a_clock_that_is_ahead_is_named(recorded):
    t, goal, q = recorded
    assert "before its command" in evidence.contradictions((t + 0.2, t), goal, q)[0]


def test_the_grid_of_dated_stamps_does_not_drift():
    """Dates in float64 are rounded to 0.24 us, and the median step is off by half of that."""
    t = (1_700_000_000_000_000_000 + 5_000_000 * np.arange(20_000)) * 1e-9
    values = np.arange(20_000.0)[:, None]
    held, joined, period = command_response.on_grid(t, values, t, values)
    assert period == pytest.approx(0.005, abs=1e-10)
    np.testing.assert_allclose(held, joined, atol=1e-3)
