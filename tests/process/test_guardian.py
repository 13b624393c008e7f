"""The guardian, for three servos whose firmware notices a dead host but does not stop; measured on the truth's side."""

import os
import resource
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from sim2real.emulation import process as emulator
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.truth import Kind
from sim2real.errors import SAFETY_STOP, SafetyStop
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.safety import guardian_process
from sim2real.runtime import clock

pytestmark = pytest.mark.process

IDS = (1, 2, 3)
XL330 = 1200
HOST = """
import os, signal, sys, time
from sim2real.errors import Sim2RealError
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus
from sim2real.hardware.device import OperatingMode

bus = ServoBus(BusConfig({port!r}, silence_s={silence_s}, max_silence_s=1.0, guardian={guardian}))
bus.open()

def die_in_the_middle_of_a_packet(number, frame):
    bus.link.port.write(bus._off_packet[:9] + bytes(3))
    os.kill(os.getpid(), signal.SIGKILL)

signal.signal(signal.SIGUSR1, die_in_the_middle_of_a_packet)
ids = (1, 2, 3)
bus.handshake(dict.fromkeys(ids))
bus.setup(OperatingMode.PWM)
bus.torque(True)
bus.write_goal_pwm(dict.fromkeys(ids, 0.7))
print(bus.guardian_pid, flush=True)
try:
    while True:
        bus.write_goal_pwm(dict.fromkeys(ids, 0.7))
        bus.read_state()
        time.sleep(0.01)
except Sim2RealError as error:
    bus.close()
    print(error, flush=True)
    sys.exit(error.exit_code)
"""


def test_it_never_waits_for_the_threads_that_it_watches():
    """An emulated servo comes between: a real one waits for nobody. Where its priority is not allowed none is taken."""
    assert clock._PRIORITY < emulator._REAL_TIME_PRIORITY < guardian_process._PRIORITY == clock._GUARDIAN_PRIORITY


@pytest.fixture
def start_host(start_robot):
    """Start servos and a process that turns them; return robot, process and the guardian's process."""
    hosts = []

    def start(guardian=True, silence_s=0.5, **config):
        robot = start_robot(config=EmulatorConfig(model_number=XL330, actuation_latency_s=0.01, **config), ids=IDS)
        code = HOST.format(port=robot.port, guardian=guardian, silence_s=silence_s)
        host = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        hosts.append(host)
        pid = host.stdout.readline().strip()
        assert pid, host.stderr.read()
        time.sleep(0.2)
        return robot, host, pid

    yield start
    for host in hosts:
        host.kill()
        host.communicate()


def modes_of(robot):
    """Return for each servo when commands took effect [ns], and their modes and goals."""
    robot.stop()
    truth = robot.truth()
    rows = [truth.of(Kind.EFFECT, i) for i in IDS]
    return [(r["t_ns"], r["values"][:, 0], r["values"][:, 1]) for r in rows]


def assert_off_soon(robot, since_ns, within_s=0.2):
    for t_ns, modes, goals in modes_of(robot):
        before = t_ns <= since_ns
        assert (modes[before][-1], goals[before][-1]) == (OperatingMode.PWM, pytest.approx(0.7, abs=1e-3))
        off = np.flatnonzero(modes == OperatingMode.OFF)
        after = off[t_ns[off] > since_ns]
        assert after.size
        assert (t_ns[after[0]] - since_ns) * 1e-9 < within_s
        assert np.all(modes[after[0] :] == OperatingMode.OFF)  # and nothing switches it on again


def test_without_a_guardian_this_firmware_goes_on_when_its_host_is_killed(start_host):
    robot, host, _ = start_host(guardian=False, silence_s=0.2)
    host.kill()
    time.sleep(0.4)
    for _, modes, goals in modes_of(robot):
        assert (modes[-1], goals[-1]) == (OperatingMode.PWM, pytest.approx(0.7, abs=1e-3))
    assert len(robot.truth().of(Kind.WATCHDOG)) == len(IDS)  # they did notice


@pytest.mark.parametrize(
    ("number", "faults"),
    [
        (signal.SIGKILL, {}),
        (signal.SIGSTOP, {}),
        (signal.SIGUSR1, {}),  # dies in the middle of a packet, which swallows the guardian's first one
        (signal.SIGKILL, {"reply_loss": 0.3, "corrupt": 0.1, "seed": 3}),
    ],
    ids=["killed", "stopped", "half a packet", "bad line"],
)
def test_torque_is_off_within_200_ms(start_host, number, faults):
    robot, host, _ = start_host(silence_s=0.1 if number == signal.SIGSTOP else 0.5, **faults)
    since_ns = time.monotonic_ns()
    host.send_signal(number)
    time.sleep(0.5)
    assert_off_soon(robot, since_ns)
    host.kill()
    said = host.communicate()[1]
    reason = "was silent for 0.11 s" if number == signal.SIGSTOP else "is gone"
    assert f"sim2real guardian: the control process {reason}: torque is off, confirmed after" in said


