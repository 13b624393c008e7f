"""What data can refuse: goals and positions that contradict a mapping, each a recording with one fault."""

import numpy as np
import pytest
from foreign_robots import motion, servo

from sim2real.log.importing import checks

T, GOAL, Q = motion(20.0, joints=3)
NAMES = ("a", "b", "c")


def findings(goal=GOAL, q=Q, t_goal=T, t_q=T, by_name=True):
    """Return kind, joint and weight of what the check finds, apart from notes."""
    found = checks.check((t_goal, t_q), goal, q, NAMES, by_name)
    return [(f.name, f.joint, f.weight) for f in found if f.weight != "note"]


@pytest.mark.parametrize("by_name", [True, False])
def test_a_right_recording_has_no_finding(by_name):
    assert findings(by_name=by_name) == []


@pytest.mark.parametrize("count", [51, 60, 120, 300])
def test_a_short_recording_is_checked_too(count):
    assert {f[2] for f in findings(GOAL[:count], Q[:count], T[:count], T[:count])} <= {"warn", "ask"}


def test_goals_while_nothing_acts_are_not_compared():
    acting = T > 6.0
    goal = np.where(acting[:, None], GOAL, 5.0)
    assert [f for f in checks.check((T, T), goal, Q, NAMES, True, acting) if f.weight == "refuse"] == []
    found = checks.check((T, T), goal * [1, -1, 1], Q, NAMES, True, acting)
    assert [(f.name, f.joint) for f in found if f.weight == "refuse"] == [("sign", 1)]


@pytest.mark.parametrize(("factor", "known"), [(1.0, True), (57.3, False), (0.5, False), (-1.0, False), (0.0, False)])
def test_velocities_are_the_rate_of_positions_in_the_same_unit(factor, known):
    assert checks.is_rate(T, Q, factor * np.gradient(Q, T, axis=0)) is known
    assert checks.is_rate(T[:49], Q[:49], np.gradient(Q, T, axis=0)[:49]) is False


def test_joints_that_follow_other_goals_are_refused():
    assert findings(GOAL[:, [1, 0, 2]]) == [("order", 0, "refuse"), ("order", 1, "refuse")]


def test_goals_that_cannot_be_told_apart_are_asked_only_without_names():
    """Each joint moves by the same sine, at another phase."""
    goal = np.stack([0.4 * np.sin(9 * T + phase) for phase in (0.0, 0.5, 1.0)], axis=1)
    q = np.stack([servo(T, column) for column in goal.T], axis=1)
    assert {weight for kind, _, weight in findings(goal, q, by_name=False) if kind == "order"} == {"ask"}
    assert [f for f in findings(goal, q) if f[0] == "order"] == []


def test_a_joint_that_moves_against_its_goal_is_refused():
    assert findings(GOAL * [1, -1, 1]) == [("sign", 1, "refuse")]


def test_the_sign_of_a_tone_is_asked_and_its_level_answers():
    """A sine of 3 Hz that is half a period later is its opposite."""
    goal = 0.4 * np.sin(2 * np.pi * 3.0 * T[:, None] + np.arange(3))
    q = np.stack([servo(T, column, wn=120.0) for column in goal.T], axis=1)
    assert {f[0] for f in findings(goal, q)} == {"sign"}
    assert findings(goal + 0.5, q + 0.5) == []


@pytest.mark.parametrize(("slope", "weight"), [(0.3, "ask"), (2.5, "ask"), (57.3, "refuse"), (0.0175, "refuse")])
def test_a_slope_that_no_servo_has_is_asked_or_refused(slope, weight):
    assert ("slope", 2, weight) in findings(q=Q * [1, 1, slope])


def test_one_column_in_another_unit_is_refused():
    """Both sides of a gripper are in percent."""
    scale = np.array([1, 1, 57.3])
    assert findings(GOAL * scale, Q * scale) == [("scale", 2, "refuse")]


def test_positions_that_move_before_their_goals_are_refused():
    assert {f[0] for f in findings(np.roll(GOAL, 60, axis=0))} <= {"lag", "follows"}
    assert ("lag", 0, "refuse") in findings(np.roll(GOAL, 60, axis=0))


@pytest.mark.parametrize("shift", [0, 1, -3, 40])
def test_goals_that_are_copies_are_refused(shift):
    assert {f[0] for f in findings(np.roll(Q, shift, axis=0))} == {"copy"}


