"""An encoder that is mounted a little off, and its inverse."""

import math

import jax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2real.worlds.recorded import Encoder


@given(
    angle=st.floats(-20.0, 20.0),
    velocity=st.floats(-50.0, 50.0),
    offset=st.floats(-0.5, 0.5),
    eccentricity=st.floats(-0.1, 0.1),
    phase=st.floats(-math.pi, math.pi),
)
def test_the_reading_is_the_angle_the_offset_and_a_sine_and_can_be_inverted(
    angle, velocity, offset, eccentricity, phase
):
    encoder, perfect = Encoder(offset, eccentricity, phase), Encoder()
    with jax.enable_x64(True):
        read = float(encoder.read(angle))
        assert read == pytest.approx(angle + offset + eccentricity * math.sin(angle + phase), abs=1e-12)
        assert abs(float(encoder.angle(read)) - angle) <= eccentricity**4 + 1e-12
        before, behind = (float(encoder.read(angle + s * 1e-5 * velocity)) for s in (-1, 1))
        assert float(encoder.rate(angle, velocity)) == pytest.approx((behind - before) / 2e-5, rel=1e-6, abs=1e-6)
        assert (perfect.read(angle), perfect.angle(angle), perfect.rate(angle, velocity)) == (angle, angle, velocity)
