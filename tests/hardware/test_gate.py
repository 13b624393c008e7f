"""The gate: limits, slew, stale commands and stops; of plain commands and of those with columns."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.device import CommandColumn, CommandKind
from sim2real.hardware.safety.gate import GateConfig, GateLimits, SafetyGate

KIND = CommandKind.of_columns(
    "controllers",
    CommandColumn("q", "rad", "hold"),
    CommandColumn("kp", "N m/rad", "zero"),
    CommandColumn("kd", "N m s/rad", 3.0),
)
LOW, HIGH = [-1.0, 0.0, 0.0], [1.0, 50.0, 5.0]
SENT = np.array([[0.5, 20.0, 1.0], [-0.5, 30.0, 1.0]])
COLUMNS = {"limit": (LOW, HIGH), "stale": KIND.stale, "slew_per_s": (1.0, math.inf, math.inf)}


def started(start, **config):
    gate = SafetyGate(GateConfig(**config))
    gate.reset(np.array(start))
    return gate


def holding(start, **config):
    return started(start, **{"limit": (0.2, 1.0), "stale": "hold", **config})


@pytest.mark.parametrize(
    ("limit", "command", "allowed"),
    [
        (0.5, [2.0, -2.0, 0.1], [0.5, -0.5, 0.1]),
        ((-0.2, 0.5), [2.0, -2.0], [0.5, -0.2]),
        (([-1.0, -0.2], np.array([0.5, 2.0])), [3.0, 3.0], [0.5, 2.0]),
        (([-1.0, -0.2], 0.1), [-3.0, 3.0], [-1.0, 0.1]),
    ],
)
def test_commands_are_clamped(limit, command, allowed):
    gate = SafetyGate(GateConfig(limit=limit))
    assert gate.apply(np.array(command), 0.0, 0.0).tolist() == allowed
    gate.apply(np.zeros(len(command)), 0.0, 0.1)
    assert (gate.counts.clamped, gate.counts.passed) == (1, 2)


def test_slew_starts_at_zero_and_follows_the_clock():
    gate = SafetyGate(GateConfig(slew_per_s=10.0))
    outputs = []
    for k in range(7):
        sent = gate.apply(np.array([1.0]), 0.0, 0.02 * k)
        outputs.append(float(sent[0]))
        sent[:] = 100.0  # the caller's own
    assert outputs == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.0])
    assert gate.counts.slewed == 5
    assert gate.apply(np.array([-1.0]), 0.0, 0.11)[0] == pytest.approx(1.0)  # a clock that went back allows no change


def test_a_stale_command_becomes_zero_at_once():
    gate = SafetyGate(GateConfig(slew_per_s=1.0, command_timeout_s=0.1))
    gate.apply(np.array([1.0]), 0.0, 0.0)
    ages = (0.1, 0.1001, math.nan)
    assert [gate.apply(np.array([1.0]), age, 0.5 + 0.1 * i)[0] for i, age in enumerate(ages)] == [0.5, 0.0, 0.0]
    assert gate.counts.stale == 2


def test_a_stale_command_holds_what_was_allowed_last():
    gate = holding([0.3])
    sent = [gate.apply(np.array([wanted]), age, now) for wanted, age, now in ((0.9, 0.2, 0), (0.9, 0, 0), (0.4, 9, 1))]
    assert sent == [0.3, 0.9, 0.9]
    assert gate.fallback == 0.9
    assert gate.counts.stale == 2


def test_each_column_has_its_limits_its_slew_and_what_replaces_a_stale_one():
    gate = started(SENT, **COLUMNS)
    gate.apply(SENT, 0.0, 0.0)
    out = gate.apply(np.array([[2.0, 90.0, -1.0], [-0.5, 10.0, 2.0]]), 0.0, 0.05)
    np.testing.assert_allclose(out, [[0.55, 50.0, 0.0], [-0.5, 10.0, 2.0]])
    assert (gate.counts.clamped, gate.counts.slewed) == (1, 1)
    np.testing.assert_allclose(gate.apply(np.zeros((2, 3)), 0.2, 0.06), [[0.55, 0.0, 3.0], [-0.5, 0.0, 3.0]])
    assert gate.counts.stale == 1


@pytest.mark.parametrize(
    ("command", "age_s", "speeds", "message"),
    [
        ([0.0, math.nan], 0.0, [0.0, 0.0], r"node 'motor' stopped: command\[1\] = .*nan"),
        ([0.0, -math.inf], 1.0, [0.0, 0.0], r"command\[1\] = .*inf"),  # stale, too
        ([0.0, 0.0], 0.0, [9.9, -10.1], r"speed_rad_s\[1\] = -10.1"),
        ([0.0, 0.0], 0.0, [math.nan, 0.0], "speed_rad_s"),
    ],
)
def test_what_stops_the_robot_by_name_until_a_reset(command, age_s, speeds, message):
    gate = SafetyGate(GateConfig(node="motor", max_speed_rad_s=10.0))
    gate.apply(np.zeros(2), 0.0, 0.0, np.array([10.0, -9.9]))
    with pytest.raises(SafetyStop, match=message):
        gate.apply(np.array(command), age_s, 0.1, np.array(speeds))
    with pytest.raises(SafetyStop):
        gate.apply(np.zeros(2), 0.0, 0.2)
    gate.reset()
    assert gate.apply(np.zeros(2), 0.0, 0.3).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"limit": -1.0}, "limit"),
        ({"limit": (0.1, 0.5)}, "limit"),
        ({"limit": ([-1.0, 0.1], 1.0)}, "limit"),
        ({"limit": ([-1.0, -1.0], [1.0, 1.0, 1.0])}, "limit"),
        ({"limit": ([-1.0, math.nan], 1.0), "stale": "hold"}, "limit"),
        ({"limit": (0.5, 0.1), "stale": "hold"}, "limit"),
        ({"limit": (LOW[:2], HIGH[:2]), "stale": KIND.stale}, "limits for 2 of 3 columns"),
        ({"limit": (LOW, [1.0, 50.0, 2.0]), "stale": KIND.stale}, "does not contain .*3.0"),
        ({"limit": ([-1.0, 1.0, 0.0], HIGH), "stale": KIND.stale}, "does not contain"),
        ({"slew_per_s": 0.0}, "slew_per_s"),
        ({"command_timeout_s": 0.0}, "command_timeout_s"),
        ({"max_speed_rad_s": (1.0, -1.0)}, "max_speed_rad_s"),
        ({"envelope_rad": (1.0, -1.0)}, "holds no position"),
        ({"max_sample_age_s": 0.0}, "max_sample_age_s"),
        ({"freeze_s": 0.0}, "freeze_s"),
        ({"freeze_rad_s": -1.0}, "freeze_rad_s"),
    ],
)
def test_limits_that_make_no_sense_are_refused(config, message):
    with pytest.raises(UsageError, match=message):
        GateConfig(**config)


@pytest.mark.parametrize("limits", [{"stop_s": 0.0}, {"servo_watchdog_s": 0.01}, {"servo_watchdog_s": 2.6}])
def test_limits_of_a_stage_are_refused_and_become_those_of_a_gate(limits):
    with pytest.raises(UsageError, match=next(iter(limits))):
        GateLimits(**limits)
    gate = GateLimits(envelope_rad=(-1.0, 2.0), stop_s=0.3, max_sample_age_s=0.4, servo_watchdog_s=0.02).gate(
        1.0, joints=("a",)
    )
    assert (gate.envelope_rad, gate.stop_s, gate.max_sample_age_s) == ((-1.0, 2.0), 0.3, 0.4)
    assert (gate.slew_per_s, gate.joints) == (400.0, ("a",))


@pytest.mark.parametrize(
    ("make", "command", "message"),
    [
        (lambda: SafetyGate(GateConfig(limit=([-1.0, -1.0], 1.0))), np.zeros(1), r"\(1,\), limits or start of \(2,\)"),
        (lambda: holding([0.5, 0.5]), np.zeros(1), "shape"),
        (lambda: holding([0.5, 0.5], limit=([0.0] * 3, 1.0)), None, "shape"),
        (lambda: started(np.zeros(3), **COLUMNS), None, r"shape \(3,\), not \(n, 3\)"),
        (lambda: SafetyGate(GateConfig()), np.zeros((2, 3)), r"shape \(2, 3\), not \(n,\)"),
        (lambda: SafetyGate(GateConfig(stale="hold")), np.zeros(1), r"(?s)nothing to hold.*reset\(start\)"),
    ],
)
def test_another_number_of_commands_than_of_limits_is_refused(make, command, message):
    with pytest.raises(UsageError, match=message):
        make().apply(command, 0.0, 0.0)


def test_a_value_that_is_no_number_is_named_by_its_place():
    with pytest.raises(SafetyStop, match=r"start\[0\] = nan"):
        holding([math.nan])
    bad = SENT.copy()
    bad[1, 2] = math.nan
    with pytest.raises(SafetyStop, match=r"command\[1, 2\] = nan"):
        started(SENT, **COLUMNS).apply(bad, 0.0, 0.0)


@pytest.mark.parametrize(
    ("stale", "sent", "pushed"),
    [
        ("zero", [0.0, -0.1], [False, True]),
        ("hold", [0.0, -0.1], [True, True]),
        # Goal, gain and damping: without a gain the damping is what replaces a stale command.
        (KIND.stale, [[0.5, 0.0, 3.0], [0.5, 20.0, 3.0]], [False, True]),
    ],
)
def test_a_joint_is_pushed_by_a_command_that_is_not_the_one_of_rest(stale, sent, pushed):
    limit = (LOW, HIGH) if isinstance(stale, tuple) else 1.0
    assert GateConfig(limit, stale=stale).pushes(np.array(sent)).tolist() == pushed


@given(
    start=st.floats(-3.0, 3.0),
    calls=st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(0.0, 0.2), st.floats(-0.1, 1.0)), min_size=1, max_size=30),
)
def test_a_gate_that_holds_never_jumps_nor_moves_away_from_its_limits(start, calls):
    low, high, slew_per_s, timeout_s = np.array([-0.5, 0.2]), np.array([1.0, 0.4]), 2.0, 0.1
    gate = holding([start, 0.3], limit=(low, high), slew_per_s=slew_per_s, command_timeout_s=timeout_s)
    last, now_s = np.array([start, 0.3]), 5.0
    for index, (wanted, age_s, elapsed_s) in enumerate(calls):
        now_s += elapsed_s
        allowed = gate.apply(np.array([wanted, -wanted]), age_s, now_s)
        reach = 0.0 if index == 0 or age_s > timeout_s else slew_per_s * min(max(elapsed_s, 0.0), timeout_s)
        assert np.all(np.abs(allowed - last) <= reach + 1e-9)

        def outside(command):
            return np.maximum(np.maximum(low - command, command - high), 0.0)

        assert np.all(outside(allowed) <= outside(last))
        last = allowed
    assert gate.counts.passed == len(calls)