@pytest.mark.parametrize(("rate", "weight"), [(0.98, "refuse"), (1.02, "refuse"), (1.004, "warn"), (0.996, "warn")])
def test_a_clock_of_another_rate_is_found(rate, weight):
    assert ("clock", -1, weight) in findings(t_q=T * rate)
    half = slice(len(T) // 2)
    assert "clock" in {f[0] for f in findings(GOAL[half], Q[half], T[half], T[half] * rate)}


@pytest.mark.parametrize(("step_s", "weight"), [(0.4, "refuse"), (-0.06, "warn")])
def test_a_clock_that_was_set_in_between_is_found(step_s, weight):
    assert ("clock", -1, weight) in findings(t_goal=T + step_s * (T > 10.0))


def test_streams_that_overlap_in_a_small_part_are_refused():
    """A short part follows by chance."""
    assert findings(t_goal=T + 17.0) == [("overlap", -1, "refuse")]


@pytest.mark.parametrize("apart_s", [-4.0, 5.0])
def test_clocks_that_are_set_apart_are_refused_with_the_seconds(apart_s):
    (found,) = [f for f in checks.check((T + apart_s, T), GOAL, Q, NAMES) if f.weight == "refuse"]
    lag_s = float(found.text.split()[4])
    assert (found.name, 0.0 < lag_s + apart_s < 0.3) == ("overlap", True)


@pytest.mark.parametrize("rate", [0.98, 1.02])
def test_a_clock_of_another_rate_is_found_in_a_short_gait(rate):
    """A motion that repeats follows its goal at many lags."""
    t = T[:1600]
    goal = 0.4 * np.sin(2 * np.pi * 2.2 * t[:, None] + np.arange(3)) + 0.1 * np.sin(4 * np.pi * 2.2 * t[:, None])
    q = np.stack([servo(t, column, wn=60.0) for column in goal.T], axis=1)
    assert [f for f in findings(goal, q, t, t) if f[0] == "clock"] == []
    assert "clock" in {f[0] for f in findings(goal, q, t, t * rate)}


@pytest.mark.parametrize("side", ["reading", "goal"])
@pytest.mark.parametrize("size", [0.05, -0.3])
def test_a_zero_that_steps_is_named_with_its_time(side, size):
    step = size * (T >= 9.0)[:, None] * np.array([0, 1, 0])
    goal, q = (GOAL, Q + step) if side == "reading" else (GOAL + step, Q)
    (found,) = [f for f in checks.check((T, T), goal, q, NAMES) if f.name == "zero"]
    assert found.joint == 1
    assert found.weight == ("refuse" if side == "reading" and abs(size) > 0.1 else "warn")
    assert "9.0" in found.text


@pytest.mark.parametrize(("size", "weight"), [(0.005, "warn"), (0.02, "refuse")])
def test_the_zero_of_a_slide_is_judged_in_its_own_unit(size, weight):
    q = 0.1 * Q + size * (T >= 9.0)[:, None] * np.array([0, 1, 0])
    (found,) = [f for f in checks.check((T, T), 0.1 * GOAL, q, NAMES, unit="m") if f.name == "zero"]
    assert (found.joint, found.weight, f"{size:+.3f} m from 9.00 s" in found.text) == (1, weight, True)


def test_the_zero_of_a_joint_that_is_held_may_step_too():
    rest = np.array([1, 0, 1])
    q = Q * rest + 0.2 * (T >= 9.0)[:, None] * np.array([0, 1, 0])
    assert ("zero", 1, "refuse") in findings(GOAL * rest, q)


def test_joints_that_stay_outside_of_their_ranges_are_named():
    ranges = {"a": (-1.0, 1.0), "b": (-2.7, -0.8)}
    assert [f.joint for f in checks.beyond(Q, NAMES, ranges)] == [1]
    assert checks.beyond(Q, NAMES, {}) == []


@pytest.mark.parametrize("size", [0.05, 0.3])
@pytest.mark.parametrize("seconds", [(4.0, 9.0, 15.0), (4.0, 15.0)])
def test_a_zero_that_steps_several_times_is_named_with_each(size, seconds):
    q = Q + size * np.sum([at <= T for at in seconds], axis=0)[:, None] * np.array([0, 1, 0])
    (found,) = [f for f in checks.check((T, T), GOAL, q, NAMES) if f.name == "zero"]
    assert (found.joint, all(f"{at:.2f} s" in found.text for at in seconds)) == (1, True)


@pytest.mark.parametrize("size", [0.06, 0.5, 6.28])
def test_a_slip_and_a_turn_of_the_goals_are_said_also_where_nothing_follows(size):
    slip = size * np.clip((T - 8.0) / 4.0, 0, 1)[:, None] * np.array([0, 1, 0])
    turn = size * (T >= 9.0)[:, None] * np.array([0, 1, 0])
    for goal, q in ((GOAL, Q + slip), (GOAL + turn, Q)):
        assert [f.joint for f in checks.check((T, T), goal, q, NAMES) if f.name == "zero"] == [1]


def test_an_offset_at_rest_is_said():
    assert findings(q=Q + np.array([0, 0, 0.12])) == [("offset", 2, "warn")]
    assert findings(q=Q + np.array([0, 0, 1.5])) == [("offset", 2, "ask")]
    assert "offset" in checks.hint_for(checks.check((T, T), GOAL, Q + np.array([0, 0, 1.5]), NAMES)[-1:])


def test_commands_that_are_too_slow_for_the_motion_are_said():
    t = np.arange(0, 20, 0.004)
    rng = np.random.default_rng(0)
    goal = 0.08 * np.sin(2 * np.pi * np.outer(t, rng.uniform(0.2, 12, 10)) + rng.uniform(0, 6, 10)).sum(axis=1)
    q = servo(t, goal, wn=60.0)
    found = checks.check((t[::25], t), goal[::25, None], q[:, None], ("a",))
    assert "rate" in {f.name for f in found}
    found = checks._rates((t[::25], t), goal[::25, None], q[:, None])
    assert [f.name for f in found] == ["rate"]
    assert checks._rates((t[::2], t), goal[::2, None], q[:, None]) == []
    at = np.flatnonzero(rng.random(len(t)) < 0.08)  # 20 a second, irregular
    assert [f.name for f in checks._rates((t[at], t), goal[at, None], q[:, None])] == ["rate"]


def test_a_joint_that_rests_is_said_and_one_held_elsewhere_is_asked():
    rest = np.array([1, 0, 1])
    assert findings(GOAL * rest, Q * rest) == [("still", 1, "warn")]
    assert findings(0 * GOAL, 0 * Q) == [("still", i, "warn") for i in range(3)]
    away = np.array([0, 1.0, 0])
    assert findings(GOAL * rest + away, Q * rest - away) == [("sign", 1, "ask")]


@pytest.mark.parametrize(
    ("counts", "modulus"),
    [
        (lambda q: q % (1 << 16), 1 << 16),
        (lambda q: q % (1 << 32), 1 << 32),
        (lambda q: np.where(q < 0, (1 << 15) - q, q), 1 << 15),
        (lambda q: np.where(q < 0, (1 << 31) - q, q), 1 << 31),
    ],
)
def test_signed_counts_that_were_read_as_unsigned_are_found(counts, modulus):
    q = np.round(800 * np.sin(T))
    assert checks.unsigned(counts(q)) == modulus
    assert checks.unsigned(q) is None
    assert checks.unsigned(q + 2048) is None


@pytest.mark.parametrize(("low", "unit"), [(-np.pi, 2 * np.pi), (0.0, 360.0)])
def test_turns_are_counted(low, unit):
    angle = (0.8 * T + np.sin(T))[:, None] * unit / (2 * np.pi)
    written = (angle - low) % unit + low
    counted = checks.counted(written, unit)
    np.testing.assert_allclose(counted - counted[0], angle - angle[0], atol=1e-9)
    assert (counted != written).any(axis=0).all()
    np.testing.assert_array_equal(checks.counted(angle % (2 * unit), unit), angle % (2 * unit))


def test_leaps_away_and_back_are_found_and_others_kept():
    q = Q.copy()
    q[[300, 301, 900], 1] = -3.0
    found = checks.glitches(T, q)
    assert np.argwhere(found).tolist() == [[300, 1], [301, 1], [900, 1]]
    assert checks.leap(T, Q) is None
    q = Q + 2.0 * (T > 5.0)[:, None] * np.array([0, 0, 1])
    assert not checks.glitches(T, q).any()
    assert checks.leap(T, q)[1:] == (2, pytest.approx(2.0, abs=0.05))
