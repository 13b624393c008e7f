"""Faults x families x ways out, in virtual time: the reason is right, and the motors are safe within a time."""

from contextlib import nullcontext, suppress
from dataclasses import dataclass

import numpy as np
import pytest
from families import FAMILIES, STS, VOLTS

from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.safety import guardian_process

PERIOD_S = 0.02
SILENCE_S = 0.1
BEGIN_S = 0.3
"""When the fault begins, in a loop that commands and measures."""


@pytest.fixture(autouse=True)
def impatient_guardian(monkeypatch):
    """A guardian tries for 1 s instead of 10 to reach servos that are silent."""
    monkeypatch.setattr(guardian_process, "GIVE_UP_S", 1.0)


def strike(**faults):
    return lambda robot, rig: robot.strike(**faults)


def reboot(robot, rig):
    rig.device.link.port.write(rig.device.link.form.build(2, Instruction.REBOOT))


def kill_guardian(robot, rig):
    robot.guardian_lives = False


@dataclass(frozen=True)
class Fault:
    """A fault, the error that ends the loop, and the longest time until the motors are safe [s].

    `lost` is the line: then only a servo's own watchdog can stop it.
    """

    begin: object
    error: type
    noun: str
    within_s: float
    lost: bool = False
    families: tuple = FAMILIES


NO_LINE_S = SILENCE_S + 2 * PERIOD_S + 0.02
FAULTS = {
    "silent servos": Fault(strike(silent_after_s=0.0), HardwareLost, "no answer", NO_LINE_S, lost=True),
    "a port that is gone": Fault(strike(unplugged_after_s=0.0), HardwareLost, "failed", NO_LINE_S, lost=True),
    "answers that are late": Fault(strike(late=1.0, late_s=0.3), HardwareLost, "no answer", 0.25),
    "answers that are damaged": Fault(strike(corrupt=1.0), HardwareLost, "no answer", 0.25),
    "wild readings": Fault(strike(wild=1.0), SafetyStop, "reads", PERIOD_S + 0.01),
    "a frozen encoder": Fault(strike(frozen_after_s=0.0), SafetyStop, "has read", 0.15, families=(VOLTS,)),
    "a servo that restarts": Fault(reboot, SafetyStop, "servo 2", 0.6),
    "a guardian that has died": Fault(kill_guardian, SafetyStop, "guardian", PERIOD_S + 0.02),
    "a command that is no number": Fault(None, SafetyStop, "not finite", PERIOD_S),
    "a joint that is too fast": Fault(None, SafetyStop, "limit of 0.01 rad/s", PERIOD_S, families=(VOLTS,)),
    "a process that was stopped": Fault(None, SafetyStop, "guardian", SILENCE_S + 0.02),
}
CASES = [(family, name) for name, fault in FAULTS.items() for family in fault.families]
IDS = [f"{name}-{family.name}" for family, name in CASES]


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
    fault, robot, error, command = FAULTS[name], family.robot(), None, None
    gate = {"max_speed_rad_s": 30.0}
    with family.rig(robot, gate, silence_s=SILENCE_S) as rig:
        rig.start()
        while robot.now_ns() < 1e9 * BEGIN_S:
            step(family, robot, rig)
        begin_ns = robot.now_ns()
        if fault.begin is not None:
            fault.begin(robot, rig)
        elif name == "a command that is no number":
            command = np.full(3, np.nan)
        elif name == "a joint that is too fast":
            rig.gate.config.__dict__["max_speed_rad_s"] = 0.01
        else:
            robot.stall(1.0)
        with pytest.raises((HardwareLost, SafetyStop)) as raised:
            loop(family, robot, rig, 200, command)
        error = raised.value
        if way == "stop":
            # Servos that cannot confirm are named, but keep nothing from being switched off.
            with suppress(HardwareLost) if fault.error is HardwareLost else nullcontext():
                rig.stop()
        elif way == "stop_quietly":
            rig.stop_quietly()
    robot.sleep(0.3)
    return error, begin_ns, robot.truth()


def safe_ns(truth):
    """Return since when all motors are safe for good [ns]: off, or without a voltage; None: they are not."""
    rows = truth.of(Kind.EFFECT)
    since = []
    for i in np.unique(rows["servo_id"]):
        own = rows[rows["servo_id"] == i]
        safe = (own["values"][:, 0] == 0) | ((own["values"][:, 0] == 16) & (own["values"][:, 1] == 0.0))
        if not safe[-1]:
            return None
        since.append(own["t_ns"][np.flatnonzero(~safe)[-1] + 1])
    return max(since)


@pytest.mark.parametrize("way", ["stop", "stop_quietly", "the end of the context"])
@pytest.mark.parametrize(("family", "name"), CASES, ids=IDS)
def test_a_fault_ends_with_its_reason_and_safe_motors(family, name, way):
    fault = FAULTS[name]
    error, begin_ns, truth = run(family, name, way)
    assert type(error) is fault.error
    assert fault.noun in str(error)
    if fault.lost and not truth.of(Kind.WATCHDOG).size:
        # Without a line and without a watchdog of its own a servo goes on, as docs/guides/safety.md says.
        assert family is STS
        return
    off_ns = safe_ns(truth)
    if fault.lost and family is not VOLTS:
        return  # its watchdog stops it where it is, with torque on
    assert off_ns is not None
    assert (off_ns - begin_ns) * 1e-9 < fault.within_s
    # Not a matter of chance: once more, to the tick.
    if way == "stop":
        assert safe_ns(run(family, name, way)[2]) == off_ns


@pytest.mark.parametrize("family", FAMILIES, ids=[f.name for f in FAMILIES])
@pytest.mark.parametrize("in_the_middle", [False, True])
def test_a_host_that_is_killed_leaves_no_torque(family, in_the_middle):
    """The guardian, at once; the host may die in the middle of a packet, which swallows the guardian's first one."""
    robot = family.robot()
    rig = family.rig(robot, silence_s=0.5)
    rig.start()
    loop(family, robot, rig, 10)
    if in_the_middle:
        robot.write(rig.device.link.off_packet[:9])
    killed_ns = robot.now_ns()
    robot.kill_host()
    robot.sleep(0.2)
    assert family.on(robot) == []
    assert (safe_ns(robot.truth()) - killed_ns) * 1e-9 < 0.05
    assert any("is gone: torque is off" in report for report in robot.reports)


@pytest.mark.parametrize("family", FAMILIES, ids=[f.name for f in FAMILIES])
def test_a_stalled_policy_gets_the_fallback_while_measuring_goes_on(family):
    robot = family.robot()
    with family.rig(robot, {"command_timeout_s": 0.1}, silence_s=0.5) as rig:
        rig.start()
        loop(family, robot, rig, 10)
        # The last command is one period old. The watchdog looks every 20 ms.
        for k in range(50):
            rig.measure()
            robot.sleep(0.01)
            assert rig.timeouts == (0 if k < 7 else rig.timeouts)
        assert 3 <= rig.timeouts <= 5
        np.testing.assert_array_equal(rig._sent, 0.0 if family is VOLTS else rig.gate.fallback)
        step(family, robot, rig)  # a loop that comes back goes on
        rig.stop()


@pytest.mark.parametrize("timeout_s", [0.1, 2.0])
@pytest.mark.parametrize("family", FAMILIES, ids=[f.name for f in FAMILIES])
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
