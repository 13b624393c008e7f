import itertools
import math

import pytest

from sim2real.hardware import dynamixel as reg
from sim2real.hardware import feetech as sts


@pytest.mark.parametrize("family", [reg.FAMILY, sts.FAMILY], ids=lambda family: family.name)
def test_registers_do_not_overlap_and_their_defaults_are_allowed(family):
    ordered = list(family.registers.values())
    assert all(a.end <= b.address for a, b in itertools.pairwise(ordered))
    assert all(r.minimum <= r.default <= r.maximum for r in ordered if r.writable)


def test_addresses_are_those_of_the_manual():
    registers = (reg.TORQUE_ENABLE, reg.BUS_WATCHDOG, reg.GOAL_PWM, reg.PRESENT_POSITION)
    assert [(r.address, r.size) for r in registers] == [(64, 1), (98, 1), (100, 2), (132, 4)]


@pytest.mark.parametrize(
    ("register", "value", "data"),
    [
        (reg.GOAL_PWM, -885, b"\x8b\xfc"),
        (reg.BUS_WATCHDOG, -1, b"\xff"),
        (reg.GOAL_POSITION, 4095, b"\xff\x0f\0\0"),
        (sts.PRESENT_POSITION, -3, b"\x03\x80"),
        (sts.PRESENT_LOAD, -1000, b"\xe8\x07"),
        (sts.HOMING_OFFSET, -1365, b"\x55\x0d"),
        (sts.GOAL_SPEED, 1000, b"\xe8\x03"),
    ],
)
def test_numbers_are_those_of_each_family(register, value, data):
    assert register.encode(value) == data
    assert register.decode(data) == value


def test_units():
    assert reg.GOAL_POSITION.count(math.pi) == 2048
    assert reg.PRESENT_VELOCITY.unit == pytest.approx(0.229 * 2.0 * math.pi / 60.0)
    assert reg.GOAL_PWM.count(-1.0) == -885
    assert sts.speed_unit_rad_s(sts.PHASE_COUNTS_PER_S) == pytest.approx(0.0146 * 2.0 * math.pi / 60.0, rel=4e-3)
    assert sts.speed_unit_rad_s(0) == pytest.approx(0.732 * 2.0 * math.pi / 60.0, rel=1e-3)
    assert sts.describe_alarms(0b100001) == "input voltage, overload"
