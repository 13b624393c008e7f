"""The four embedded robots behind their rigs, in virtual time, each with its identified model and a moving policy."""

import math
from dataclasses import replace

import numpy as np

from sim2real.emulation.bus import VirtualRobot
from sim2real.hardware.safety.rig import Rig
from sim2real.stages.load import load_robot

HZ = 50.0
SHARES = {"arm": (0.5, 0.8, 0.8), "so101": (0.5, 0.8, 0.3, 0.5, 0.5, 0.5)}
"""Pose of each arm that weighs on its joints, as shares of their ranges."""


class Arm:
    """An arm of servos. Its fault is that of the shoulder, which carries the arm."""

    faulty = 1

    def __init__(self, name):
        robot = load_robot(name)
        self.name, self.drive, self.model = name, robot.drive, robot.model
        self.servos = robot.drive.servos
        self.limits, self.joints, self.mounting = robot.defaults.deploy.gate, self.servos.names, self.servos.mounting
        self.id = self.servos.ids[self.faulty]
        self.low = np.maximum(self.servos.low, -self.limits.limit)
        self.high = np.minimum(self.servos.high, self.limits.limit)
        robot = self.robot(0)
        truth = robot.plant.truth()
        self.identified = self.model.following({p.name: truth.get(p.name, p.begin) for p in self.model.dynamics()})
        robot.stop()

    def robot(self, seed, plant=None, **faults):
        embedded = self.drive.embedded()
        emulator = replace(embedded.emulator, seed=seed, **faults)
        return VirtualRobot(embedded.plant(**(plant or {})), emulator)

    def device(self, robot, limits):
        return self.drive.device(robot.port, limits.servo_watchdog_s, embedded=True)

    def rig(self, robot, following=True, limits=None):
        """Return a rig with the limits of a real robot, watched by the identified model, or the servos' own figures."""
        limits = limits or self.limits
        device = self.device(robot, limits)
        rig = Rig(device, self.drive.gate(limits, device), self.mounting)
        if following is True:
            rig.follow(self.identified)
        elif following is not None:
            rig.follow(following)
        return rig

    def raised(self, first, swing=0.3):
        """Return a policy on the way to a pose in which the arm weighs on its joints, and around it."""
        goal, pose = first.position_rad, self.low + np.array(SHARES[self.name]) * (self.high - self.low)

        def step(k, reading):
            nonlocal goal
            around = pose + swing * math.sin(6.0 * k / HZ)
            goal = np.clip(goal + np.clip(around - goal, -1.5 / HZ, 1.5 / HZ), self.low, self.high)
            return goal

        return step

    def policy(self, seed, first):
        """Return a policy whose goals are at most as fast as a policy's: to targets, in sines, or at random."""
        s, n, rng, low, high = self.servos, len(self.servos.ids), np.random.default_rng(seed), self.low, self.high
        goal, kind = np.clip(first.position_rad, low, high), rng.integers(3)
        target, phase, turns = rng.uniform(low, high), rng.uniform(0.0, 6.28, n), rng.uniform(1.0, 9.0, n)

        def step(k, reading):
            nonlocal goal, target
            if k % (60, 1000, 8)[kind] == 0:
                target = rng.uniform(low, high)
            speeds = np.clip(8.0 * (target - goal), -s.speed, s.speed)
            speed = s.speed * np.sin(turns * k / HZ + phase) if kind == 1 else speeds
            goal = np.clip(goal + speed / HZ, low, high)
            return goal

        return step

    def on(self, robot):
        """Return the motors whose torque is on."""
        return [i for i, servo in robot.bus.servos.items() if servo.get(servo.family.torque)]

    def block(self, robot):
        """Let something hold a joint where it is."""
        model, i = robot.plant.model, robot.plant.joints.index(self.joints[self.faulty])
        joint = model.joint(robot.plant.joints[i])
        here = float(robot.plant.data.qpos[joint.qposadr[0]])
        model.jnt_limited[joint.id], model.jnt_range[joint.id] = 1, (here - 1e-3, here + 1e-3)


