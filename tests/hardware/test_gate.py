import numpy as np
import pytest

from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.gate import GateConfig, SafetyGate


def test_commands_within_limits_pass_unchanged():
    gate = SafetyGate(GateConfig(limit=1.0))
    command = np.array([0.3, -0.9], dtype=np.float32)
    assert np.array_equal(gate.apply(command, 0.01, 0.0), command.astype(np.float64))
    assert gate.counts.passed == 1
    assert (gate.counts.clamped, gate.counts.slewed, gate.counts.stale) == (0, 0, 0)


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


def test_stale_does_not_hide_a_command_that_is_no_number():
    with pytest.raises(SafetyStop):
        SafetyGate(GateConfig()).apply(np.array([float("nan")]), 1.0, 0.0)


def test_over_speed_stops():
    gate = SafetyGate(GateConfig(max_speed_rad_s=10.0))
    gate.apply(np.zeros(2), 0.0, 0.0, np.array([9.9, -9.9]))
    with pytest.raises(SafetyStop, match=r"speed_rad_s\[1\] = -10.1"):
        gate.apply(np.zeros(2), 0.0, 0.1, np.array([9.9, -10.1]))


def test_speed_that_is_no_number_stops():
    with pytest.raises(SafetyStop, match="speed_rad_s"):
        SafetyGate(GateConfig(max_speed_rad_s=10.0)).apply(np.zeros(1), 0.0, 0.1, float("nan"))


def test_output_is_the_callers_own():
    gate = SafetyGate(GateConfig(slew_per_s=1.0))
    gate.apply(np.ones(1), 0.0, 0.0)[:] = 100.0
    assert gate.apply(np.ones(1), 0.0, 0.1)[0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    "bad",
    [
        {"limit": -1.0},
        {"limit": (0.1, 0.5)},
        {"slew_per_s": 0.0},
        {"command_timeout_s": 0.0},
        {"max_speed_rad_s": -1.0},
    ],
)
def test_limits_that_make_no_sense(bad):
    with pytest.raises(UsageError, match=next(iter(bad))):
        SafetyGate(GateConfig(**bad))
