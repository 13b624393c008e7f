"""Faults x families x ways out, in virtual time: the reason is right, and the motors are safe within a time."""

import re
from contextlib import nullcontext, suppress
from dataclasses import dataclass

import numpy as np
import pytest
from families import ANGLES, BOARD, LEGS, ROBOTS, SERVOS, VOLTS

from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.safety import guardian

PERIOD_S = 0.02
SILENCE_S = 0.1
BEGIN_S = 0.3
"""When the fault begins, in a loop that commands and measures."""


@pytest.fixture(autouse=True)
def impatient_guardian(monkeypatch):
    """A guardian tries for 1 s instead of 10 to reach motors that are silent."""
    monkeypatch.setattr(guardian, "GIVE_UP_S", 1.0)


def strike(**faults):
    return lambda family, robot, rig: robot.strike(**faults)


def reboot(family, robot, rig):
    rig.device.link.port.write(rig.device.link.form.build(2, Instruction.REBOOT))


def kill_guardian(family, robot, rig):
    robot.guardian_lives = False


def slow_limit(family, robot, rig):
    rig.gate.config.__dict__["max_speed_rad_s"] = 0.01


def stall(family, robot, rig):
    robot.stall(1.0)


@dataclass(frozen=True)
class Fault:
    """A fault, the error that ends the loop and a noun of its reason, and the longest time until motors are safe [s].

    `safe_in` are the families whose motors are safe then, if not all.
    """

    begin: object
    error: type
    noun: str
    within_s: float
    families: tuple = ROBOTS
    safe_in: tuple = ROBOTS


GUARDED = tuple(f for f in ROBOTS if f is not BOARD)
NO_LINE_S = SILENCE_S + 2 * PERIOD_S + 0.02
FAULTS = {
    # Then only a motor's own watchdog can stop it, as docs/guides/safety.md says: in position mode where it is, with
    # torque on; the STS and the Go2 have none.
    "silent motors": Fault(
        strike(silent_after_s=0.0), HardwareLost, "no answer|no state", NO_LINE_S, safe_in=(VOLTS, BOARD)
    ),
    "a port that is gone": Fault(
        strike(unplugged_after_s=0.0), HardwareLost, "failed", NO_LINE_S, (*SERVOS, BOARD), (VOLTS, BOARD)
    ),
    "answers that are late": Fault(strike(late=1.0, late_s=0.3), HardwareLost, "no answer|no state", 0.25),
    "answers that are damaged": Fault(strike(corrupt=1.0), HardwareLost, "no answer|wrong CRC", 0.25),
    "wild readings": Fault(strike(wild=1.0), SafetyStop, "reads", PERIOD_S + 0.01, (*SERVOS, BOARD)),
    "a frozen encoder": Fault(strike(frozen_after_s=0.0), SafetyStop, "has read", 0.15, (VOLTS, BOARD)),
    "a servo that restarts": Fault(reboot, SafetyStop, "servo 2", 0.6, SERVOS),
    "a guardian that has died": Fault(kill_guardian, SafetyStop, "guardian", PERIOD_S + 0.02, GUARDED),
    "a command that is no number": Fault(None, SafetyStop, "not finite", PERIOD_S),
    "a joint that is too fast": Fault(slow_limit, SafetyStop, "limit of 0.01 rad/s", PERIOD_S, (VOLTS, BOARD)),
    "a process that was stopped": Fault(stall, SafetyStop, "guardian|stopped itself", SILENCE_S + 0.02),
}
WAYS = ("stop", "stop_quietly", "the end of the context")
CASES = [
    pytest.param(
        family, name, way, id=f"{name}-{family.name}-{way}",
        marks=pytest.mark.night if family not in (VOLTS, BOARD) and way != "stop" else (),
    )
    for name, fault in FAULTS.items()
    for family in fault.families
    for way in WAYS
]  # fmt: skip


def step(family, robot, rig, command=None):
    """One turn of a control loop."""
    rig.measure()
    rig.require_fresh()
    rig.command(family.moving if command is None else command, 0.0, 1e-9 * robot.now_ns())
    robot.sleep(PERIOD_S)


def loop(family, robot, rig, steps, command=None):
    for _ in range(steps):
        step(family, robot, rig, command)


