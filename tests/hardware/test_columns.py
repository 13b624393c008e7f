"""Commands with columns and readings with further parts: gate, mounting and plausibility."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from sim2real.errors import SafetyStop, UsageError
from sim2real.hardware.device import CommandColumn, CommandKind, ReadingPart
from sim2real.hardware.joint import Joint, Mounting
from sim2real.hardware.safety.gate import GateConfig, SafetyGate
from sim2real.hardware.safety.plausibility import require_parts

KIND = CommandKind.of_columns(
    "controllers",
    CommandColumn("q", "rad", "hold"),
    CommandColumn("kp", "N m/rad", "zero"),
    CommandColumn("kd", "N m s/rad", 3.0),
)
LOW, HIGH = [-1.0, 0.0, 0.0], [1.0, 50.0, 5.0]
SENT = [[0.5, 20.0, 1.0], [-0.5, 30.0, 1.0]]


def gate(**options):
    config = GateConfig((LOW, HIGH), stale=KIND.stale, **options)
    return SafetyGate(config), config


def test_each_column_has_its_limits_and_its_slew():
    limited, _ = gate(slew_per_s=(1.0, math.inf, math.inf))
    limited.reset(np.array(SENT))
    limited.apply(np.array(SENT), 0.0, 0.0)
    out = limited.apply(np.array([[2.0, 90.0, -1.0], [-0.5, 10.0, 2.0]]), 0.0, 0.05)
    np.testing.assert_allclose(out, [[0.55, 50.0, 0.0], [-0.5, 10.0, 2.0]])
    assert (limited.counts.clamped, limited.counts.slewed) == (1, 1)


def test_a_stale_command_holds_its_position_and_damps():
    limited, _ = gate(slew_per_s=(1.0, math.inf, math.inf))
    limited.reset(np.array(SENT))
    np.testing.assert_array_equal(limited.apply(np.zeros((2, 3)), 0.2, 0.0), [[0.5, 0.0, 3.0], [-0.5, 0.0, 3.0]])
    assert limited.counts.stale == 1


@pytest.mark.parametrize(
    ("limit", "words"),
    [
        ((LOW[:2], HIGH[:2]), "limits for 2 of 3 columns"),
        ((LOW, [1.0, 50.0, 2.0]), "does not contain .*3.0"),
        (([-1.0, 1.0, 0.0], HIGH), "does not contain"),
    ],
)
def test_limits_that_do_not_fit_the_columns_are_refused(limit, words):
    with pytest.raises(UsageError, match=words):
        GateConfig(limit, stale=KIND.stale)


def test_a_command_without_its_columns_is_refused():
    with pytest.raises(UsageError, match=r"shape \(3,\), not \(n, 3\)"):
        gate()[0].reset(np.zeros(3))
    with pytest.raises(UsageError, match=r"shape \(2, 3\), not \(n,\)"):
        SafetyGate(GateConfig()).apply(np.zeros((2, 3)), 0.0, 0.0)


def test_a_value_that_is_no_number_is_named_by_motor_and_column():
    limited, _ = gate()
    limited.reset(np.array(SENT))
    with pytest.raises(SafetyStop, match=r"command\[1, 2\] = nan"):
        limited.apply(np.array([SENT[0], [0.0, 0.0, math.nan]]), 0.0, 0.0)


def test_columns_are_converted_between_joints_and_motors():
    device = SimpleNamespace(motors=("a", "b"), commanded=KIND, load_unit="N m")
    mounting = Mounting([Joint("a", zero_rad=0.1, direction=-1, gear=2.0), Joint("b")], device)
    command = np.array(SENT)
    motors = mounting.to_motors(command)
    # The same torque acts on the joint: kp_joint * angle = gear * kp_motor * (gear * angle).
    np.testing.assert_allclose(motors, [[0.1 - 2.0 * 0.5, 20.0 / 4.0, 1.0 / 4.0], SENT[1]])
    np.testing.assert_allclose(mounting.to_joints(motors), command)


PARTS = {
    "quaternion": ReadingPart("1", (4,), norm=(0.99, 1.01)),
    "foot_force": ReadingPart("N", (2,), low=0.0, high=500.0),
}
GOOD = {"quaternion": np.array([1.0, 0, 0, 0]), "foot_force": np.array([0.0, 10.0])}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"quaternion": np.array([2.0, 0, 0, 0])}, "norm 2, not 0.99 to 1.01"),
        ({"quaternion": np.zeros(3)}, r"has the shape \(3,\)"),
        ({"foot_force": np.array([-1.0, 0.0])}, "not 0 to 500"),
        ({"foot_force": np.array([math.nan, 0.0])}, "not 0 to 500"),
        ({"foot_force": None}, "'foot_force' of the reading is missing"),
    ],
)
def test_a_part_that_is_not_possible_stops_the_robot(changed, words):
    require_parts(GOOD, PARTS)
    with pytest.raises(SafetyStop, match=words):
        require_parts({name: value for name, value in {**GOOD, **changed}.items() if value is not None}, PARTS)
