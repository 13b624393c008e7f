"""A pendulum in virtual time, driven by voltage and watched by an identified model."""

from dataclasses import replace

import numpy as np
import pytest

from sim2real.emulation.virtual import VirtualRobot
from sim2real.errors import SafetyStop
from sim2real.hardware.joint import Joint
from sim2real.hardware.safety.rig import Rig
from sim2real.stages.load import load_robot

HZ, SECONDS, LETS_GO_S = 50.0, 6.0, 2.5


def play(seed, kind, **faults):
    """Swing the pendulum; return when the robot was stopped [s] and its message, and the largest deviation."""
    pipeline = load_robot("pendulum")
    robot = pipeline
    emulator = robot.drive.embedded.emulator
    emulated = VirtualRobot(robot.drive.embedded.plant, replace(emulator, seed=seed, **faults))
    truth, limits = emulated.plant.truth(), pipeline.defaults.deploy.gate.on("embedded")
    delay_s = emulator.sensing_latency_s + emulator.actuation_latency_s
    rng, volts, seen = np.random.default_rng(seed), 0.6, []
    following = replace(robot.model.following(truth), delay_s=delay_s)
    with Rig(robot.drive.make_device(emulated.port, 0.5), robot.drive.gate(limits), (Joint("hinge"),)) as rig:
        rig.follow(following)
        rig.start()
        check, missing = rig._follow_check, rig._follow_check._missing_push
        check._missing_push = lambda *now: seen.append(missing(*now)) or seen[-1]
        for k in range(round(SECONDS * HZ)):
            try:
                reading = rig.measure()
            except SafetyStop as error:
                return 1e-9 * rig.clock.now_ns(), str(error)
            speed = reading.velocity_rad_s[0]
            if kind == "swings":
                volts = np.clip(4.0 * speed + 0.6 * (k < 10), -2.0, 2.0)
            elif k % 5 == 0:
                volts = rng.uniform(-2.0, 2.0)
            rig.command(np.array([volts]), 0.0, 1e-9 * rig.clock.now_ns())
            rig.clock.sleep(1.0 / HZ)
    emulated.stop()
    return float(np.max(seen))


@pytest.mark.parametrize("kind", ["swings", "at random"])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_sound_pendulum_is_never_near_its_limit(kind, seed):
    assert play(seed, kind) < 0.5


@pytest.mark.parametrize("kind", ["swings", "at random"])
def test_a_motor_that_lets_go_is_named_within_half_a_second(kind):
    stopped_s, message = play(3, kind, lets_go_after_s=LETS_GO_S, lets_go=1)
    assert LETS_GO_S < stopped_s < LETS_GO_S + 0.5
    assert "'hinge'" in message