def run(family, name, way):
    """Run a loop into a fault, and leave it; return the error, the time of the fault [ns], and the truth."""
    fault, robot = FAULTS[name], family.robot()
    with family.rig(robot, {"max_speed_rad_s": 30.0}, silence_s=SILENCE_S) as rig:
        rig.start()
        while robot.now_ns() < 1e9 * BEGIN_S:
            step(family, robot, rig)
        begin_ns = robot.now_ns()
        if fault.begin is not None:
            fault.begin(family, robot, rig)
        with pytest.raises((HardwareLost, SafetyStop)) as raised:
            loop(family, robot, rig, 200, None if fault.begin else np.full_like(family.moving, np.nan))
        if way == "stop":
            # Motors that cannot confirm are named, but keep nothing from being switched off.
            with suppress(HardwareLost) if fault.error is HardwareLost else nullcontext():
                rig.stop()
        elif way == "stop_quietly":
            rig.stop_quietly()
    robot.sleep(0.6)  # legs lie down meanwhile
    return raised.value, begin_ns, robot.truth()


def safe_ns(family, truth):
    """Return since when all motors are safe for good [ns]; None: they are not."""
    rows = truth.of(Kind.EFFECT)
    since = []
    for i in np.unique(rows["servo_id"]):
        own = rows[rows["servo_id"] == i]
        safe = family.is_safe(own)
        if not safe[-1] or (family is LEGS and own["values"][-1, 0]):
            return None
        if i == 0 or family is not LEGS:  # all commands of legs are those of the first motor
            since.append(own["t_ns"][np.flatnonzero(~safe)[-1] + 1])
    return max(since)


@pytest.mark.parametrize(("family", "name", "way"), CASES)
def test_a_fault_ends_with_its_reason_and_safe_motors(family, name, way):
    fault = FAULTS[name]
    error, begin_ns, truth = run(family, name, way)
    assert type(error) is fault.error
    assert re.search(fault.noun, str(error))
    if family not in fault.safe_in:
        assert bool(truth.of(Kind.WATCHDOG).size) == (family is ANGLES)
        return
    off_ns = safe_ns(family, truth)
    assert off_ns is not None
    assert (off_ns - begin_ns) * 1e-9 < fault.within_s
    # Not a matter of chance: once more, to the tick.
    if (name, way) == ("a process that was stopped", "stop"):
        assert safe_ns(family, run(family, name, way)[2]) == off_ns


@pytest.mark.parametrize("family", ROBOTS, ids=[f.name for f in ROBOTS])
@pytest.mark.parametrize("in_the_middle", [False, True])
def test_a_host_that_is_killed_leaves_no_torque(family, in_the_middle):
    """The guardian, at once; the host may die in the middle of a packet, which swallows the guardian's first one."""
    robot = family.robot()
    rig = family.rig(robot, silence_s=0.3)
    rig.start()
    loop(family, robot, rig, 10)
    if in_the_middle and family is not LEGS:
        robot.write(b"v 0 0.1" if family is BOARD else rig.device.link.off_packet[:9])
    killed_ns = robot.now_ns()
    robot.kill_host()
    robot.sleep(0.8)
    assert family.on(robot) == []
    within_s = 0.301 if family is BOARD else 0.05  # a board has no guardian, but a watchdog
    assert (safe_ns(family, robot.truth()) - killed_ns) * 1e-9 < within_s
    assert family is BOARD or any("is gone: torque is off" in report for report in robot.reports)


@pytest.mark.parametrize("family", ROBOTS, ids=[f.name for f in ROBOTS])
def test_a_stalled_policy_gets_the_fallback_while_measuring_goes_on(family):
    robot = family.robot()
    with family.rig(robot, {"command_timeout_s": 0.1}, silence_s=0.5) as rig:
        rig.start()
        loop(family, robot, rig, 10)
        # The last command is one period old. The watchdog looks every 20 ms.
        sent_ns = robot.now_ns() - round(1e9 * PERIOD_S)
        while robot.now_ns() < sent_ns + 500_000_000:
            rig.measure()
            robot.sleep(0.01)
            assert rig.timeouts == 0 or robot.now_ns() > sent_ns + 100_000_000
        assert 3 <= rig.timeouts <= 5
        np.testing.assert_array_equal(rig._sent, 0.0 if family in (VOLTS, BOARD) else rig.gate.fallback)
        step(family, robot, rig)  # a loop that comes back goes on
        rig.stop()


@pytest.mark.parametrize("timeout_s", [0.1, 2.0])
@pytest.mark.parametrize("family", ROBOTS, ids=[f.name for f in ROBOTS])
def test_a_slow_start_trips_no_watchdog(family, timeout_s):
    """A graph that takes its time between torque on and the first command."""
    robot = family.robot()
    with family.rig(robot, {"command_timeout_s": timeout_s}, silence_s=0.2) as rig:
        rig.start()
        robot.sleep(5.0)
        step(family, robot, rig)
        assert rig.timeouts == 0
    assert not robot.truth().of(Kind.WATCHDOG).size
    assert robot.reports == []
