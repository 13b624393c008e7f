"""The guardian's process, for three servos whose firmware notices a dead host but does not stop them.

How soon it acts is exact in virtual time, in tests/hardware/test_ways_out.py; here it acts at all, and in order.
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from emulator import EmulatedProcess

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.truth import Kind
from sim2real.errors import SAFETY_STOP
from sim2real.hardware.device import OperatingMode

pytestmark = pytest.mark.process

PLANTS = Path(__file__).parents[1] / "hardware" / "plants.py"
IDS = (1, 2, 3)
XL330 = 1200
SILENCE_S = 1.0
HOST = """
import os, signal, sys, time
import numpy as np
from sim2real.errors import Sim2RealError
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import VoltageDrive
from sim2real.hardware.dynamixel import DynamixelServos

bus = DynamixelServos(BusConfig({port!r}, silence_s={silence_s}, max_silence_s=1.0), (1, 2, 3), VoltageDrive(1.0))
bus.open()

def die_in_the_middle_of_a_packet(number, frame):
    bus.link.port.write(bus._off_packet[:9] + bytes(3))
    os.kill(os.getpid(), signal.SIGKILL)

signal.signal(signal.SIGUSR1, die_in_the_middle_of_a_packet)
bus.enable()
goals = np.full(3, 0.7)
bus.command(goals)
print(bus.link.guardian._channel.pid, flush=True)
try:
    while True:
        bus.command(goals)
        bus.measure()
        time.sleep(0.01)
except Sim2RealError as error:
    bus.close()
    print(error, flush=True)
    sys.exit(error.exit_code)
"""


@pytest.fixture
def turning(tmp_path):
    """Servos, the process that turns them, and the number of the guardian's process."""
    config = EmulatorConfig(model_number=XL330, actuation_latency_s=0.0)  # off has had its effect when it is confirmed
    with EmulatedProcess(f"{PLANTS}:FirstOrder", config, {"ids": IDS}, tmp_path / "truth.bin") as robot:
        code = HOST.format(port=robot.port, silence_s=SILENCE_S)
        host = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        guardian = host.stdout.readline().strip()
        assert guardian, host.stderr.read()
        yield robot, host, int(guardian)
        host.kill()
        host.communicate()


def assert_off(robot, host):
    """Wait for the guardian's end, which holds the other end of stderr; the motors turned, and then let go for good."""
    said = host.communicate(timeout=60)[1]
    robot.stop()
    for servo in IDS:
        modes, goals = robot.truth().of(Kind.EFFECT, servo)["values"][:, :2].T
        assert goals.max() == pytest.approx(0.7, abs=1e-3)
        last = np.flatnonzero(modes == OperatingMode.PWM)[-1]
        assert modes[last + 1 :].tolist() == [OperatingMode.OFF] * (len(modes) - last - 1)
        assert len(modes) > last + 1
    assert "torque is off, confirmed after" in said
    return said


def test_a_host_that_dies_in_the_middle_of_a_packet(turning):
    robot, host, _ = turning
    host.send_signal(signal.SIGUSR1)
    assert "the control process is gone" in assert_off(robot, host)


def test_a_host_that_is_stopped_and_continued_ends_with_the_reason(turning):
    robot, host, _ = turning
    host.send_signal(signal.SIGSTOP)
    while OperatingMode.OFF not in robot.truth().of(Kind.EFFECT)["values"][:, 0]:
        time.sleep(0.05)
    host.send_signal(signal.SIGCONT)
    assert host.wait(60.0) == SAFETY_STOP
    assert "the guardian has taken the torque off: this process was silent" in host.stdout.read()
    assert "the control process was silent" in assert_off(robot, host)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux continues a stopped process whose parent has died")
def test_a_guardian_that_was_stopped_before_its_host_was_killed(turning):
    robot, host, guardian = turning
    os.kill(guardian, signal.SIGSTOP)
    host.kill()
    assert "the control process is gone" in assert_off(robot, host)


def test_it_outlives_what_a_terminal_and_a_service_manager_send(turning):
    robot, host, guardian = turning
    assert os.getsid(guardian) != os.getsid(host.pid)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(guardian, number)
    host.kill()
    assert "the control process is gone" in assert_off(robot, host)
