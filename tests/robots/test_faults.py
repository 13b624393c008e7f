"""Faults x embedded robots, in virtual time: each ends with the reason that is expected, and with safe motors."""

import importlib.util
import random
import re
from functools import cache

import numpy as np
import pytest
from embedded import HZ, drive, make

from sim2real.emulation.truth import Kind
from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware.bus.packets import Instruction
from sim2real.hardware.safety import guardian

ROBOTS = ("pendulum", "arm", "so101", *(("go2",) if importlib.util.find_spec("cyclonedds") else ()))
SEEDS = range(4)
BACK_S = 0.3
"""When a cable is plugged in again, while the guardian still tries."""
JOINT = {"pendulum": "hinge", "arm": "shoulder", "so101": "shoulder_lift", "go2": "FR_thigh"}
SOON_S, SILENT_S, FOLLOWS_S = 0.06, 0.25, 0.55

# fault: the error, the noun of its reason for each robot, and the longest time until motors are safe [s]. A robot
# without a noun does not have the fault: a Go2 has neither a serial port nor registers, its motors report the torque of
# their law also against an obstacle, and a pendulum has one servo, which confirms its goals.
FAULTS = {
    "silent": (HardwareLost, dict.fromkeys(ROBOTS, "no answer|no state"), SILENT_S),
    "unplugged": (HardwareLost, dict.fromkeys(("pendulum", "arm", "so101"), "failed"), SILENT_S),
    "late": (HardwareLost, dict.fromkeys(ROBOTS, "no answer|no state"), SILENT_S),
    "damaged": (HardwareLost, dict.fromkeys(ROBOTS, "no answer|wrong CRC"), SILENT_S),
    "wild": (SafetyStop, dict.fromkeys(("pendulum", "arm", "so101"), "reads"), SOON_S),
    "frozen": (
        SafetyStop,
        {"pendulum": "has read|push", "arm": "has read|away|reads", "so101": "has read|away|reads"},
        FOLLOWS_S,
    ),
    "restarts": (SafetyStop, {"pendulum": "servo 1|push", "arm": "servo 2", "so101": "servo 2"}, 0.6),
    "no number": (SafetyStop, dict.fromkeys(ROBOTS, "not finite"), SOON_S),
    "killed": (None, dict.fromkeys(ROBOTS, "is gone: torque is off"), 0.3),
    "stopped": (SafetyStop, dict.fromkeys(ROBOTS, "guardian"), 0.3),
    "no guardian": (SafetyStop, dict.fromkeys(ROBOTS, "guardian has died"), SOON_S),
    "torque off": (SafetyStop, {"pendulum": "push|has lost", "arm": "away|has lost", "so101": "has lost"}, 0.6),
    "lets go": (SafetyStop, {name: f"{joint}.*(away|push)" for name, joint in JOINT.items()}, FOLLOWS_S),
    "slips": (SafetyStop, {n: f"{j}.*(away|push)" for n, j in JOINT.items() if n != "go2"}, 1.0),
    "collides": (SafetyStop, {n: f"{j}.*(away|push|has read)" for n, j in JOINT.items() if n != "go2"}, 1.2),
    "another master": (SafetyStop, {"go2": "another program"}, 0.6),
}
SLOWLY = {("go2", "lets go"): 1.5, ("so101", "lets go"): 1.0, ("so101", "frozen"): 0.7}
"""Longer times: legs that hang push little until they move on, and a joint may sink the way that its goals go."""
ROWS = [(name, fault, seed) for fault, (_, nouns, _) in FAULTS.items() for name in nouns for seed in SEEDS]
GATE = [row for i, row in enumerate(ROWS) if row[2] == 0 and i % 5 == 0 and row[0] != "go2"]
robot_of = cache(make)


