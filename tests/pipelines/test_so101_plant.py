"""The embedded SO-101 against statics by hand: it droops, sticks, sinks to the table, and is folded again."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim2real.hardware.device import OperatingMode
from sim2real.stages.load import load_module

FILE = Path(__file__).resolve().parents[2] / "pipelines" / "so101" / "plant.py"
SO101Plant = load_module("so101", "plant").SO101Plant
OFF, POSITION = OperatingMode.OFF, OperatingMode.POSITION
COUNT, G, GAIN = 2 * np.pi / 4096, 9.81, 6.53
ZERO = np.array([2133, 2118, 2154, 2127, 2133, 2098]) * COUNT
FRICTION = np.array([0.0644, 0.222, 0.302, 0.0706, 0.0654, 0.0167])
BIAS = np.array([-0.0008, 0.0098, 0.0061, 0.0070, -0.0011, -0.0002])
REST = np.array([0.0, -1.65, 1.6, -1.4, 0.0, -0.6])


def at(plant, *q):
    plant.data.qpos[:] = q
    return plant


def command(plant, goals, mode=POSITION):
    for servo_id, goal in zip(plant.servo_ids, goals + ZERO, strict=True):
        plant.command(servo_id, mode, goal)
    return plant


def run(plant, duration_s):
    plant.advance(plant.data.time + duration_s)
    return plant.data.qpos.copy()


def slowly(plant, goals, rad_s=2.0):
    """Move all joints to goals at the same time, and wait."""
    start = plant.data.qpos.copy()
    steps = int(np.ceil(np.abs(goals - start).max() / rad_s * 50))
    for k in range(1, steps + 25):
        run(command(plant, start + min(1.0, k / steps) * (goals - start)), 0.02)
    return plant.data.qpos.copy()


def gravity(q):
    """Torque of weight on lift, elbow and wrist [N m], with what hangs on each as masses in a plane."""
    pitch = np.cumsum(q[1:4])
    reach = {1: (0.0280, 0.1126), 2: (0.1349, 0.0052)}
    masses = [(0.103, 0, (0.0084, 0.0898)), (0.104, 1, (0.0981, 0.0032)), (0.079, 2, (0.0386, 0.0001)),
              (0.087, 2, (0.0611 + 0.0252, 0.0002))]  # fmt: skip
    torque = np.zeros(3)

    def out(place, angle):
        return place[0] * np.cos(angle) + place[1] * np.sin(angle)

    jaw = (0.012, 2, (0.0611 + 0.0234 + 0.0224, 0.0211 + 0.0191))
    for mass, link, com in [*masses, jaw]:
        for joint in range(link + 1):
            arm = sum(out(reach[i + 1], pitch[i]) for i in range(joint, link)) + out(com, pitch[link])
            torque[joint] += mass * G * arm
    return torque


@pytest.mark.parametrize("goal", [(0.4, -0.6, 0.9, -1.2, 0, 0), (-0.5, -0.4, 0.3, -1.1, 0, 0)])
def test_it_droops_until_torques_balance(goal):
    plant = at(SO101Plant(), *goal)
    q = run(command(plant, np.array(goal)), 2.0)
    held = GAIN * (np.array(goal) + BIAS - q)
    held[1:4] += gravity(q)
    assert np.all(np.abs(held) <= FRICTION + GAIN * COUNT)
    assert np.abs(gravity(q)).max() > 0.3, "there is something to hold"


@pytest.mark.parametrize(
    ("joint", "speed"), [(0, 0.450 * 6.53 / 0.560), (4, 0.170 * 6.53 / 0.500), (5, 0.0615 * 6.53 / 0.434)]
)
def test_a_saturated_servo_moves_at_the_speed_where_torques_balance(joint, speed):
    start = np.array([-1.5, -0.6, 0.9, -1.2, -1.5, -0.8])
    plant = at(SO101Plant(), *start)
    run(command(plant, start + 1.6 * np.eye(6)[joint]), 0.2)
    assert plant.data.qvel[joint] == pytest.approx(speed, rel=0.02)


def test_without_torque_it_stays_folded_and_elsewhere_sinks_to_the_table():
    plant = command(SO101Plant(), REST, OFF)
    folded = run(plant, 1.0)
    assert np.abs(folded - REST).max() < 0.25
    slowly(plant, np.array([0.3, -0.4, 0.5, -1.1, 0.0, 0.0]))
    held = plant.state()["tip[2]"]
    run(command(plant, REST, OFF), 3.0)
    assert held > 0.2
    assert -0.002 < plant.state()["tip[2]"] < 0.02, "the finger lies on the table"
    assert np.abs(plant.data.qvel).max() < 0.01
    slowly(plant, REST)
    run(command(plant, REST, OFF), 1.0)
    assert np.abs(plant.data.qpos - REST).max() < 0.25, "and can be folded again"


def test_it_imports_no_jax():
    code = f"""
import runpy, sys
runpy.run_path({str(FILE)!r})["SO101Plant"]()
sys.exit("jax" in sys.modules)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
