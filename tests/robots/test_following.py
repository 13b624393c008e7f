"""Arms in virtual time, watched by an identified model: a joint that lets go is named, and no sound one is."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sim2real.emulation.virtual import VirtualRobot
from sim2real.errors import SafetyStop
from sim2real.hardware.safety.rig import Rig
from sim2real.stages.load import load_robot

HZ, SECONDS, LETS_GO_S = 50.0, 4.0, 2.5
SHARES = {"arm": (0.5, 0.8, 0.8), "so101": (0.5, 0.8, 0.3, 0.5, 0.5, 0.5)}
"""Pose of each arm that weighs on its joints, as shares of their ranges."""


class Arm:
    """An embedded arm of a pipeline, and its model with the values that an identification finds."""

    def __init__(self, name):
        pipeline, self.shares = load_robot(name), np.array(SHARES[name])
        robot = pipeline
        self.drive, self.servos, self.model = robot.drive, robot.drive.servos, robot.model
        self.limits = pipeline.defaults.deploy.gate.on("embedded")
        truth = self.robot(0).plant.truth()
        values = {p.name: float(truth.get(p.name, p.begin)) for p in self.model.dynamics()}
        self.following = self.model.following(values)

    def robot(self, seed, plant=None, **faults):
        embedded = self.drive.embedded.mounted(self.servos.mounting, math.pi)
        emulator = replace(embedded.emulator, seed=seed, **faults)
        return VirtualRobot(embedded.plant, emulator, {**embedded.plant_args, **(plant or {})})

    def play(self, robot, goals, following):
        """Play goals; return when the robot was stopped [s], and its message."""
        settings = self.drive._settings("embedded") if self.drive._settings else self.servos.sheet.drive
        device = self.drive.make_device(robot.port, settings, self.limits.servo_watchdog_s)
        with Rig(device, self.drive.gate(self.limits), self.servos.mounting) as rig:
            if following:
                rig.follow(self.following)
            rig.start()
            for goal in goals(rig.measure().position_rad):
                try:
                    rig.measure()
                except SafetyStop as error:
                    return 1e-9 * rig.clock.now_ns(), str(error)
                rig.command(goal, 0.0, 1e-9 * rig.clock.now_ns())
                rig.clock.sleep(1.0 / HZ)
        return None

    @property
    def range(self):
        return np.maximum(self.servos.low, -self.limits.limit), np.minimum(self.servos.high, self.limits.limit)

    def raised(self, position):
        """Yield goals on the way to a pose in which the arm weighs on its joints, and there."""
        (low, high), goal = self.range, position
        for _ in range(round(SECONDS * HZ)):
            away = np.clip(low + self.shares * (high - low) - goal, -1.5 / HZ, 1.5 / HZ)
            goal = goal + away
            yield goal

    def policy(self, seed, position):
        """Yield goals whose speed is at most a policy's: on the way to targets, in sines, or at random."""
        s, n, rng = self.servos, len(self.servos.ids), np.random.default_rng(seed)
        low, high = self.range
        goal, kind = np.clip(position, low, high), rng.integers(3)
        target, phase, turns = rng.uniform(low, high), rng.uniform(0.0, 6.28, n), rng.uniform(1.0, 9.0, n)
        for k in range(round(SECONDS * HZ)):
            if k % (60, 1000, 8)[kind] == 0:
                target = rng.uniform(low, high)
            speeds = np.clip(8.0 * (target - goal), -s.speed, s.speed)
            speed = s.speed * np.sin(turns * k / HZ + phase) if kind == 1 else speeds
            goal = np.clip(goal + speed / HZ, low, high)
            yield goal


@pytest.fixture(scope="module", params=["arm", "so101"])
def arm(request):
    return Arm(request.param)


def sound(arm, seed, heaviest):
    kg = heaviest * arm.model.hand.most_kg
    stopped = []
    for by_model in (True, False):
        robot = arm.robot(seed, {"carried_kg": kg} if kg else None)
        stopped.append(arm.play(robot, partial(arm.policy, seed), by_model))
        robot.stop()
    return stopped


@pytest.mark.parametrize("heaviest", [0.0, 1.0])
def test_no_sound_deployment_is_stopped(arm, heaviest):
    assert sound(arm, 1, heaviest) == [None, None]


@pytest.mark.night
@pytest.mark.parametrize("seed", range(100, 200))
def test_of_many_sound_deployments_none_is_stopped(arm, seed):
    assert sound(arm, seed, (0.0, 0.5, 1.0)[seed % 3]) == [None, None]


@pytest.mark.parametrize("kg", [0.0, 0.1])
def test_a_joint_that_lets_go_is_named_within_half_a_second(arm, kg):
    joint = 1  # the shoulder, which carries the arm
    robot = arm.robot(2, {"carried_kg": kg}, lets_go_after_s=LETS_GO_S, lets_go=arm.servos.ids[joint])
    stopped_s, message = arm.play(robot, arm.raised, following=True)
    robot.stop()
    assert LETS_GO_S < stopped_s < LETS_GO_S + 0.5
    assert repr(arm.servos.names[joint]) in message
