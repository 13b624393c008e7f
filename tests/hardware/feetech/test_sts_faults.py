"""What goes wrong on the bus, or with the process that controls it: the torque ends off, and the error says why."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from sts_bench import IDS

from sim2real.errors import HardwareLost, SafetyStop, Sim2RealError
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.emulation.truth import Kind
from sim2real.hardware.feetech import registers as reg
from sim2real.hardware.feetech.calibration import CalibratedJoint as Joint
from sim2real.hardware.feetech.device import StsConfig, StsServos
from sim2real.hardware.feetech.emulation import StsEmulation
from sim2real.hardware.feetech.protocol import PROTOCOL
from sim2real.hardware.plant import OperatingMode
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig

pytestmark = pytest.mark.process


def drive(device, for_s=0.15):
    """Move a little, as a stage does; return the error that ended it, or None."""
    end_s = time.monotonic() + for_s
    rest = device.rest()
    try:
        while time.monotonic() < end_s:
            device.measure()
            device.command(rest + 0.4 * np.sin(20.0 * time.monotonic()))
            time.sleep(0.005)
    except Sim2RealError as error:
        return error
    return None


def swing(rig, for_s, then):
    """Move the joints of a rig; call `then` once it has started."""
    rig.start()
    then()
    rest, end_s = rig.device.rest(), time.monotonic() + for_s
    while (now_s := time.monotonic()) < end_s:
        rig.measure()
        rig.command(rest + 0.4 * np.sin(20.0 * now_s), 0.0, now_s)
        time.sleep(0.005)


def assert_off(robot):
    """The last that reached each motor was "torque off", and it had been on."""
    time.sleep(0.01)  # what arrived takes effect at the plant's next step
    truth = robot.truth()
    for servo_id in IDS:
        modes = truth.of(Kind.EFFECT, servo_id)["values"][:, 0]
        assert OperatingMode.POSITION in modes
        assert modes[-1] == OperatingMode.OFF


SOME = {
    "some answers lost": {"reply_loss": 0.1},
    "some answers corrupted": {"corrupt": 0.1},
    "some answers too late": {"late": 0.1, "late_s": 0.012},
    "some answers late": {"late": 0.1, "late_s": 0.006},
    "some answers from a wrong id": {"wrong_id": 0.1},
    "some answers cut": {"cut": 0.1},
    "something of all": {"reply_loss": 0.03, "corrupt": 0.03, "late": 0.03, "wrong_id": 0.03, "cut": 0.03},
}


@pytest.mark.parametrize("faults", SOME.values(), ids=SOME)
def test_what_a_bus_survives(serve, connect, faults):
    robot = serve(config=StsEmulation(return_delay_us=0, seed=3, **faults))
    device = connect(robot)
    device.enable()
    assert drive(device, 0.3) is None
    counters = device.counters
    assert counters.lost_replies or counters.late_replies
    assert counters.retries == counters.lost_replies
    device.close()
    assert_off(robot)


ALL = {
    "all answers lost": {"reply_loss": 1.0},
    "all answers corrupted": {"corrupt": 1.0},
    "all answers too late": {"late": 1.0, "late_s": 1.0},
    "all answers from a wrong id": {"wrong_id": 1.0},
    "all answers cut": {"cut": 1.0},
}


@pytest.mark.parametrize("faults", ALL.values(), ids=ALL)
def test_what_it_does_not(serve, connect, faults, caplog):
    """The servos still hear: torque goes off, though none can confirm it."""
    robot = serve()
    device = connect(robot, max_silence_s=0.1)
    device.enable()
    robot.strike(**faults)
    error = drive(device, 2.0)
    assert isinstance(error, HardwareLost)
    assert "no answer to" in str(error)
    device.close()
    assert "servos [1, 2, 3] did not confirm that their torque is off" in caplog.text
    assert_off(robot)


def test_a_cable_that_comes_back(serve, connect, capfd):
    """Nothing arrives while it is out, and the servos go on by themselves; the guardian goes on trying."""
    robot = serve()
    device = connect(robot, max_silence_s=0.1)
    device.enable()
    robot.strike(silent_after_s=0.0)
    assert isinstance(drive(device, 2.0), HardwareLost)
    device.close()
    assert robot.bus.servos[1].get(reg.TORQUE_ENABLE) == 1
    robot.strike(silent_after_s=None)
    time.sleep(0.3)
    assert "torque is off, confirmed after" in capfd.readouterr().err
    assert_off(robot)


ALARMS = {"input voltage": 1, "encoder": 2, "overheating": 4, "overcurrent": 8, "overload": 32}


@pytest.mark.parametrize("bits", ALARMS.values(), ids=ALARMS)
def test_an_alarm_is_named(serve, connect, bits):
    robot = serve()
    device = connect(robot)
    device.enable()
    time.sleep(0.02)
    robot.bus.servos[2].put(reg.STATUS, bits)
    error = drive(device)
    assert isinstance(error, SafetyStop)
    (name,) = (name for name, mask in ALARMS.items() if mask == bits)
    assert f"servo 2 reports an alarm: {name}" in str(error)
    device.close()
    assert_off(robot)


def test_a_servo_that_restarts(serve, connect):
    robot = serve()
    device = connect(robot)
    device.enable()
    device.check()
    with device.link.hold():
        device.link.port.write(PROTOCOL.build(2, Instruction.REBOOT))
        time.sleep(0.02)
    with pytest.raises(SafetyStop, match="servo 2 has lost its settings: torque_enable is 0, not 1"):
        device.check()
    device.close()
    assert_off(robot)


@pytest.mark.parametrize(
    ("faults", "said"), [({"wild": 0.3}, "can have moved by"), ({"frozen_after_s": 0.0}, "pushed both ways")]
)
def test_readings_that_cannot_be_true_stop_the_rig(serve, faults, said):
    robot = serve()
    config = StsConfig(robot.port, max_silence_s=1.0, silence_s=1.0)
    gate = GateConfig(limit=3.0, max_speed_rad_s=8.0, stale="hold", stuck_s=0.05)
    device = StsServos(config, [Joint(f"joint{i}", i) for i in IDS])
    with pytest.raises(SafetyStop, match=said), Rig(device, gate) as rig:
        swing(rig, 5.0, lambda: robot.strike(**faults))
    assert_off(robot)


def test_make_safe_needs_no_lock(serve, connect):
    robot = serve()
    device = connect(robot)
    device.enable()
    time.sleep(0.02)
    with device.link.hold():
        device.make_safe()
    time.sleep(0.05)
    assert_off(robot)


def test_an_unplugged_port_is_lost(serve, connect):
    robot = serve()
    device = connect(robot)
    robot.stop()
    with pytest.raises(HardwareLost, match="read of the state"):
        device.measure()
    device.close()
    with pytest.raises(HardwareLost, match="closed"):
        device.measure()


HOST = """
import os, signal, sys, time
import numpy as np
from sim2real.hardware.feetech.calibration import CalibratedJoint as Joint
from sim2real.hardware.feetech.device import StsConfig, StsServos
from sim2real.hardware.feetech.device import StsConfig, StsServos