def test_a_process_that_wakes_again_ends_with_torque_off(start_host):
    robot, host, _ = start_host(silence_s=0.3)
    since_ns = time.monotonic_ns()
    host.send_signal(signal.SIGSTOP)
    time.sleep(0.6)
    host.send_signal(signal.SIGCONT)
    assert host.wait(10.0) == SAFETY_STOP
    assert "the guardian has taken the torque off: this process was silent for 0.3 s" in host.stdout.read()
    assert_off_soon(robot, since_ns, within_s=0.5)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux continues a stopped process whose parent has died")
@pytest.mark.parametrize("after_s", [0.0, 0.01])
def test_torque_is_off_though_the_guardian_was_stopped_before_the_host_died(start_host, after_s):
    robot, host, pid = start_host()
    since_ns = time.monotonic_ns()
    os.kill(int(pid), signal.SIGSTOP)
    time.sleep(after_s)
    host.kill()
    time.sleep(0.4)
    assert_off_soon(robot, since_ns)
    assert "sim2real guardian: the control process is gone: torque is off" in host.communicate()[1]


def test_it_outlives_what_a_terminal_and_a_service_manager_send(start_host):
    robot, host, pid = start_host()
    assert os.getsid(int(pid)) != os.getsid(host.pid)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(int(pid), number)
    time.sleep(0.1)
    since_ns = time.monotonic_ns()
    host.kill()
    time.sleep(0.3)
    assert_off_soon(robot, since_ns)


@pytest.mark.parametrize("way", ["it acted", "it died"])
def test_torque_is_taken_off_in_order_whatever_became_of_it(start_robot, open_bus, way):
    robot = start_robot()
    bus = open_bus(robot, mode=OperatingMode.PWM, silence_s=0.1)
    bus.write_goal_pwm({1: 0.5})
    if way == "it died":
        os.kill(bus.guardian_pid, signal.SIGKILL)
    time.sleep(0.3)
    bus.torque(False)
    assert bus.read(1, reg.TORQUE_ENABLE) == 0
    with pytest.raises(SafetyStop, match=r"the guardian has (taken the torque off|died)"):
        bus.torque(True)
    assert bus.read(1, reg.TORQUE_ENABLE) == 0


def test_without_it_the_control_process_stops(start_robot, open_bus):
    robot = start_robot()
    bus = open_bus(robot, mode=OperatingMode.PWM, silence_s=0.4)
    bus.write_goal_pwm({1: 0.5})
    os.kill(bus.guardian_pid, signal.SIGKILL)
    begin = time.monotonic()
    with pytest.raises(SafetyStop, match="the guardian has died"):  # noqa: PT012 - it takes its time
        while time.monotonic() < begin + 10.0:
            bus.write_goal_pwm({1: 0.5})
            time.sleep(0.002)
    noticed_s = time.monotonic() - begin
    assert noticed_s < 0.2, "signs of life are 40 ms apart"
    bus.close()
    robot.stop()
    assert robot.truth().of(Kind.EFFECT)["values"][-1, 0] == OperatingMode.OFF


def test_silence_is_allowed_while_torque_is_off_and_the_port_is_free_afterwards(start_robot, open_bus):
    robot = start_robot()
    bus = open_bus(robot, mode=OperatingMode.PWM, silence_s=0.1)
    first = bus.guardian_pid
    bus.torque(False)
    time.sleep(0.3)
    bus.torque(True)
    assert bus.guardian_pid == first
    bus.write_goal_pwm({1: 0.5})
    bus.close()
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
    again = open_bus(robot, mode=OperatingMode.PWM)
    assert again.read(1, reg.TORQUE_ENABLE) == 1


def test_it_says_nothing_on_the_bus_while_all_is_well(start_robot, open_bus):
    robot = start_robot()
    bus = open_bus(robot, mode=OperatingMode.PWM)
    opened_ns, opened = time.monotonic_ns(), bus.counters.transactions + bus.counters.retries
    for _ in range(50):
        bus.read_state()
        time.sleep(0.005)
    done_ns, asked = time.monotonic_ns(), bus.counters.transactions + bus.counters.retries - opened
    bus.close()
    robot.stop()
    rows = robot.truth().rows
    inside = (rows["t_ns"] > opened_ns) & (rows["t_ns"] < done_ns)
    # The opening and the closing send packets that no counter has: count between them.
    assert 50 <= np.count_nonzero(np.isin(rows["kind"][inside], (Kind.SAMPLE, Kind.REPLY))) <= asked


def test_it_needs_little_and_so_starts_soon():
    code = "import sys; sys.path.insert(0, sys.argv[1]); import guardian_process; print(*sys.modules)"
    command = [sys.executable, "-I", "-S", "-c", code, os.path.dirname(guardian_process.__file__)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    loaded = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert not {"numpy", "sim2real", "re", "typing", "dataclasses", "subprocess", "socket"} & set(loaded)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.1
