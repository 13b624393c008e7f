"""What an XL330 makes of commands, against integers and floats by hand."""

import math

import jax
import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2real.stages.load import load_module

MODEL = load_module("xl330", "model")
motor_torque, position_duty = MODEL.motor_torque, MODEL.position_duty

COUNTS = 4096 / (2 * math.pi)
FULL = 885


def duty_by_hand(goal_counts, position_counts, kp):
    """The firmware in whole numbers: PWM steps, cut towards 0."""
    pwm = int(kp * (goal_counts - position_counts) / 256)  # int() cuts
    return max(-FULL, min(FULL, pwm)) / FULL


@given(goal=st.integers(-4096, 4096), position=st.integers(-4096, 4096), kp=st.integers(1, 2000))
def test_position_duty_is_what_the_firmware_computes_in_integers(goal, position, kp):
    found = position_duty(jnp.float32(goal / COUNTS), jnp.float32(position / COUNTS), kp / 256, COUNTS, float(FULL))
    assert float(found) == pytest.approx(duty_by_hand(goal, position, kp), abs=1e-6)


duties, velocities = st.floats(-1.0, 1.0), st.floats(-20.0, 20.0)
stalls, back_emfs = st.floats(0.1, 5.0), st.floats(0.0, 1.0)


@given(duty=duties, velocity=velocities, stall=stalls, back_emf=back_emfs, softness=st.floats(0.05, 5.0))
def test_the_torque_never_exceeds_the_reciprocal_of_the_softness(duty, velocity, stall, back_emf, softness):
    with jax.enable_x64(True):
        torque = float(motor_torque(duty, velocity, stall, back_emf, softness))
        linear = float(motor_torque(duty, velocity, stall, back_emf))
    assert abs(torque) < 1.0 / softness
    assert abs(torque) <= abs(linear)
    assert torque * linear >= 0.0
    assert 1.0 / abs(torque) == pytest.approx(1.0 / abs(linear) + softness) if torque else linear == 0.0


@given(duty=duties, velocity=velocities, stall=stalls, back_emf=back_emfs)
def test_without_softness_the_torque_is_linear(duty, velocity, stall, back_emf):
    with jax.enable_x64(True):
        torque = float(motor_torque(duty, velocity, stall, back_emf))
    assert torque == pytest.approx(stall * duty - back_emf * velocity, abs=1e-12)


def test_the_torque_nears_its_limit_and_ends_at_the_idle_speed():
    assert float(motor_torque(1.0, 0.0, 1e6, 0.05, 0.8)) == pytest.approx(1 / 0.8, rel=1e-4)
    assert float(motor_torque(1.0, 20.0, 1.0, 0.05, 0.8)) == pytest.approx(0.0, abs=1e-7)
