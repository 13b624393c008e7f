"""The guardian: what it is told over its connection, what it needs, and when it says nothing.

When it acts is in test_ways_out.py, and its process in tests/process/test_guardian.py.
"""

import socket
import subprocess
import sys

import numpy as np
import pytest

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.truth import Kind
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.safety import guardian
from sim2real.hardware.safety.guardian import BEAT, REST, Guard, Motors
from sim2real.runtime import clock


def test_it_never_waits_for_the_threads_that_it_watches():
    """Where its priority is not allowed none is taken."""
    assert clock._PRIORITY < guardian.PRIORITY == clock._GUARDIAN_PRIORITY


def test_it_needs_little_and_so_starts_soon():
    code = "import sys; import sim2real.hardware.bus.port; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"numpy", "jax", "mujoco", "serial"} & set(loaded)


@pytest.mark.parametrize(("last", "acts"), [(BEAT, ["the control process is gone"]), (REST, [])])
def test_a_robot_whose_torque_was_off_may_have_another_master(last, acts):
    """The death of the control process counts for legs only while their torque is on."""

    link, other = socket.socketpair()
    with link, other:
        told = []
        guard = Guard(Motors(lambda: "", at_rest=False), 0.0, lambda message: None, told.append)
        other.send(BEAT)
        other.send(last)
        other.shutdown(socket.SHUT_WR)
        guard.watch(link.fileno())
        assert len(told) == len(acts)
        assert all(reason in text for reason, text in zip(acts, told, strict=True))


def test_silence_is_allowed_while_torque_is_off_and_the_port_is_free_afterwards(start_robot, open_servos):
    robot = start_robot()
    device = open_servos(robot, silence_s=0.1)
    device.disable()
    robot.stall(0.3)
    device.enable()
    device.command(np.array([2.5]))
    device.close()
    assert robot.reports == []
    assert open_servos(robot).link.read(1, reg.TORQUE_ENABLE) == 1


def test_it_says_nothing_on_the_bus_while_all_is_well(start_robot, open_servos):
    robot = start_robot()
    device = open_servos(robot)
    opened_ns, before = robot.now_ns(), device.counters.transactions
    for _ in range(50):
        device.measure()
        robot.sleep(0.005)
    done_ns, asked = robot.now_ns(), device.counters.transactions - before
    device.close()
    rows = robot.truth().rows
    inside = (rows["t_ns"] > opened_ns) & (rows["t_ns"] < done_ns)
    assert np.count_nonzero(np.isin(rows["kind"][inside], (Kind.SAMPLE, Kind.REPLY))) == asked == 50


def test_without_it_a_servo_that_only_notices_goes_on_when_its_host_dies(start_robot, open_servos):
    """An XL330: docs/guides/safety.md says so."""
    robot = start_robot(config=EmulatorConfig(model_number=1200))
    open_servos(robot, silence_s=0.2, guardian=False).command(np.array([3.5]))
    robot.kill_host()
    robot.sleep(1.0)
    truth = robot.truth()
    assert truth.of(Kind.WATCHDOG).size == 1
    assert truth.of(Kind.EFFECT)["values"][-1, :2].tolist() == [OperatingMode.PWM, pytest.approx(0.7, abs=1e-3)]
