"""The rig on a real emulator: what stops the motors, and that nothing else does."""

import os
import signal
import threading
import time

import numpy as np
import pytest

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.bus import BusConfig
from sim2real.hardware.dynamixel.device import DynamixelServos
from sim2real.hardware.dynamixel.drive import VoltageDrive
from sim2real.hardware.dynamixel.emulation import EmulatorConfig
from sim2real.hardware.dynamixel.protocol import PROTOCOL
from sim2real.hardware.emulation.truth import Kind
from sim2real.hardware.plant import OperatingMode
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

pytestmark = pytest.mark.process

SUPPLY_V = 5.0
TIMEOUT_S = 0.1


@pytest.fixture
def open_rig(start_robot):
    """Open a rig on a servo whose speed follows its voltage: 6 rad/s at 5 V."""
    rigs = []

    def open_(config=None, silence_s=0.4, **gate):
        robot = start_robot("FirstOrder", config)
        # Patient with lost answers, for the machine may be busy; not with the host itself.
        bus = BusConfig(robot.port, max_silence_s=1.0, silence_s=silence_s)
        limits = GateConfig(**{"limit": 4.0, "command_timeout_s": TIMEOUT_S, **gate})
        rigs.append(Rig(DynamixelServos(bus, [1], VoltageDrive(SUPPLY_V)), limits))
        return rigs[-1], robot

    yield open_
    for rig in rigs:
        rig.close()


def volts(rig, value):
    return rig.command(np.array([value]), 0.0, time.monotonic())


def run(rig, value, duration_s, period_s=0.02):
    """Command a voltage and read for a while, like a control loop."""
    end = time.monotonic() + duration_s
    while time.monotonic() < end:
        volts(rig, value)
        rig.measure()
        time.sleep(period_s)


def effects(robot):
    robot.stop()
    rows = robot.truth().of(Kind.EFFECT)
    return rows["t_ns"], rows["values"][:, 0], rows["values"][:, 1]


def test_commands_are_volts_and_come_back_as_sent(open_rig):
    rig, _ = open_rig()
    rig.start()
    assert volts(rig, 2.5) == 2.5
    assert volts(rig, 9.0) == 4.0
    run(rig, 2.5, 0.4)
    assert rig.measure().velocity_rad_s[0] == pytest.approx(3.0, rel=0.1)
    rig.stop()
    assert rig.device.read(1, reg.TORQUE_ENABLE) == 0
    assert rig.gate.counts.clamped == 1
    assert rig.timeouts == 0


def test_a_stalled_policy_gets_zero_while_measuring_goes_on(open_rig):
    rig, _ = open_rig(silence_s=1.0)
    rig.start()
    run(rig, 2.5, 0.3)
    stalled_s = time.monotonic()
    zero_s = None
    reads = 0
    while time.monotonic() - stalled_s < 0.5:
        rig.measure()
        reads += 1
        if zero_s is None and rig.device.read(1, reg.GOAL_PWM) == 0:
            zero_s = time.monotonic() - stalled_s
        time.sleep(0.005)
    # The watcher looks every fifth of the timeout; the rest is for a busy machine.
    assert zero_s is not None
    assert zero_s < TIMEOUT_S * 1.2 + 0.03
    assert reads > 10
    assert 3 <= rig.timeouts <= 5
    assert abs(rig.measure().velocity_rad_s[0]) < 0.1
    assert rig.device.read(1, reg.BUS_WATCHDOG) != reg.WATCHDOG_TRIPPED
    assert volts(rig, 2.5) == 2.5  # a loop that comes back goes on


@pytest.mark.parametrize("timeout_s", [TIMEOUT_S, 2.0])
def test_a_slow_start_does_not_trip_the_servos_watchdog(open_rig, timeout_s):
    rig, robot = open_rig(silence_s=0.2, command_timeout_s=timeout_s)
    rig.start()
    time.sleep(0.8)  # a graph that takes its time between torque on and the first command
    volts(rig, 1.0)
    assert rig.timeouts == 0
    rig.stop()
    _, modes, goals = effects(robot)
    assert not len(robot.truth().of(Kind.WATCHDOG))
    assert (modes[-1], goals[-1]) == (OperatingMode.OFF, 0.0)


