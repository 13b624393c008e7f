import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.safety.gate import GateConfig, GateLimits, SafetyGate


def test_clamping_symmetric_and_not():
    gate = SafetyGate(GateConfig(limit=0.5))
    assert gate.apply(np.array([2.0, -2.0, 0.1]), 0.0, 0.0).tolist() == [0.5, -0.5, 0.1]
    gate = SafetyGate(GateConfig(limit=(-0.2, 0.5)))
    assert gate.apply(np.array([2.0, -2.0]), 0.0, 0.0).tolist() == [0.5, -0.2]
    assert gate.counts.clamped == 1


def test_slew_starts_at_zero_and_follows_the_clock():
    gate = SafetyGate(GateConfig(slew_per_s=10.0))
    outputs = [float(gate.apply(np.array([1.0]), 0.0, 0.02 * k)[0]) for k in range(7)]
    assert outputs == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.0])
    assert gate.counts.slewed == 5
    assert gate.apply(np.array([-1.0]), 0.0, 0.11)[0] == pytest.approx(1.0)  # a clock that went back allows no change


def test_stale_command_becomes_zero_at_once_and_is_counted():
    gate = SafetyGate(GateConfig(slew_per_s=1.0, command_timeout_s=0.1))
    gate.apply(np.array([1.0]), 0.0, 0.0)
    assert gate.apply(np.array([1.0]), 0.1, 0.5)[0] == 0.5
    assert gate.apply(np.array([1.0]), 0.1001, 0.6)[0] == 0.0
    assert gate.apply(np.array([1.0]), float("nan"), 0.7)[0] == 0.0
    assert gate.counts.stale == 2


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_command_that_is_no_number_stops_by_name_and_stays_stopped(bad):
    gate = SafetyGate(GateConfig(node="motor"))
    with pytest.raises(SafetyStop, match=r"node 'motor' stopped: command\[1\] = .*(nan|inf)"):
        gate.apply(np.array([0.0, bad]), 0.0, 0.0)
    with pytest.raises(SafetyStop):
        gate.apply(np.array([0.0, 0.0]), 0.0, 0.1)
    gate.reset()
    assert gate.apply(np.array([0.0, 0.0]), 0.0, 0.2).tolist() == [0.0, 0.0]


def test_output_is_the_callers_own():
    gate = SafetyGate(GateConfig(slew_per_s=1.0))
    gate.apply(np.ones(1), 0.0, 0.0)[:] = 100.0
    assert gate.apply(np.ones(1), 0.0, 0.1)[0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("command", "age_s", "speeds", "message"),
    [
        ([0.0, 0.0], 0.0, [9.9, -10.1], r"speed_rad_s\[1\] = -10.1"),
        ([0.0, 0.0], 0.0, [float("nan"), 0.0], "speed_rad_s"),
        ([0.0, float("nan")], 1.0, [0.0, 0.0], r"command\[1\]"),  # stale, too
    ],
)
def test_what_stops_the_robot(command, age_s, speeds, message):
    gate = SafetyGate(GateConfig(max_speed_rad_s=10.0))
    gate.apply(np.zeros(2), 0.0, 0.0, np.array([9.9, -9.9]))
    with pytest.raises(SafetyStop, match=message):
        gate.apply(np.array(command), age_s, 0.1, np.array(speeds))


@pytest.mark.parametrize(
    "bad",
    [
        {"limit": -1.0},
        {"limit": (0.1, 0.5)},
        {"slew_per_s": 0.0},
        {"command_timeout_s": 0.0},
        {"max_speed_rad_s": -1.0},
        {"limit": ([-1.0, 0.1], 1.0)},
        {"limit": ([-1.0, -1.0], [1.0, 1.0, 1.0])},
        {"limit": ([-1.0, float("nan")], 1.0), "stale": "hold"},
        {"limit": (0.5, 0.1), "stale": "hold"},
    ],
)
def test_limits_that_make_no_sense(bad):
    with pytest.raises(UsageError, match=next(iter(bad))):
        SafetyGate(GateConfig(**bad))


def test_limits_per_actuator():
    gate = SafetyGate(GateConfig(limit=([-1.0, -0.2], np.array([0.5, 2.0]))))
    assert gate.apply(np.array([3.0, 3.0]), 0.0, 0.0).tolist() == [0.5, 2.0]
    assert gate.apply(np.array([-3.0, -3.0]), 0.0, 0.0).tolist() == [-1.0, -0.2]
    assert SafetyGate(GateConfig(limit=([-1.0, -0.2], 0.1))).apply(np.ones(2), 0.0, 0.0).tolist() == [0.1, 0.1]


def holding(start, **config):
    gate = SafetyGate(GateConfig(**{"limit": (0.2, 1.0), "stale": "hold", **config}))
    gate.reset(np.array(start))
    return gate


def test_another_number_of_commands_than_of_limits_is_refused():
    with pytest.raises(UsageError, match=r"shape \(1,\), limits or start of \(2,\)"):
        SafetyGate(GateConfig(limit=([-1.0, -1.0], 1.0))).apply(np.zeros(1), 0.0, 0.0)
    with pytest.raises(UsageError, match="shape"):
        holding([0.5, 0.5]).apply(np.zeros(1), 0.0, 0.0)
    with pytest.raises(UsageError, match="shape"):
        holding([0.5, 0.5], limit=([0.0] * 3, 1.0))


def test_a_gate_that_holds_must_know_where_it_starts():
    with pytest.raises(UsageError, match=r"(?s)nothing to hold.*reset\(start\)"):
        SafetyGate(GateConfig(stale="hold")).apply(np.zeros(1), 0.0, 0.0)
    with pytest.raises(SafetyStop, match=r"start\[0\] = nan"):
        holding([float("nan")])


def test_stale_holds_what_was_allowed_last_and_is_counted():
    gate = holding([0.3])
    assert gate.apply(np.array([0.9]), 0.2, 0.0) == 0.3
    assert gate.apply(np.array([0.9]), 0.0, 0.0) == 0.9
    assert gate.apply(np.array([0.4]), float("nan"), 1.0) == 0.9
    assert gate.fallback == 0.9
    assert gate.counts.stale == 2
    with pytest.raises(SafetyStop):
        gate.apply(np.array([float("nan")]), 1.0, 2.0)


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


def test_a_gates_new_limits_are_checked():
    with pytest.raises(UsageError, match="holds no position"):
        GateConfig(envelope_rad=(1.0, -1.0))
    with pytest.raises(UsageError, match="max_sample_age_s"):
        GateConfig(max_sample_age_s=0.0)
    with pytest.raises(UsageError, match="stop_s"):
        GateLimits(stop_s=0.0)
    limits = GateLimits(envelope_rad=(-1.0, 2.0), stop_s=0.3, max_sample_age_s=0.4)
    gate = limits.gate(1.0, joints=("a",))
    assert (gate.envelope_rad, gate.stop_s, gate.max_sample_age_s) == ((-1.0, 2.0), 0.3, 0.4)
    assert (gate.slew_per_s, gate.joints) == (400.0, ("a",))