class Pendulum(Arm):
    faulty = 0

    def __init__(self):
        robot = load_robot("pendulum")
        self.name, self.drive, self.model, self.id = "pendulum", robot.drive, robot.model, 1
        self.limits, self.joints = robot.defaults.deploy.gate, ("hinge",)
        from sim2real.hardware.joint import Joint

        self.mounting = (Joint("hinge"),)
        emulated = self.robot(0)
        emulator = robot.drive.embedded().emulator
        delay_s = emulator.sensing_latency_s + emulator.actuation_latency_s
        self.identified = replace(self.model.following(emulated.plant.truth()), delay_s=delay_s)
        emulated.stop()

    def raised(self, first):
        """Return a policy that pumps: full voltage in the direction of the motion."""
        return lambda k, reading: np.clip(4.0 * reading.velocity_rad_s + 0.6 * (k < 10), -2.0, 2.0)

    def policy(self, seed, first):
        """Return a policy that pumps, or pushes at random."""
        rng, volts = np.random.default_rng(seed), np.zeros(1)

        def step(k, reading):
            nonlocal volts
            volts = rng.uniform(-2.0, 2.0, 1) if k % 5 == 0 else volts
            return volts

        return self.raised(first) if seed % 2 else step

    def block(self, robot):
        model, here = robot.plant.model, float(robot.plant.data.qpos[0])
        model.jnt_limited[0], model.jnt_range[0] = 1, (here - 1e-3, here + 1e-3)


class Go2(Arm):
    """A Go2 on its stand, whose legs swing around the stance."""

    faulty = 1

    def __init__(self):
        robot = load_robot("go2")
        self.name, self.drive, self.id = "go2", robot.drive, self.faulty
        self.limits, self.joints = replace(robot.defaults.deploy.gate, first_step_rad=np.inf), robot.drive._joints
        self.stance = robot.drive.centre

    def robot(self, seed, plant=None, **faults):
        from pipelines.go2.plant import Go2Body
        from sim2real.emulation.legs import UnitreeEmulation, VirtualLegs

        return VirtualLegs(Go2Body("stand", seed=(plant or {}).get("seed")), UnitreeEmulation(seed=seed, **faults))

    def rig(self, robot, following=True, limits=None):
        from sim2real.hardware.unitree.device import UnitreeLegs
        from sim2real.hardware.unitree.legs import LegDrive

        del following  # by the torque that the motors report
        limits = limits or self.limits
        device = UnitreeLegs(robot.port, drive=LegDrive(lie_s=0.2), silence_s=limits.servo_watchdog_s)
        return Rig(device, self.drive.gate(limits, device))

    def raised(self, first):
        return self.policy(0, first)

    def policy(self, seed, first):
        """Return a policy that swings the legs around the stance."""
        rng, goal = np.random.default_rng(seed), first.position_rad
        turns, size = rng.uniform(2.0, 9.0, 12), rng.uniform(0.05, 0.3)
        gains = np.tile([0.0, 40.0, 1.0, 0.0], (12, 1))

        def step(k, reading):
            nonlocal goal
            wanted = self.stance + size * np.sin(turns * k / HZ)
            goal = goal + np.clip(wanted - goal, -4.0 / HZ, 4.0 / HZ)
            return np.column_stack([goal, gains])

        return step

    def on(self, robot):
        return np.flatnonzero(robot.legs._modes).tolist()


def make(name):
    return {"pendulum": Pendulum, "go2": Go2}[name]() if name in ("pendulum", "go2") else Arm(name)


def drive(robot, rig, policy, seconds, at=lambda t_s: None):
    """Run a control loop for a while; call ``at`` with the time before each turn."""
    rig.start()
    step = policy(rig.measure())
    for k in range(round(seconds * HZ)):
        at(1e-9 * robot.now_ns())
        reading = rig.measure()
        rig.require_fresh()
        rig.command(step(k, reading), 0.0, 1e-9 * robot.now_ns())
        robot.sleep(1.0 / HZ)