def test_stale_commands_become_zero(open_rig):
    rig, _ = open_rig()
    rig.start()
    volts(rig, 2.0)
    assert rig.command(np.array([2.0]), 0.2, time.monotonic()) == 0.0
    assert rig.gate.counts.stale == 1


def test_too_fast_is_a_safety_stop_that_lasts(open_rig):
    rig, robot = open_rig(max_speed_rad_s=2.0)
    rig.start()
    with pytest.raises(SafetyStop, match="beyond the limit of 2 rad/s"):
        run(rig, 4.0, 1.0)
    with pytest.raises(SafetyStop, match="beyond the limit"):
        volts(rig, 0.0)
    rig.stop()
    _, modes, _ = effects(robot)
    assert modes[-1] == OperatingMode.OFF


def test_nan_is_a_safety_stop(open_rig):
    rig, _ = open_rig()
    rig.start()
    with pytest.raises(SafetyStop, match="not finite"):
        volts(rig, float("nan"))


@pytest.mark.parametrize("way", ["stop", "close", "stop_quietly", "exception"])
def test_torque_goes_off_on_every_way_out(open_rig, way):
    rig, robot = open_rig()

    def leave():
        with rig:
            rig.start()
            run(rig, 2.0, 0.2)
            if way == "exception":
                raise ZeroDivisionError
            getattr(rig, way)()
            time.sleep(0.02)

    if way == "exception":
        with pytest.raises(ZeroDivisionError):
            leave()
    else:
        leave()
    _, modes, goals = effects(robot)
    assert np.any(goals > 0.0)
    assert modes[-1] == OperatingMode.OFF
    assert not rig_threads()


