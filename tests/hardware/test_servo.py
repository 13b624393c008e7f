import math

import pytest

from sim2real.emulation.dynamixel import EmulatedServo
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import StatusError


def write(servo, register, value):
    return servo.write(register.address, register.encode(value))[0]


@pytest.fixture
def servo():
    servo = EmulatedServo(1)
    servo.refresh(1.0, 0.0, 0.0, 0)
    return servo


def in_mode(servo, mode):
    write(servo, reg.OPERATING_MODE, mode)
    write(servo, reg.TORQUE_ENABLE, 1)
    return servo


@pytest.mark.parametrize(
    ("address", "data", "error"),
    [
        (reg.PRESENT_POSITION.address, bytes(4), StatusError.ACCESS),  # read only
        (200, bytes(1), StatusError.ACCESS),  # nothing there
        (reg.GOAL_POSITION.address + 1, bytes(2), StatusError.ACCESS),  # not the start of a register
        (reg.GOAL_POSITION.address, bytes(2), StatusError.DATA_LENGTH),
        (reg.GOAL_POSITION.address, b"", StatusError.DATA_LENGTH),
        (reg.OPERATING_MODE.address, b"\x07", StatusError.DATA_RANGE),
        (reg.OPERATING_MODE.address, b"\x00", StatusError.DATA_RANGE),
        (reg.TORQUE_ENABLE.address, b"\x02", StatusError.DATA_RANGE),
        (reg.BUS_WATCHDOG.address, b"\xff", StatusError.DATA_RANGE),
        (reg.GOAL_POSITION.address, (4096).to_bytes(4, "little"), StatusError.DATA_LIMIT),
        (reg.GOAL_VELOCITY.address, (266).to_bytes(4, "little"), StatusError.DATA_LIMIT),
        (reg.ID.address, b"\x05", StatusError.RESULT_FAIL),
        (reg.ID.address, b"\x01", StatusError.NONE),
        (reg.DRIVE_MODE.address, b"\x04", StatusError.RESULT_FAIL),  # not emulated
        (reg.DRIVE_MODE.address, b"\x00", StatusError.NONE),
        (reg.LED.address, b"\x01", StatusError.NONE),
    ],
)
def test_writes_that_are_refused(servo, address, data, error):
    assert servo.write(address, data)[0] == error


def test_present_registers():
    servo = in_mode(EmulatedServo(1), OperatingMode.PWM)
    write(servo, reg.GOAL_PWM, 442)
    servo.refresh(-1.0, 2.0, 3.0, tick_ms=40_000)
    assert servo.get(reg.PRESENT_POSITION) * reg.RAD_PER_COUNT == pytest.approx(-1.0, abs=reg.RAD_PER_COUNT)
    assert servo.get(reg.PRESENT_VELOCITY) == round(2.0 / reg.RAD_S_PER_COUNT)
    assert servo.get(reg.PRESENT_LOAD) == 1000
    assert servo.get(reg.PRESENT_PWM) == 442
    assert servo.get(reg.MOVING) == 1
    assert servo.get(reg.REALTIME_TICK) == 40_000 - 32_768


OK, OFF = StatusError.NONE, (OperatingMode.OFF, 0.0)
PWM, VELOCITY, POSITION = (OperatingMode[n] for n in ("PWM", "VELOCITY", "POSITION"))


@pytest.mark.parametrize(
    ("mode", "writes", "command"),
    [
        (PWM, [(reg.GOAL_PWM, -885, OK)], (PWM, -1.0)),
        (VELOCITY, [(reg.GOAL_VELOCITY, 100, OK)], (VELOCITY, 100 * reg.RAD_S_PER_COUNT)),
        (POSITION, [(reg.GOAL_POSITION, 2048, OK)], (POSITION, math.pi)),
        (POSITION, [], (POSITION, reg.GOAL_POSITION.count(1.0) * reg.RAD_PER_COUNT)),  # torque on holds the position
        # Settings are locked while torque is on.
        (PWM, [(reg.OPERATING_MODE, POSITION, StatusError.ACCESS), (reg.RETURN_DELAY_TIME, 0, StatusError.ACCESS)],
         (PWM, 0.0)),
        (PWM, [(reg.TORQUE_ENABLE, 0, OK), (reg.OPERATING_MODE, POSITION, OK)], OFF),
        # Goals move nothing while torque is off, and are not kept.
        (PWM, [(reg.TORQUE_ENABLE, 0, OK), (reg.GOAL_PWM, 500, OK)], OFF),
        (PWM, [(reg.TORQUE_ENABLE, 0, OK), (reg.GOAL_PWM, 500, OK), (reg.TORQUE_ENABLE, 1, OK)], (PWM, 0.0)),
        (PWM, [(reg.TORQUE_ENABLE, 0, OK), (reg.PWM_LIMIT, 400, OK), (reg.GOAL_PWM, -401, StatusError.DATA_LIMIT),
               (reg.GOAL_PWM, -400, OK)], OFF),
    ],
)  # fmt: skip
def test_what_is_written_drives_the_motor(servo, mode, writes, command):
    in_mode(servo, mode)
    assert [write(servo, register, value) for register, value, _ in writes] == [answer for *_, answer in writes]
    assert servo.command() == (command[0], pytest.approx(command[1]))


@pytest.mark.parametrize(
    ("model", "stops", "fraction", "off_by"),
    [
        (1060, None, 0.0, reg.BUS_WATCHDOG),
        (1200, True, 0.0, reg.TORQUE_ENABLE),
        (1060, False, 300 * reg.GOAL_PWM.unit, reg.TORQUE_ENABLE),
        (1200, None, 300 * reg.GOAL_PWM.unit, reg.TORQUE_ENABLE),  # a 330 turns on
    ],
)
def test_a_watchdog_that_has_tripped_refuses_goals(model, stops, fraction, off_by):
    servo = EmulatedServo(1, model, watchdog_stops=stops)
    write(servo, reg.BUS_WATCHDOG, 5)
    assert servo.watchdog_deadline_ns() is None, "it watches only while torque is on"
    in_mode(servo, PWM)
    write(servo, reg.GOAL_PWM, 300)
    write(servo, reg.BUS_WATCHDOG, 5)
    servo.heard_ns = 7
    assert servo.watchdog_deadline_ns() == 100_000_007
    servo.trip_watchdog()
    assert servo.watchdog_deadline_ns() is None
    assert servo.read(reg.BUS_WATCHDOG.address, 1) == (OK, b"\xff")
    assert servo.command() == (PWM, fraction)
    assert write(servo, reg.GOAL_PWM, 0 if fraction else 300) == StatusError.DATA_RANGE
    assert write(servo, off_by, 0) == OK
    assert servo.command() == ((PWM, 0.0) if off_by is reg.BUS_WATCHDOG else OFF)
    if off_by is reg.BUS_WATCHDOG:
        assert write(servo, reg.GOAL_PWM, 300) == OK
