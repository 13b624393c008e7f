"""The tools that sim2real is compared with do what their sources say."""

import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "scripts"))
pytest.importorskip("mujoco.sysid")
from benches.recorded import bam, published, rigs, textbook
from benches.recorded.sets import Recording


def test_commands_are_held_not_interpolated():
    t, command = np.array([0.0, 0.025, 0.05]), np.array([[1.0], [2.0], [3.0]])
    still = np.zeros((3, 1))
    spec = rigs.hinge(0.005, 0.1, 0.041, 1e-4)
    control = rigs.Run(Recording(t, command, still, np.zeros((1, 2))), spec).control
    assert control.data[:-1, 0].tolist() == [1.0] * 5 + [2.0] * 5 + [3.0]


def test_a_recording_that_ends_without_torque_is_simulated_through():
    t = np.arange(400) * 0.005
    enabled = t < 1.0
    duty_per_rad = 800 / 256 * rigs.PULSES_PER_RAD / rigs.PWM_LIMIT
    constants = {"duty_per_rad": duty_per_rad, "mass": 0.49, "length": 0.1, "torque_enable": enabled}
    goal = np.full((400, 1), 0.5)
    recording = Recording(t, goal, np.where(enabled, 0.4, 0.0)[:, None], np.zeros((1, 2)), constants)
    rows = {"torque": (0.5, 0.1, 2.0, rigs.put_torque), "damping": (0.05, 0.0, 0.5, rigs.of_joint("damping"))}
    rig = rigs.Rig(rigs.servo_runs, rows, {}, rows)
    angle = rigs.Fit(rig, rigs._parameters(rows, delay=False)[0], 0).predict([recording])[0][:, 0]
    assert angle.shape == t.shape
    assert angle[195] > 0.3  # held up against gravity
    assert abs(angle[-1]) < 0.05  # dropped
    assert np.abs(np.diff(angle)).max() < 0.1  # without a jump where the parts meet


def test_bams_friction_is_that_of_its_source():
    """Against the figures of Rhoban/bam's Model.compute_frictions (17d9addc), plus damping times speed."""
    p = {
        "friction_base": 0.05, "friction_viscous": 0.1, "friction_stribeck": 0.04, "load_friction_motor": 0.06,
        "load_friction_external": 0.07, "load_friction_motor_stribeck": 0.2, "load_friction_external_stribeck": 0.3,
        "load_friction_motor_quad": 0.01, "load_friction_external_quad": 0.008, "dtheta_stribeck": 0.2, "alpha": 1.35,
    }  # fmt: skip
    motor, load, speed = 1.2, -0.5, 0.15
    rest = np.exp(-((0.15 / 0.2) ** 1.35))
    gears, stuck = abs(-0.5 * 0.07 - 1.2 * 0.06), abs(-0.5 * 0.3 - 1.2 * 0.2)
    expected = 0.05 + gears + rest * (0.04 + stuck + 0.008 * 0.25) + 0.1 * 0.15  # the motor drives: the load's square
    assert float(bam.friction(p, motor, load, speed)) == pytest.approx(expected, rel=1e-6)
    aligned = 0.05 + abs(0.5 * 0.07 - 0.072) + rest * (0.04 + abs(0.15 - 0.24)) + 0.015
    assert float(bam.friction(p, motor, 0.5, speed)) == pytest.approx(aligned, rel=1e-6)
    m1 = {n: p[n] for n in ("friction_base", "friction_viscous")}
    assert float(bam.friction(m1, motor, load, speed)) == pytest.approx(0.065)


def test_a_bench_sticks_swings_and_falls():
    """A pendulum under no voltage: held by its friction, or falling as long as its inertia says."""
    load = {"mass": 1.0, "length": 0.1, "vin": 12.0}
    p = dict.fromkeys(("q_offset", "command_delay", "friction_viscous"), 0.0) | {"kt": 1.0, "R": 2.0, "armature": 0.0}
    off, none = jnp.zeros(200, bool), jnp.zeros(200)
    held = bam.simulate(p | {"friction_base": 0.5}, load, 1.0, jnp.array([0.3, 0.0]), none, off)
    np.testing.assert_allclose(held, 0.3)
    free = np.asarray(bam.simulate(p | {"friction_base": 0.0}, load, 1.0, jnp.array([0.05, 0.0]), none, off))
    period = 2 * np.pi * np.sqrt(0.1 / bam.GRAVITY)
    first = bam.STEP_S * int(np.argmin(free[: round(0.75 * period / bam.STEP_S)]))
    assert first == pytest.approx(period / 2, abs=2 * bam.STEP_S)
    pulled = bam.simulate(
        p | {"friction_base": 0.0}, load, 1.0, jnp.zeros(2), jnp.full(2000, 0.2), jnp.ones(2000, bool)
    )
    q = float(pulled[-1])  # the duty's torque holds the weight
    assert 0.5 * 12.0 * (0.2 - q) == pytest.approx(0.1 * bam.GRAVITY * np.sin(q), rel=0.02)


def steps(length_s=3.0):
    """A recording of a goal that jumps, without positions yet."""
    t = 0.01 * np.arange(round(100 * length_s))
    goal = np.random.default_rng(0).uniform(-0.5, 0.5, 10)[(t / 0.6).astype(int) % 10]
    return Recording(t, goal[:, None], np.zeros((len(t), 1)), np.zeros((1, 2)))


def test_the_textbook_servo_moves_as_its_equation_says():
    own = replace(steps(), command=np.full((300, 1), 0.3))
    servo = textbook.Servo([own], force=False, loaded=False)
    free = {"stiffness": 400.0, "damping": 10.0, "dry": 1e-4, "delay": 0.1, "rate": 100.0}
    (q,) = servo.predict(np.log([[free[n] for n in servo.names]]))
    s, w = own.t, np.sqrt(400.0 - 25.0)
    exact = 0.3 * (1 - np.exp(-5 * s) * (np.cos(w * s) + 5 / w * np.sin(w * s)))
    np.testing.assert_allclose(q[0], exact, atol=0.01)
    twice = replace(own, constants={"duty_per_rad": 2.0})
    both = servo.__class__([own, twice], force=False, loaded=False)
    stiff, half = (np.log([[(free | {"stiffness": k})[n] for n in servo.names]]) for k in (400.0, 200.0))
    np.testing.assert_allclose(both.predict(half)[1], servo.predict(stiff)[0], err_msg="a gain is a factor, in any set")


def test_a_published_axis_sticks_and_then_moves_as_its_equation_says():
    """Friction of 20.4 N holds it under 15 + 3.2 N; 100 N end at (100 + 3.2 - 20.4) N / 203.5 N s/m."""
    held, pushed = (replace(steps(6.0), command=np.full((600, 1), force)) for force in (15.0, 100.0))
    (still,), (moving,) = published.predict("published_idim", [held]), published.predict("published_idim", [pushed])
    assert abs(still[-1, 0]) < 1e-4
    assert (moving[-1, 0] - moving[-101, 0]) / 1.0 == pytest.approx(0.4067, rel=2e-3)
