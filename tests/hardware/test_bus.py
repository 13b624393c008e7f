"""The bus of DYNAMIXEL servos against the emulator, in virtual time."""

import pytest

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError, UsageError
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus

PWM = OperatingMode.PWM


def test_handshake_checks_ids_and_models(start_robot):
    robot = start_robot(ids=[1, 3])
    with ServoBus(BusConfig(robot.port)) as bus:
        assert bus.handshake({1: 1060, 3: None}) == {1: 1060, 3: 1060}
        assert bus.ids == (1, 3)
        with pytest.raises(HardwareLost, match=r"model 1060 \(XL430-W250\), expected 1200 \(XL330-M288\)"):
            bus.handshake({1: 1200})
        with pytest.raises(HardwareLost, match=r"servo 2 does not answer .* Available: \[1, 3\]"):
            bus.handshake({2: None})


def test_facts_for_a_log_are_those_of_the_registers(start_robot):
    robot = start_robot(ids=[1, 3])
    with ServoBus(BusConfig(robot.port), (1, 3)) as bus:
        assert bus.facts() == {
            "firmware": {"servo 1": "47", "servo 3": "47"},
            "voltage": {"servo 1": "12.0 V", "servo 3": "12.0 V"},
            "temperature": {"servo 1": "30 °C", "servo 3": "30 °C"},
        }


def test_setup_prepares_the_servo_and_torque_arms_the_watchdog(start_robot, open_bus):
    robot = start_robot()
    bus = open_bus(robot, mode=PWM, silence_s=0.1)
    values = {r.name: bus.read(1, r) for r in (reg.OPERATING_MODE, reg.RETURN_DELAY_TIME, reg.TORQUE_ENABLE)}
    assert values == {"operating_mode": 16, "return_delay_time": 0, "torque_enable": 1}
    assert bus.read(1, reg.BUS_WATCHDOG) == 5
    bus.torque(False)
    assert bus.read(1, reg.BUS_WATCHDOG) == 0


def test_velocity_and_position_goals(start_robot, open_bus):
    robot = start_robot(ids=[1, 2])
    bus = open_bus(robot, (1, 2), OperatingMode.EXTENDED_POSITION, silence_s=0.0)
    bus.write_goal_position({1: 0.5, 2: -0.5})
    bus.clock.sleep(0.8)
    assert bus.read_state().position_rad == pytest.approx([0.5, -0.5], abs=0.01)
    bus.setup(OperatingMode.VELOCITY)
    bus.torque(True)
    bus.write_goal_velocity({1: 1.0})
    bus.clock.sleep(0.3)
    assert bus.read_state([1]).velocity_rad_s == pytest.approx([1.0], abs=0.05)


@pytest.mark.parametrize("goal", [1.01, -2.0, float("nan"), float("inf")])
def test_goals_out_of_range_are_refused(start_robot, open_bus, goal):
    bus = open_bus(start_robot())
    with pytest.raises(SafetyStop, match=r"goal_pwm of servo 1: .* is outside \[-1, 1\]"):
        bus.write_goal_pwm({1: goal})


def test_refusals_of_the_servo_are_explained(start_robot, open_bus):
    bus = open_bus(start_robot(), mode=PWM)
    with pytest.raises(Sim2RealError, match="servo 1 refused write of 3 to operating_mode: the register cannot"):
        bus.write(1, reg.OPERATING_MODE, 3)


def test_reading_needs_servos(start_robot):
    with ServoBus(BusConfig(start_robot().port)) as bus, pytest.raises(UsageError, match="handshake"):
        bus.read_state()
    with ServoBus(BusConfig(start_robot().port)) as bus, pytest.raises(UsageError, match="handshake"):
        bus.check()


def test_configurations_that_make_no_sense():
    with pytest.raises(UsageError, match="silence_s"):
        BusConfig("/dev/null", silence_s=3.0)
    with pytest.raises(UsageError, match=r"baud rate 1234 .* Available: \[9600"):
        BusConfig("/dev/null", baud_rate=1234)
    with pytest.raises(UsageError, match="an id is a number from 0 to 253"):
        ServoBus(BusConfig("/dev/null"), [1, 254])


def test_servo_watchdog_stops_the_motor_and_is_named(start_robot, open_bus):
    robot = start_robot(config=EmulatorConfig(actuation_latency_s=0.005))
    bus = open_bus(robot, mode=PWM, silence_s=0.06, guardian=False)
    sent_ns = bus.write_goal_pwm({1: 1.0}).t_sent_ns
    bus.clock.sleep(0.2)
    with pytest.raises(SafetyStop, match="bus watchdog of servo 1 has tripped"):
        bus.write_goal_pwm({1: 1.0})
    with pytest.raises(SafetyStop, match="bus watchdog"):
        bus.check()
    bus.torque(True)
    bus.write_goal_pwm({1: 0.5})
    bus.check()
    robot.stop()
    truth = robot.truth()
    trip_ns = truth.of(Kind.WATCHDOG)["t_ns"][0]
    assert 0.060 < (trip_ns - sent_ns) * 1e-9 < 0.075
    effects = truth.of(Kind.EFFECT)
    zero = effects[effects["t_ns"] >= trip_ns - 500_000][0]
    assert zero["values"][1] == 0.0
    assert abs(zero["t_ns"] - trip_ns) <= 500_000


def test_overload_stops_with_its_name(start_robot, open_bus):
    bus = open_bus(start_robot(config=EmulatorConfig(overload_after_s=0.5)), mode=PWM)
    bus.clock.sleep(0.5)
    with pytest.raises(SafetyStop, match="servo 1 has stopped itself: overload"):
        bus.read_state()


@pytest.mark.parametrize("held_up_s", [0.0, 0.02])
def test_a_lost_bus_names_the_computer_if_its_own_thread_did_not_run(start_robot, monkeypatch, held_up_s):
    robot = start_robot(config=EmulatorConfig(silent_after_s=0.5))
    with ServoBus(BusConfig(robot.port, silence_s=1.0), (1,)) as bus:
        robot.clock.sleep(0.6)
        read = robot.read

        def late(until_ns):
            data = read(until_ns)
            robot.stall(held_up_s)
            return data

        monkeypatch.setattr(robot, "read", late)
        with pytest.raises(HardwareLost) as lost:
            bus.read(1, reg.PRESENT_POSITION)
    assert ("computer is too busy" in str(lost.value)) == (held_up_s > 0.0)
    assert ("cable" in str(lost.value)) == (held_up_s == 0.0)


def test_a_bus_counts_as_lost_when_its_host_would_count_as_dead():
    assert BusConfig.patient("/dev/null", 1_000_000, 2.0).max_silence_s == 2.0
    assert BusConfig.patient("/dev/null", 1_000_000, 0.02).max_silence_s == 0.1
