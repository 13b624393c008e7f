"""The embedded arm against statics, kinematics and energy written down by hand."""

import numpy as np
import pytest

from sim2real.hardware.device import OperatingMode
from sim2real.stages.load import load_module

ArmPlant = load_module("arm", "plant").ArmPlant
SMOOTH = {"coulomb": (0.0, 0.0, 0.0)}
OFF, POSITION, PWM = OperatingMode.OFF, OperatingMode.POSITION, OperatingMode.PWM
PAN, SHOULDER, ELBOW = 1, 2, 3
CENTRE, COUNT, STEP_S, G = np.pi, 2 * np.pi / 4096, 0.0005, 9.81
ARMATURE, VISCOUS, BACK_EMF, STALL = 0.0045 * 1.25, 0.01, 0.22 * 1.1, 1.4 * 0.87
FRICTION = 0.03 * np.array([1.5, 1.9, 1.2])
STATIC = FRICTION * 1.2


def gravity(q):
    """Torque that holds the arm at joint angles `(3,)`: the derivative of its potential energy [N m]."""
    _, s, e = q
    fore = 0.055 * G * 0.07 * np.sin(s + e)
    return np.array([0.0, 0.097 * G * 0.085 * np.sin(s) + 0.055 * G * 0.12 * np.sin(s) + fore, fore])


def energy(states):
    """Kinetic and potential energy [J] of states `(N, 6)` while the pan joint rests."""
    _, s, e, _, ds, de = states.T
    w = ds + de
    upper = 1.6e-4 + 0.097 * 0.085**2
    speed2 = (0.12 * ds) ** 2 + (0.07 * w) ** 2 + 2 * 0.12 * 0.07 * ds * w * np.cos(e)
    kinetic = (upper * ds**2 + 9e-5 * w**2 + 0.055 * speed2 + ARMATURE * (ds**2 + de**2)) / 2
    return kinetic - 0.097 * G * 0.085 * np.cos(s) - 0.055 * G * (0.12 * np.cos(s) + 0.07 * np.cos(s + e))


def pan_inertia(s, e):
    """Moment of inertia about the pan axis [kg m^2]: rotor, and three bodies by the parallel axis theorem."""
    inertia = ARMATURE + 5e-5 + 0.082 * 0.02**2
    inertia += 1.6e-4 * np.sin(s) ** 2 + 2e-5 * np.cos(s) ** 2 + 0.097 * (0.04 + 0.085 * np.sin(s)) ** 2
    reach = 0.04 + 0.12 * np.sin(s) + 0.07 * np.sin(s + e)
    return inertia + 9e-5 * np.sin(s + e) ** 2 + 8e-6 * np.cos(s + e) ** 2 + 0.055 * reach**2


def at(plant, *q):
    plant.data.qpos[:] = q
    return plant


def command(plant, mode, goals):
    for servo_id, goal in zip(plant.servo_ids, goals, strict=True):
        plant.command(servo_id, mode, goal + CENTRE if mode == POSITION else goal)
    return plant


def trajectory(plant, duration_s):
    """Advance and return joint angles and velocities at every step, `(N, 6)`."""
    begin = plant.data.time
    rows = []
    for i in range(round(duration_s / STEP_S)):
        rows.append(np.concatenate([plant.data.qpos, plant.data.qvel]))
        plant.advance(begin + (i + 1) * STEP_S)
    return np.array(rows)


@pytest.mark.parametrize("goal", [(0.4, 0.9, -0.6), (-1.2, 1.3, 1.0), (0.0, -1.2, 0.3)])
def test_it_droops_until_torques_balance(goal):
    for factors, friction in (({}, STATIC), (SMOOTH, np.zeros(3))):
        plant = command(ArmPlant(**factors), POSITION, goal)
        plant.advance(3.0)
        q, gain = plant.data.qpos, plant.truth()["gain"]
        # Goal and angle are rounded to counts, so that the error is known to one of them.
        assert np.all(np.abs(gain * (np.array(goal) - q) - gravity(q)) <= friction + gain * COUNT)
    assert abs(goal[1] - q[1]) > 0.04, "it does droop"


def test_it_moves_no_faster_than_its_profile():
    plant = at(ArmPlant(), -1.4, 0, 0)
    plant.configure(PAN, 800, 0, 0.5)
    speeds = trajectory(command(plant, POSITION, (1.4, 0, 0)), 5.0)[:, 3]
    assert np.median(speeds) == pytest.approx(0.5, rel=0.01)
    assert speeds.max() < 0.55
    plant = at(ArmPlant(), -1.4, 0, 0)
    speeds = trajectory(command(plant, POSITION, (1.4, 0, 0)), 1.0)[:, 3]
    truth = plant.truth()
    top = (STALL - truth["friction_pan"]) / truth["damping"]
    assert 0.98 * top < speeds.max() < 1.001 * top


@pytest.mark.parametrize("speed", [-2.2, -0.1, 0.2])
def test_pwm_turns_it_at_the_speed_where_torques_balance(speed):
    friction = FRICTION[0] * (1 + 0.2 * np.exp(-abs(speed) / 0.1))
    duty = ((BACK_EMF + VISCOUS) * speed + np.sign(speed) * friction) / STALL
    plant = command(at(ArmPlant(), 1.4 if speed < 0 else -1.4, 0, 0), POSITION, (0, 0, 0))
    plant.command(PAN, PWM, duty)
    assert trajectory(plant, 1.0)[-1, 3] == pytest.approx(speed, rel=5e-3)
    assert plant.measure(PAN)[2] == pytest.approx(duty - BACK_EMF * plant.data.qvel[0] / STALL)


@pytest.mark.parametrize("factors", [{}, SMOOTH], ids=["rough", "smooth"])
def test_energy_goes_into_friction(factors):
    plant = command(at(ArmPlant(**factors), 0, 1.4, -0.5), OFF, (0, 0, 0))
    states = trajectory(plant, 1.0)
    total, speed = energy(states), np.abs(states[:, 3:])
    level = 0.0 if factors else FRICTION * (1 + 0.2 * np.exp(-speed / 0.1))
    lost = (level * speed + VISCOUS * speed**2).sum() * STEP_S
    assert total[0] - total[-1] == pytest.approx(lost, rel=0.02)
    assert lost > 0.01


def test_the_motor_brakes_only_while_torque_is_on():
    """At a duty of 0 the winding is shorted and the back-EMF brakes; with torque off it is open."""
    inertia = pan_inertia(0, 0)
    for mode, damping in ((PWM, BACK_EMF + VISCOUS), (OFF, VISCOUS)):
        plant = command(ArmPlant(**SMOOTH), mode, (0, 0, 0))
        plant.data.qvel[0] = 1.0
        assert trajectory(plant, 0.0205)[-1, 3] == pytest.approx(np.exp(-damping * 0.02 / inertia), rel=0.02)