config = StsConfig({port!r}, silence_s={silence_s}, max_silence_s=1.0, guardian={guardian})
device = StsServos(config, [Joint(f"joint{{i}}", i) for i in (1, 2, 3)])

def die_in_the_middle_of_a_packet(number, frame):
    device.link.port.write(device._off_packet[:6])
    os.kill(os.getpid(), signal.SIGKILL)

signal.signal(signal.SIGUSR1, die_in_the_middle_of_a_packet)
device.open()
device.enable()
print("ready", flush=True)
while True:
    device.command(device.rest() + 0.2 * np.sin(20.0 * time.monotonic()))
    device.measure()
    time.sleep(0.01)
"""


@pytest.fixture
def start_host():
    """Start a process that moves servos."""
    hosts = []

    def start(robot, guardian=True, silence_s=0.5):
        code = HOST.format(port=robot.port, guardian=guardian, silence_s=silence_s)
        host = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        hosts.append(host)
        assert host.stdout.readline() == "ready\n", host.stderr.read()
        time.sleep(0.05)
        return host

    yield start
    for host in hosts:
        host.kill()
        host.communicate()


@pytest.mark.parametrize(
    ("number", "faults"),
    [
        (signal.SIGKILL, {}),
        (signal.SIGSTOP, {}),
        (signal.SIGUSR1, {}),  # dies in the middle of a packet, which swallows the guardian's first one
        (signal.SIGKILL, {"reply_loss": 0.3, "corrupt": 0.1}),
    ],
    ids=["killed", "stopped", "half a packet", "bad line"],
)
def test_the_guardian_takes_the_torque_off(serve, start_host, number, faults):
    robot = serve()
    host = start_host(robot, silence_s=0.1 if number == signal.SIGSTOP else 0.5)
    robot.strike(**faults)
    since_ns = time.monotonic_ns()
    host.send_signal(number)
    time.sleep(0.5)
    assert_off(robot)
    for servo_id in IDS:
        effects = robot.truth().of(Kind.EFFECT, servo_id)
        off = effects[(effects["values"][:, 0] == OperatingMode.OFF) & (effects["t_ns"] > since_ns)]
        assert (off["t_ns"][0] - since_ns) * 1e-9 < 0.3
    host.kill()
    assert "torque is off, confirmed after" in host.communicate()[1]


def test_without_it_the_servos_hold_as_they_have_no_watchdog(serve, start_host):
    robot = serve()
    host = start_host(robot, guardian=False)
    host.kill()
    host.wait()
    time.sleep(0.3)
    assert [robot.bus.servos[i].get(reg.TORQUE_ENABLE) for i in IDS] == [1, 1, 1]
    assert robot.truth().of(Kind.EFFECT)["values"][-1, 0] == OperatingMode.POSITION


def test_without_the_guardian_the_control_process_stops(serve, connect):
    robot = serve()
    device = connect(robot, silence_s=0.2)
    device.enable()
    os.kill(device.guardian_pid, signal.SIGKILL)
    error = drive(device, 3.0)
    assert isinstance(error, SafetyStop)
    assert "the guardian has died" in str(error)
    device.close()
    assert_off(robot)


@pytest.mark.parametrize("faults", [{}, {"late": 0.3, "late_s": 0.009}, {"late": 0.3, "late_s": 0.006}])
def test_the_time_of_a_sample_is_right_or_said_to_be_unsure(serve, connect, faults):
    """The position tells when it was sampled: 0.4 ms a count."""
    robot = serve("Ramp", StsEmulation(return_delay_us=0, seed=5, **faults), ids=[1, 2], speed_rad_s=4.0)
    device = connect(robot, ids=(1, 2))
    readings = [device.measure() for _ in range(40)]
    sent_ns = np.array([r.transaction.t_sent_ns for r in readings])
    truth = robot.truth()
    # A revolution takes 1.6 s: on a busy machine 40 reads may take longer.
    sampled_s = np.unwrap([r.position_rad + np.pi for r in readings], axis=0) / 4.0
    sampled_s += (2048 * reg.RAD_PER_COUNT - np.pi) / 4.0
    since_s = (sent_ns - truth.header["start_ns"])[:, None] * 1e-9 - sampled_s
    assert since_s.max() < 0.001  # none was taken before its instruction was sent, as a stamp that is too late says
    assert np.median(np.abs(since_s)) < 0.001
    assert np.all(truth.of(Kind.SAMPLE)["t_ns"] >= truth.of(Kind.SAMPLE)["t_host_ns"])
    if faults:
        assert device.counters.late_replies >= 5


def test_a_gear_and_a_direction(serve, connect):
    robot = serve("Joints", ids=[1, 2, 3], start_rad=[0.5, -0.8, 0.3])
    joints = [
        Joint("a", 1, direction=-1),
        Joint("b", 2, gear=0.5),
        Joint("c", 3, zero_count=2148),
    ]
    device = connect(robot, joints=joints)
    expected = [-0.5, -0.4, 0.3 - 100 * reg.RAD_PER_COUNT]
    assert device.measure().position_rad == pytest.approx(expected, abs=reg.RAD_PER_COUNT)
    device.enable()
    assert device.rest() == pytest.approx(expected, abs=reg.RAD_PER_COUNT)
