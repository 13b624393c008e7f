import itertools
import math

import pytest

from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.feetech import registers as sts


@pytest.mark.parametrize("table", [reg.TABLE, sts.TABLE])
def test_registers_do_not_overlap_and_their_defaults_are_allowed(table):
    ordered = list(table.registers.values())
    assert all(a.end <= b.address for a, b in itertools.pairwise(ordered))
    assert all(r.minimum <= r.default <= r.maximum for r in ordered if r.writable)


def test_addresses_are_those_of_the_manual():
    assert {name: getattr(reg, name).address for name in ("TORQUE_ENABLE", "BUS_WATCHDOG", "GOAL_PWM")} == {
        "TORQUE_ENABLE": 64,
        "BUS_WATCHDOG": 98,
        "GOAL_PWM": 100,
    }
    assert (reg.PRESENT_POSITION.address, reg.PRESENT_POSITION.size) == (132, 4)


@pytest.mark.parametrize(
    ("register", "value"), [(reg.GOAL_PWM, -885), (reg.BUS_WATCHDOG, -1), (reg.GOAL_POSITION, 4095)]
)
def test_encoding_is_undone_by_decoding(register, value):
    assert register.decode(register.encode(value)) == value
    assert len(register.encode(value)) == register.size


def test_units():
    assert reg.rad_from_count(4096) == pytest.approx(2.0 * math.pi)
    assert reg.count_from_rad(math.pi) == 2048
    assert reg.rad_s_from_count(1) == pytest.approx(0.229 * 2.0 * math.pi / 60.0)
    assert reg.count_from_rad_s(reg.rad_s_from_count(-77)) == -77
    assert reg.pwm_from_fraction(-1.0) == -885
    assert reg.fraction_from_pwm(885) == 1.0
    assert reg.describe_hardware_errors(0b100100) == "overheating, overload"
    assert reg.describe_hardware_errors(0) == "none"
