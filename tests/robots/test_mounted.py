"""Robots whose joints have a zero, a direction and a gear of their own, from the bus to what is identified."""

from dataclasses import replace

import numpy as np
import pytest
from small_robot import SERVOS, PairRobot

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.servo_plant import ServoPlant
from sim2real.emulation.truth import Kind, read_truth
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.joint import Joint
from sim2real.hardware.safety.gate import GateLimits
from sim2real.log.reader import read_log
from sim2real.robots.nodes import connected, recording_nodes
from sim2real.stages.config import RecordConfig
from sim2real.stages.session.episode import Bench

PATIENT = GateLimits(command_timeout_s=0.2, servo_watchdog_s=0.6)
GEARS = (2.0, 0.5)


GEARED = replace(SERVOS, joints=(Joint("left", 0.3, -1, GEARS[0]), Joint("right", gear=GEARS[1])))


def test_a_twins_servos_are_those_of_the_data_sheet_whatever_their_gears(pair):
    factors = {"gain": 0.9, "damping": 1.1, "armature": 1.2, "friction": 1.5}
    one, other = (
        ServoPlant(**r.model.twin(EmulatorConfig(), **factors).plant.keywords) for r in (pair, PairRobot(GEARED))
    )
    assert other.truth() == pytest.approx(one.truth(), rel=1e-5)
    assert one.truth() == pytest.approx({n: v * factors[n.split("_")[0]] for n, v in pair.nominal().items()}, rel=1e-5)


def test_goals_and_limits_are_the_joints_on_the_bus_too(arm, tmp_path):
    """The servos turn up to twice as far, some of them the other way; the true joints go where they are told."""
    robot = arm
    joints = (Joint("pan", 0.5, -1, 1.5), Joint("shoulder", -0.2, 1, 2.0), Joint("elbow", 0.1, -1, 0.8))
    robot = type(robot)(replace(robot.drive.servos, joints=joints))
    goal = np.array([0.4, -0.3, 0.5])
    with connected(robot.drive, "embedded", PATIENT, tmp_path / "truth.bin", 0) as rig:
        robot.drive.prepare(rig, 5.0)
        nodes = recording_nodes(robot, rig, np.tile(goal, (90, 1)))
        Bench(robot, rig, RecordConfig()).run_episode(nodes, {}, tmp_path / "log.mcap", 1.6, "record")
    episode, truth = read_log(tmp_path / "log.mcap"), read_truth(tmp_path / "truth.bin")
    position = episode.outputs["sensor"]["position"]
    np.testing.assert_allclose(episode.outputs["actuator"]["goal"][-1], goal, atol=1e-6)
    np.testing.assert_allclose(position[-1], goal, atol=0.05)
    _, states = truth.states()
    true = np.stack([states[f"position[{i}]"] for i in range(3)], axis=1)
    np.testing.assert_allclose(np.abs(true).max(axis=0), np.abs(position).max(axis=0), atol=0.01)
    for i, joint in enumerate(joints):
        goals = truth.of(Kind.EFFECT, i + 1)["values"]
        sent = goals[goals[:, 0] == OperatingMode.POSITION][-1, 1] - np.pi
        assert sent == pytest.approx(joint.encoder(goal[i]), abs=0.001)
