"""The pendulum's model against an integrator of another make, and its embedded robot against physics by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim2real.hardware.device import OperatingMode
from sim2real.stages.load import load_module, load_robot

PIPELINE = load_robot("pendulum")
MODEL, PLANT = (load_module(PIPELINE.name, name) for name in ("model", "plant"))
OFF, PWM = OperatingMode.OFF, OperatingMode.PWM


def acceleration(groups, th, thdot, voltage, turn):
    """The equation of motion, written down again."""
    motor = groups["gain"] * voltage - groups["damping"] * thdot
    return motor + groups["gravity"] * np.sin(th) - groups["friction"] * turn


def simulate(groups, start, voltage, ticks):
    """Angle and velocity of the model after every tick, `(ticks, 2)`."""
    world, params = MODEL.PendulumWorld("world", 100.0), MODEL.from_groups(groups, start)

    def tick(x, _):
        x = world.integrate(params, x, jnp.float32(voltage))
        return x, jnp.stack([x.th, x.thdot])

    state = MODEL.Measurement(th=jnp.float32(start[0]), thdot=jnp.float32(start[1]))
    return np.asarray(jax.jit(lambda x: jax.lax.scan(tick, x, length=ticks)[1])(state))


@pytest.mark.parametrize("start", [(np.pi, 0.0), (1.0, -3.0), (0.1, 8.0)])
@pytest.mark.parametrize("voltage", [0.0, 1.7])
def test_the_model_is_integrated_as_scipy_does(start, voltage):
    """Friction is that of ``sign``, which scipy bears where it is a little less steep."""
    groups = {n: float(v) for n, v in MODEL.groups(MODEL.nominal_params()).items()}
    simulated = simulate(groups, start, voltage, 100)

    def f(_, x):
        return x[1], acceleration(groups, x[0], x[1], voltage, np.tanh(x[1] / 1e-3))

    exact = solve_ivp(f, (0.0, 1.0), start, "LSODA", np.arange(1, 101) / 100, rtol=1e-9, atol=1e-10, max_step=0.001)
    np.testing.assert_allclose(simulated[:, 0], exact.y[0], atol=2e-3)
    np.testing.assert_allclose(simulated[:, 1], exact.y[1], atol=2e-2)


@pytest.mark.parametrize(
    ("start", "voltage"),
    [
        ((0.03, 0.0), 0.0),  # upright, held by friction
        ((0.0, 0.0), 0.35),  # a voltage below friction
        ((2.0, 0.0), 0.0),  # swings, and stops within the band of friction
        ((np.pi, 0.0), 1.2),
        ((0.2, -3.0), -0.5),
    ],
)
def test_the_model_moves_and_sticks_as_c_mujoco_does(start, voltage):
    plant = released(PLANT.PendulumPlant(), *start)
    plant.command(1, PWM, voltage / PLANT.SUPPLY_V)
    in_c = trajectory(plant, 5.0)[::20][1:]
    ours = simulate(plant.truth(), start, voltage, len(in_c))
    np.testing.assert_allclose(ours[:, 0], in_c[:, 0], atol=0.004)
    if abs(in_c[-1, 1]) < 1e-3:
        assert ours[-1, 1] == 0.0, "it sticks"
        assert ours[-1, 0] == ours[-100, 0], "and does not creep"


def test_the_end_of_a_motion_has_the_derivative_that_differences_give():
    """Through stops and reversals of the swing, down to where it sticks."""
    groups = {n: float(v) for n, v in MODEL.groups(MODEL.nominal_params()).items()}
    world = MODEL.PendulumWorld("world", 100.0)

    def end(gravity):
        params = MODEL.from_groups({**groups, "gravity": gravity}, jnp.array([2.0, 0.0]))
        step = lambda x, _: (world.integrate(params, x, 0.4), None)  # noqa: E731
        state = MODEL.Measurement(th=jnp.asarray(2.0), thdot=jnp.asarray(0.0))
        return jax.lax.scan(step, state, length=60)[0].th

    with jax.enable_x64(True):
        slope, at = float(jax.jit(jax.grad(end))(groups["gravity"])), jax.jit(end)
        difference = float(at(groups["gravity"] + 1e-4) - at(groups["gravity"] - 1e-4)) / 2e-4
    assert slope == pytest.approx(difference, rel=1e-3)
    assert abs(slope) > 1e-4


def released(plant, th, thdot=0.0):
    plant.data.qpos[0], plant.data.qvel[0] = th, thdot
    return plant


def trajectory(plant, duration_s, step_s=0.0005):
    """Advance and return angle and velocity at every step, `(N, 2)`."""
    begin = plant.data.time
    rows = []
    for i in range(round(duration_s / step_s)):
        rows.append((plant.data.qpos[0], plant.data.qvel[0]))
        plant.advance(begin + (i + 1) * step_s)
    return np.array(rows)
