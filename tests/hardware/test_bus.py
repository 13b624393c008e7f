"""DYNAMIXEL servos by voltage against the emulator, in virtual time: what they refuse, and what a lost bus says."""

import numpy as np
import pytest

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError, UsageError
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.dynamixel import DynamixelServos, VoltageDrive


def test_a_missing_servo_is_named_with_those_that_answer(start_robot, open_servos):
    robot = start_robot(ids=[1, 3])
    device = open_servos(robot, (1, 3), torque=False)
    assert {i: m.name for i, m in device.models.items()} == {1: "XL430-W250", 3: "XL430-W250"}
    assert device.facts() == {
        "firmware": {"servo 1": "47", "servo 3": "47"},
        "voltage": {"servo 1": "12.0 V", "servo 3": "12.0 V"},
        "temperature": {"servo 1": "30 °C", "servo 3": "30 °C"},
    }
    device.close()
    with pytest.raises(HardwareLost, match=r"servo 2.* does not answer .* Available: \[1, 3\]"):
        open_servos(robot, (2,))


def test_opening_prepares_the_servo_and_torque_arms_the_watchdog(start_robot, open_servos):
    device = open_servos(start_robot(), silence_s=0.1)
    registers = (reg.OPERATING_MODE, reg.RETURN_DELAY_TIME, reg.TORQUE_ENABLE, reg.BUS_WATCHDOG)
    assert [device.link.read(1, r) for r in registers] == [16, 0, 1, 5]
    device.disable()
    assert [device.link.read(1, r) for r in registers] == [16, 0, 0, 0]


@pytest.mark.parametrize("volts", [5.1, -10.0, float("nan"), float("inf")])
def test_voltages_out_of_range_are_refused(start_robot, open_servos, volts):
    with pytest.raises(SafetyStop, match=r"'servo 1': .* V is outside \[-5"):
        open_servos(start_robot()).command(np.array([volts]))


def test_refusals_of_the_servo_are_explained(start_robot, open_servos):
    with pytest.raises(Sim2RealError, match="servo 1 refused write of 3 to operating_mode: the register cannot"):
        open_servos(start_robot()).link.write(1, reg.OPERATING_MODE, 3)


@pytest.mark.parametrize(
    ("config", "ids", "message"),
    [
        ({"silence_s": 3.0}, (1,), "silence_s"),
        ({"baud_rate": 1234}, (1,), r"baud rate 1234 .* Available: \[9600"),
        ({}, (1, 254), "from 0 to 253"),
        ({}, (), "at least one"),
    ],
)
def test_configurations_that_make_no_sense(config, ids, message):
    with pytest.raises(UsageError, match=message):
        DynamixelServos(BusConfig("/dev/null", **config), ids, VoltageDrive(5.0))


def test_servo_watchdog_stops_the_motor_and_is_named(start_robot, open_servos):
    robot = start_robot(config=EmulatorConfig(actuation_latency_s=0.005))
    device = open_servos(robot, silence_s=0.06, guardian=False)
    sent_ns = device.command(np.array([5.0])).t_sent_ns
    device.clock.sleep(0.2)
    for call in (lambda: device.command(np.array([5.0])), device.check):
        with pytest.raises(SafetyStop, match="bus watchdog of servo 1 has tripped"):
            call()
    device.enable()
    device.command(np.array([2.5]))
    device.check()
    robot.stop()
    truth = robot.truth()
    trip_ns = truth.of(Kind.WATCHDOG)["t_ns"][0]
    assert 0.060 < (trip_ns - sent_ns) * 1e-9 < 0.075
    effects = truth.of(Kind.EFFECT)
    zero = effects[effects["t_ns"] >= trip_ns - 500_000][0]
    assert zero["values"][1] == 0.0
    assert abs(zero["t_ns"] - trip_ns) <= 500_000


@pytest.mark.parametrize("held_up_s", [0.0, 0.02])
def test_a_lost_bus_names_the_computer_if_its_own_thread_did_not_run(start_robot, open_servos, monkeypatch, held_up_s):
    robot = start_robot(config=EmulatorConfig(silent_after_s=0.5))
    device = open_servos(robot, torque=False)
    robot.clock.sleep(0.6)
    read = robot.read

    def late(until_ns):
        data = read(until_ns)
        robot.stall(held_up_s)
        return data

    monkeypatch.setattr(robot, "read", late)
    with pytest.raises(HardwareLost) as lost:
        device.link.read(1, reg.PRESENT_POSITION)
    assert ("computer is too busy" in str(lost.value)) == (held_up_s > 0.0)
    assert ("cable" in str(lost.value)) == (held_up_s == 0.0)


def test_a_bus_counts_as_lost_when_its_host_would_count_as_dead():
    assert BusConfig.patient("/dev/null", 1_000_000, 2.0).max_silence_s == 2.0
    assert BusConfig.patient("/dev/null", 1_000_000, 0.02).max_silence_s == 0.1