def rig_threads(patience_s=0.5):
    """Return the watchers that still run after a moment."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end and any(t.name == "sim2real:watchdog" for t in threading.enumerate()):
        time.sleep(0.01)
    return [t for t in threading.enumerate() if t.name == "sim2real:watchdog"]


def test_a_rig_serves_several_episodes(open_rig):
    rig, robot = open_rig()
    for _ in range(3):
        rig.start()
        run(rig, 2.0, 0.15)
        assert sum(t.name == "sim2real:watchdog" for t in threading.enumerate()) == 1
        rig.stop()
        rig.start()  # at once, before the watcher of the last one has woken
        assert rig.gate.counts.passed == 0
        run(rig, -2.0, 0.15)
        rig.stop()
    assert not rig_threads()
    _, modes, goals = effects(robot)
    assert np.count_nonzero(np.diff((modes == OperatingMode.PWM).astype(int)) == 1) >= 5
    assert modes[-1] == OperatingMode.OFF
    assert goals.max() == pytest.approx(0.4, abs=0.01)
    assert goals.min() == pytest.approx(-0.4, abs=0.01)


def test_a_silent_servo_is_hardware_lost_for_the_loop_and_for_the_watcher(open_rig):
    rig, robot = open_rig(EmulatorConfig(silent_after_s=1.0))
    rig.start()
    with pytest.raises(HardwareLost, match="no answer"):
        run(rig, 2.0, 4.0)
    with pytest.raises(HardwareLost):  # what the watcher found, or what this call finds
        rig.measure()
    rig.close()
    _, _, goals = effects(robot)
    assert goals[-1] == 0.0  # by the servo's own watchdog
    assert len(robot.truth().of(Kind.WATCHDOG)) == 1


def test_waiting_until_still(open_rig):
    rig, _ = open_rig()
    rig.start()
    run(rig, 3.0, 0.3)
    rig.stop()
    assert abs(rig.wait_until_still(5.0, for_s=0.1).velocity_rad_s[0]) < 0.05
    rig.start()
    run(rig, 3.0, 0.2)
    with pytest.raises(HardwareLost, match="still moves"):
        rig.wait_until_still(0.02)


def test_a_bus_that_cannot_be_set_up_is_closed(start_robot):
    robot = start_robot("FirstOrder")
    with pytest.raises(HardwareLost, match="servo 7 does not answer"):
        Rig(DynamixelServos(BusConfig(robot.port), [7], VoltageDrive(SUPPLY_V)), GateConfig())
    Rig(DynamixelServos(BusConfig(robot.port), [1], VoltageDrive(SUPPLY_V)), GateConfig()).close()


def test_a_soft_stop_fades_the_voltage_before_the_torque_goes_off(open_rig):
    rig, robot = open_rig(stop_s=0.5)
    rig.start()
    run(rig, 3.0, 0.3)
    rig.ease()
    begin = time.monotonic()
    sent = []
    while not rig.eased:
        sent.append(volts(rig, 3.0)[0])
        rig.measure()
        time.sleep(0.02)
    assert time.monotonic() - begin < 0.6
    assert sent == sorted(sent, reverse=True)
    assert len({*sent}) >= 5, "it fades, it does not drop"
    assert sent[-1] == 0.0
    rig.stop()
    rig.start()  # the next episode is a full one again
    assert volts(rig, 3.0) == 3.0
    assert not rig.eased
    rig.stop()
    assert effects(robot)[1][-1] == OperatingMode.OFF


def test_nothing_is_commanded_on_old_measurements(open_rig):
    rig, _ = open_rig(max_sample_age_s=0.15)
    rig.start()
    rig.require_fresh()  # nothing was measured yet, nothing has moved
    rig.measure()
    rig.require_fresh()
    time.sleep(0.2)
    with pytest.raises(SafetyStop, match=r"(?s)newest measurement is 0\.\d+ s old, 0\.15 s are allowed.*hint: "):
        rig.require_fresh()
    rig.stop()


def test_a_joint_that_leaves_its_envelope_stops_the_robot(open_rig):
    rig, _ = open_rig(envelope_rad=(-0.5, 0.5), joints=("hinge",))
    rig.start()
    with pytest.raises(
        SafetyStop, match=r"(?s)joint 'hinge' is at 0\.5\d* rad, outside of its envelope, -0\.5 to 0\.5"
    ):
        run(rig, 2.5, 2.0)
    rig.stop_quietly()


def test_an_unplugged_bus_is_lost_at_once_and_its_servo_stops_itself(open_rig):
    rig, robot = open_rig(EmulatorConfig(unplugged_after_s=0.0, on_signal=True), silence_s=0.1)
    rig.start()
    run(rig, 2.5, 0.3)
    began_ns = time.monotonic_ns()
    os.kill(robot.pid, signal.SIGUSR1)
    with pytest.raises(HardwareLost, match="failed during"):
        run(rig, 2.5, 2.0)
    assert (time.monotonic_ns() - began_ns) * 1e-9 < 1.0
    time.sleep(0.3)
    t_ns, modes, goals = effects(robot)
    assert (modes[-1] == OperatingMode.OFF) | (goals[-1] == 0.0)
    assert (t_ns[-1] - began_ns) * 1e-9 < 0.3


@pytest.mark.parametrize("value", [3.0, -3.0])
def test_a_servo_that_resets_in_motion_stops_the_robot_within_a_second(open_rig, value):
    """As after a moment without supply: it has lost torque, mode and watchdog, and still answers every question."""
    rig, robot = open_rig()
    rig.start()
    run(rig, value, 0.3)
    link = rig.device.link
    with link.hold():
        link.port.write(PROTOCOL.build(1, Instruction.REBOOT))
    begin_s = time.monotonic()
    with pytest.raises(SafetyStop, match=r"servo 1 has lost its settings|moved at .* or more just before"):
        run(rig, value, 5.0)
    assert time.monotonic() - begin_s < 1.2
    rig.stop_quietly()
    _, modes, _ = effects(robot)
    assert modes[-1] == OperatingMode.OFF
