"""The guardian: what it is told over its connection, what it needs, and when it says nothing.

When it acts is in test_ways_out.py, and its process in tests/process/test_guardian.py.
"""

import socket
import subprocess
import sys

import numpy as np
import pytest
from families import IDS, VOLTS

from sim2real.emulation.truth import Kind
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


def test_silence_is_allowed_while_torque_is_off_and_the_port_is_free_afterwards():
    robot = VOLTS.robot()
    with VOLTS.device(robot, silence_s=0.1) as device:
        device.enable()
        device.disable()
        robot.stall(0.3)
        device.enable()
        device.command(np.full(3, 2.5))
    assert robot.reports == []
    with VOLTS.device(robot) as device:
        device.enable()
        assert VOLTS.on(robot) == list(IDS)


def test_it_says_nothing_on_the_bus_while_all_is_well():
    robot = VOLTS.robot()
    with VOLTS.device(robot, silence_s=1.0) as device:
        device.enable()
        opened_ns, before = robot.now_ns(), device.counters.transactions
        for _ in range(50):
            device.measure()
            robot.sleep(0.005)
        done_ns, asked = robot.now_ns(), device.counters.transactions - before
    rows = robot.truth().rows
    inside = (rows["t_ns"] > opened_ns) & (rows["t_ns"] < done_ns)
    replies = np.count_nonzero(np.isin(rows["kind"][inside], (Kind.SAMPLE, Kind.REPLY)))
    assert (replies, asked) == (50 * len(IDS), 50)


def test_without_it_a_servo_that_only_notices_goes_on_when_its_host_dies():
    """An XL330: docs/guides/safety.md says so."""
    robot = VOLTS.robot(settings={"model_number": 1200})
    device = VOLTS.device(robot, silence_s=0.2, guardian=False)
    device.open()
    device.enable()
    device.command(np.full(3, 3.5))
    robot.kill_host()
    robot.sleep(1.0)
    truth = robot.truth()
    assert truth.of(Kind.WATCHDOG).size == len(IDS)
    assert truth.of(Kind.EFFECT)["values"][-1, :2].tolist() == [OperatingMode.PWM, pytest.approx(0.7, abs=1e-3)]
