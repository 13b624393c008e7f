"""Each term of friction against its formula, and blocks on inclines that stick, slide and creep."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sim2real.worlds import friction
from sim2real.worlds.friction import FrictionParams
from sim2real.worlds.joint import Forces, JointState, JointWorld

G = 9.81
TICK_S = 0.01

speeds = st.floats(-50.0, 50.0, width=32)


class Block(JointWorld):
    """A block of unit mass on an incline, whose weight presses it down: the command is the slope [rad]."""

    def init_state(self, rng=None, graph_state=None):
        return JointState(jnp.float32(0.0), jnp.float32(0.0))

    def command(self, step_state):
        return jnp.float32(0.0)

    def forces(self, params, position, velocity, command):
        return Forces(
            acceleration=G * jnp.sin(command),
            damping=friction.damping(params, velocity),
            dry=friction.dry(params, velocity, G * jnp.cos(command)),
        )


def slide(params, slope, steps, start=(0.25, 0.0), world=None):
    """Return positions and velocities after every tick, ``(steps, )`` each."""
    world = world or Block("block", 1 / TICK_S, substep_s=TICK_S)

    def tick(state, _):
        state = world.integrate(params, state, slope)
        return state, state

    first = JointState(*(jnp.float32(x) for x in start))
    states = jax.jit(lambda s: jax.lax.scan(tick, s, length=steps)[1])(first)
    return np.asarray(states.position), np.asarray(states.velocity)


@given(speed=speeds, most=st.floats(0.0, 100.0, width=32))
def test_stopped_takes_away_up_to_the_most_and_never_reverses(speed, most):
    after = float(friction.stopped(jnp.float32(speed), jnp.float32(most)))
    assert after == pytest.approx(math.copysign(max(abs(speed) - most, 0.0), speed), rel=1e-5, abs=1e-6)
    if abs(speed) <= most:
        assert after == 0.0


@given(speed=speeds, push=st.floats(-20.0, 20.0, width=32), most=st.floats(0.0, 20.0, width=32))
@example(speed=1.1754943508222875e-38, push=0.0, most=0.5)
def test_rubbed_is_the_end_of_a_thousand_small_steps(speed, push, most):
    after = speed
    for _ in range(1000):
        pushed = after + push / 1000
        after = math.copysign(max(abs(pushed) - most / 1000, 0.0), pushed)
    found = float(friction.rubbed(jnp.float32(speed), jnp.float32(push), jnp.float32(most)))
    assert found == pytest.approx(after, abs=2e-3 * (abs(push) + most) + 1e-4)
    if abs(push) <= most and abs(speed) <= most - abs(push):
        assert found == 0.0, "it sticks"


LIMIT = math.atan(0.3)
"""Slope up to which a block with a coefficient of 0.3 stays."""


@pytest.mark.parametrize("slope", [1.1 * LIMIT, -1.1 * LIMIT])
@pytest.mark.parametrize("substeps", [1, 5])
def test_a_block_above_the_limit_moves_with_the_analytic_acceleration(slope, substeps):
    world = Block("block", 1 / TICK_S, substep_s=TICK_S / substeps)
    position, velocity = slide(FrictionParams(load=0.3), slope, 200, (0.0, 0.0), world)
    expected = math.copysign(G * (math.sin(abs(slope)) - 0.3 * math.cos(slope)), slope)
    t = TICK_S * np.arange(1, 201)
    np.testing.assert_allclose(velocity, expected * t, rtol=2e-5)
    np.testing.assert_allclose(position, expected * t**2 / 2, rtol=5e-5)
    position, velocity = slide(FrictionParams(load=0.3), 0.9 * slope, 10_000, world=world)  # below it
    assert (set(position), set(velocity)) == ({np.float32(0.25)}, {0.0})


def test_what_breaks_loose_keeps_sliding_where_it_would_not_have_started():
    p = FrictionParams(coulomb=1.0, static=1.0, stribeck_rad_s=0.1)
    between = math.asin(1.5 / G)
    position, _ = slide(p, between, 10_000)
    assert set(position) == {np.float32(0.25)}
    _, velocity = slide(p, between, 400, (0.0, 0.5))
    assert np.diff(velocity)[-1] / TICK_S == pytest.approx(1.5 - 1.0, rel=1e-3)
    _, velocity = slide(p, math.asin(2.02 / G), 1000, (0.0, 0.0))
    assert np.diff(velocity)[-1] / TICK_S == pytest.approx(2.02 - 1.0, rel=1e-3)


@pytest.mark.parametrize("speed", [1.0, -1.0])
def test_it_stops_where_the_work_of_friction_says_and_stays(speed):
    """Only the step in which it stops is cut short: it adds an eighth of what friction moves in a step, at most."""
    deceleration = 3.7
    position, velocity = slide(FrictionParams(coulomb=deceleration), 0.0, 200, (0.0, speed))
    stopped = np.flatnonzero(velocity == 0.0)
    assert stopped[0] == math.ceil(1.0 / (deceleration * TICK_S)) - 1
    assert len(set(position[stopped])) == 1
    beyond = abs(position[-1]) - 1.0 / (2 * deceleration)
    assert -1e-6 < beyond < deceleration * TICK_S**2 / 8 + 1e-6


def test_drag_slows_as_the_reciprocal_of_time():
    drag, v0 = 0.8, 5.0
    world = Block("block", 1 / TICK_S, substep_s=TICK_S / 50)
    position, velocity = slide(FrictionParams(drag=drag), 0.0, 200, (0.0, v0), world)
    grown = 1.0 + drag * v0 * TICK_S * np.arange(1, 201)
    np.testing.assert_allclose(velocity, v0 / grown, rtol=5e-4)
    np.testing.assert_allclose(position, np.log(grown) / drag, rtol=5e-4)
