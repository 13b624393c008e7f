"""The embedded robots, watched while a policy runs: a joint that lets go is named, and no sound robot is stopped."""

import importlib.util
import random
from dataclasses import replace
from functools import cache, partial

import pytest
from embedded import drive, make

from sim2real.errors import SafetyStop

LETS_GO_S = 2.5
ROBOTS = ("arm", "so101", "pendulum", *(("go2",) if importlib.util.find_spec("cyclonedds") else ()))
robot_of = cache(make)


def hold_up(emulated, rng):
    """Let a busy computer stop the host now and then: between the time of an instruction and its bytes."""
    write = emulated.write

    def held_up(data):
        if rng.random() < 0.1:
            emulated.stall(rng.choice([0.006, 0.03, 0.12]))
        write(data)

    emulated.write = held_up


def sound(name, seed, share, busy=None):
    """Drive a robot that has no fault; ``share``: of the largest payload. It must not be stopped."""
    robot, by_model = robot_of(name), seed % 2 == 0
    plant = {"carried_kg": share * robot.model.hand.most_kg} if share and name in ("arm", "so101") else None
    emulated = robot.robot(seed, {"seed": seed} if name == "go2" else plant)
    patient = replace(robot.limits, max_sample_age_s=2.0, servo_watchdog_s=2.0)
    with robot.rig(emulated, by_model or None, patient) as rig:
        if busy is not None and name != "go2":
            hold_up(emulated, busy)
        stalls = (lambda t_s: None) if busy is None else lambda t_s: emulated.stall(0.3 * max(0.0, busy.uniform(-9, 1)))
        drive(emulated, rig, partial(robot.policy, seed), 4.0, stalls)
    emulated.stop()


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.night) for seed in range(3, 6))])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_host_that_is_held_up_does_not_look_like_a_joint_that_lets_go(name, seed):
    """Between its steps, and on the way to the port."""
    sound(name, seed, 0.0, random.Random(seed))


@pytest.mark.parametrize("name", ["arm", "so101", "pendulum"])
def test_no_sound_deployment_with_the_largest_payload_is_stopped(name):
    sound(name, 1, 1.0)


@pytest.mark.night
@pytest.mark.parametrize("seed", range(100, 200))
@pytest.mark.parametrize("name", ROBOTS)
def test_of_400_sound_deployments_none_is_stopped(name, seed):
    sound(name, seed, (0.0, 0.5, 1.0)[seed % 3])


@pytest.mark.parametrize(
    ("name", "plant", "policy"),
    [
        *((name, {"carried_kg": kg}, {"swing": 0.0}) for name in ("arm", "so101") for kg in (0.0, 0.1)),
        ("pendulum", None, {}),
    ],
)
def test_a_joint_that_lets_go_is_named_within_half_a_second(name, plant, policy):
    robot = robot_of(name)
    emulated = robot.robot(2, plant, lets_go_after_s=LETS_GO_S, lets_go=robot.id)
    with robot.rig(emulated) as rig:
        with pytest.raises(SafetyStop) as stopped:
            drive(emulated, rig, partial(robot.raised, **policy), 4.0)
        assert LETS_GO_S < 1e-9 * rig.clock.now_ns() < LETS_GO_S + 0.5
    emulated.stop()
    assert repr(robot.joints[robot.faulty]) in str(stopped.value)
