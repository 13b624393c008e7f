"""An encoder that is mounted a little off, and its inverse."""

import math

import jax
import jax.numpy as jnp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2real.worlds.recorded import Encoder

angles = st.floats(-20.0, 20.0)
offsets = st.floats(-0.5, 0.5)
eccentricities = st.floats(-0.1, 0.1)
phases = st.floats(-math.pi, math.pi)


def test_a_good_encoder_reads_the_angle():
    assert float(Encoder().read(1.25)) == 1.25
    assert float(Encoder().angle(1.25)) == 1.25
    assert float(Encoder().rate(1.25, -3.0)) == -3.0


@given(angle=angles, offset=offsets, eccentricity=eccentricities, phase=phases)
def test_the_reading_is_the_angle_the_offset_and_a_sine(angle, offset, eccentricity, phase):
    with jax.enable_x64(True):
        found = float(Encoder(offset, eccentricity, phase).read(angle))
    assert found == pytest.approx(angle + offset + eccentricity * math.sin(angle + phase), abs=1e-12)


@given(angle=angles, offset=offsets, eccentricity=eccentricities, phase=phases)
def test_angle_inverts_read_to_the_fourth_power_of_the_eccentricity(angle, offset, eccentricity, phase):
    encoder = Encoder(offset, eccentricity, phase)
    with jax.enable_x64(True):
        found = float(encoder.angle(encoder.read(angle)))
    assert abs(found - angle) <= eccentricity**4 + 1e-12


@given(angle=angles, velocity=st.floats(-50.0, 50.0), offset=offsets, eccentricity=eccentricities, phase=phases)
def test_rate_is_the_derivative_of_read(angle, velocity, offset, eccentricity, phase):
    encoder = Encoder(offset, eccentricity, phase)
    with jax.enable_x64(True):
        found = float(encoder.rate(angle, velocity))
        before, behind = (float(encoder.read(angle + s * 1e-5 * velocity)) for s in (-1, 1))
    assert found == pytest.approx((behind - before) / 2e-5, rel=1e-6, abs=1e-6)


def test_it_reads_many_angles_at_once():
    encoder = Encoder(0.1, 0.05, 0.7)
    q = jnp.linspace(-3.0, 3.0, 7)
    many = encoder.read(q)
    assert many.shape == (7,)
    assert [float(x) for x in many] == pytest.approx([float(encoder.read(float(x))) for x in q], abs=1e-6)
