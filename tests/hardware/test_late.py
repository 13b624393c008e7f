"""Answers that come late, or not at all: the time of a sample is right, or said to be unsure."""

import os
import signal
import time
from contextlib import suppress

import numpy as np
import pytest

from sim2real.errors import HardwareLost
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.emulation import EmulatorConfig
from sim2real.hardware.emulation.truth import Kind
from sim2real.hardware.plant import OperatingMode

pytestmark = pytest.mark.process

SPEED_RAD_S = 40.0


@pytest.mark.parametrize("ids", [(1,), (1, 2)])
@pytest.mark.parametrize("late_s", [0.009, 0.006])
def test_late_answers_do_not_move_the_time_of_a_sample(start_robot, open_bus, ids, late_s):
    """The position tells when it was sampled: 0.04 ms a count."""
    robot = start_robot("Ramp", EmulatorConfig(late=0.3, late_s=late_s, seed=5), ids=ids, speed_rad_s=SPEED_RAD_S)
    bus = open_bus(robot, ids)
    readings = [bus.read_state() for _ in range(60)]
    sampled_s = np.array([r.position_rad for r in readings]) / SPEED_RAD_S
    sent_s = np.array([r.transaction.t_sent_ns - robot.truth().header["start_ns"] for r in readings]) * 1e-9
    # None was taken before its instruction was sent, as a stamp that is too late says; later ones are the machine's.
    assert (sent_s[:, None] - sampled_s).max() < 0.002
    assert bus.counters.late_replies >= 10
    assert np.count_nonzero([r.transaction.late_ns > 4e6 for r in readings]) >= (10 if late_s < 0.008 else 0)
    assert np.median(bus.counters.late_s) < 0.1


def test_answers_in_time_are_not_called_late(start_robot, open_bus):
    bus = open_bus(start_robot(config=EmulatorConfig(reply_loss=0.1, seed=1)))
    for _ in range(40):
        bus.read_state()
    assert bus.counters.lost_replies >= 2
    assert bus.counters.late_replies < 10  # a busy machine may have some


def test_misses_in_a_row_are_no_lost_bus_while_they_are_short(start_robot, open_bus):
    """Five times 8 ms: on a busy laptop that happens, and a command may be 0.1 s old anyway."""
    robot = start_robot(config=EmulatorConfig(reply_loss=0.7, seed=1))
    bus = open_bus(robot, max_silence_s=0.2)
    assert max(bus.read_state().transaction.retries for _ in range(12)) >= 5


def test_a_late_answer_is_not_that_of_another_register(start_robot, open_bus):
    """Registers of one, two and four bytes in turn: the answer to a repeated read has the length of the next one's."""
    robot = start_robot(config=EmulatorConfig(late=0.5, late_s=0.03, seed=2))
    bus = open_bus(robot, max_silence_s=3.0)
    registers = (reg.MODEL_NUMBER, reg.FIRMWARE_VERSION, reg.PWM_LIMIT, reg.ID, reg.VELOCITY_LIMIT)
    for register in registers * 5:
        assert bus.read(1, register) == register.default, register.name
    assert bus.counters.late_replies >= 3


@pytest.mark.parametrize("fault", [{"late": 1.0, "late_s": 0.05}, {"silent_after_s": 0.0}], ids=["late", "silent"])
def test_the_torque_goes_off_at_once_on_a_bus_that_was_lost(start_robot, open_bus, fault):
    """A goal, a read, and then the end of the torque wait for an answer, which is late, or never comes."""
    robot = start_robot(config=EmulatorConfig(on_signal=True, **fault))
    bus = open_bus(robot, mode=OperatingMode.PWM, max_silence_s=0.3, silence_s=2.5)
    os.kill(robot.pid, signal.SIGUSR1)
    time.sleep(0.1)
    with suppress(HardwareLost):  # a late answer to the same goal counts
        bus.link.write(1, reg.GOAL_PWM, 9)
    with pytest.raises(HardwareLost, match=r"no answer to read of the state"):
        bus.read_state()
    lost_ns = time.monotonic_ns()
    with suppress(HardwareLost):
        bus.torque(False)
    assert (time.monotonic_ns() - lost_ns) * 1e-9 < 0.2
    if "late" in fault:  # a servo that is silent has lost its line, and stops itself
        robot.stop()
        last = robot.truth().of(Kind.EFFECT)[-1]
        assert last["values"][0] == OperatingMode.OFF
        assert (last["t_ns"] - lost_ns) * 1e-9 < 0.2