class Strike:
    """Lets a fault begin at a time, called in every turn of the loop."""

    def __init__(self, robot, rig, emulated, fault, begin_s):
        self.robot, self.rig, self.emulated, self.fault, self.begin_s = robot, rig, emulated, fault, begin_s
        self.began_ns, self.turns = None, 0

    def __call__(self, t_s):
        if t_s < self.begin_s:
            return
        emulated = self.emulated
        self.began_ns = self.began_ns or emulated.now_ns()
        self.turns += 1
        if self.fault == "slips":  # the belt carries the torque for a fifth of the time
            slipping = 0.0 if self.turns % 5 else None
            emulated.strike(lets_go=self.robot.id, lets_go_after_s=slipping)
        elif self.turns == 1:
            self.once(emulated)

    def changed(self, command):
        """Return the policy's command after the fault: no number, or goals that go on into an obstacle."""
        if self.fault == "no number" and self.turns:
            return np.full_like(command, np.nan)
        if self.fault == "collides" and self.robot.name != "pendulum":
            command = command.copy()
            command[self.robot.faulty] -= min(0.8, 1.5 * self.turns / HZ)
        return command

    def once(self, emulated):
        faults = {
            "silent": {"silent_after_s": 0.0},
            "unplugged": {"unplugged_after_s": 0.0},
            "late": {"late": 1.0, "late_s": 0.3},
            "damaged": {"corrupt": 1.0},
            "wild": {"wild": 1.0},
            "frozen": {"frozen_after_s": 0.0},
            "lets go": {"lets_go_after_s": 0.0, "lets_go": self.robot.id},
        }
        if self.fault in faults:
            emulated.strike(**faults[self.fault])
        elif self.fault == "restarts":
            servo_id = self.robot.id
            emulated.write(self.rig.device.link.form.build(servo_id, Instruction.REBOOT))
        elif self.fault == "torque off":  # of the faulty joint and the one after it, by another program
            for i in [i for i in emulated.bus.servos if i in (self.robot.id, self.robot.id + 1)]:
                servo = emulated.bus.servos[i]
                servo._goal_wakes = False  # otherwise the next goal switches it on again
                emulated.write(servo.family.form.write(i, servo.family.torque, 0))
        elif self.fault == "stopped":
            emulated.stall(1.0)
        elif self.fault == "killed":
            emulated.kill_host()
        elif self.fault == "no guardian":
            emulated.guardian_lives = False
        elif self.fault == "collides":
            self.robot.block(emulated)
        elif self.fault == "another master":
            from sim2real.emulation.legs import VirtualLink

            VirtualLink(emulated, "another")


def run(name, fault, seed):
    """Return the error or the guardian's report, the time until motors were safe [s], and those that are on at last."""
    robot = robot_of(name)
    rng = random.Random(f"{name} {fault} {seed}")
    emulated = robot.robot(seed)
    with robot.rig(emulated) as rig:
        strike = Strike(robot, rig, emulated, fault, rng.uniform(1.6, 3.0))

        def policy(first):
            step = robot.raised(first)
            return lambda k, reading: strike.changed(step(k, reading))

        try:
            drive(emulated, rig, policy, 6.0, strike)
            error = None
        except (HardwareLost, SafetyStop) as raised:
            error = raised
        ended_ns = emulated.now_ns()
        if fault == "silent":
            emulated.sleep(BACK_S)
            emulated.strike(silent_after_s=None)
        rig.stop_quietly()
    emulated.sleep(0.8)
    on = robot.on(emulated)
    return error, emulated.reports, (ended_ns - strike.began_ns) * 1e-9 if strike.began_ns else None, on, emulated


def check(name, fault, seed):
    kind, nouns, within_s = FAULTS[fault]
    error, reports, took_s, on, emulated = run(name, fault, seed)
    said = "; ".join(reports) if fault == "killed" else str(error)
    assert took_s is not None, f"ended before its fault: {error}"
    assert kind is None or type(error) is kind, said
    assert re.search(nouns[name], said, re.DOTALL), said
    assert took_s < SLOWLY.get((name, fault), within_s) or fault in ("killed", "stopped")
    if fault == "unplugged":  # nothing reaches the servos any more: only their own watchdog can stop them
        assert any("could NOT be confirmed" in report for report in reports)
        assert bool(emulated.truth().of(Kind.WATCHDOG).size) == (name != "so101")
    else:
        assert on == []
    emulated.stop()


@pytest.fixture(autouse=True)
def impatient_guardian(monkeypatch):
    monkeypatch.setattr(guardian, "GIVE_UP_S", 1.0)


@pytest.mark.parametrize(("name", "fault", "seed"), GATE)
def test_a_fault_of_an_embedded_robot_ends_with_its_reason(name, fault, seed):
    check(name, fault, seed)


@pytest.mark.night
@pytest.mark.parametrize(("name", "fault", "seed"), ROWS)
def test_every_fault_of_every_embedded_robot(name, fault, seed):
    check(name, fault, seed)
