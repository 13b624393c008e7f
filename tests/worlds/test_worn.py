"""Friction that wears off with speed, beside a solution of its equation of motion by scipy."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sim2real.worlds.rollouts import Rollouts, Start, WornFriction

INERTIA, DAMPING, STEP_S, FAST = 0.01, 0.02, 0.0005, 4.0
XML = f"""<mujoco><option timestep="{STEP_S}" gravity="0 0 0" integrator="implicitfast"/>
  <default><joint axis="0 0 1" damping="{DAMPING}" frictionloss="0.1"
    solreffriction="{4 * STEP_S} 1" solimpfriction="0.999 0.999 0.001"/></default>
  <worldbody>
    <body><joint name="a"/><inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body>
    <body><joint name="b"/><inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/></body>
  </worldbody><actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>"""


def coasting(values, seconds=0.6):
    """Return the speeds of both joints after each step, from ``FAST``, without any torque."""
    model = mujoco.MjModel.from_xml_string(XML)
    start = Start(np.zeros(2), np.full(2, FAST), np.zeros(2))
    control = np.zeros((round(seconds / STEP_S), 1, 2))
    return Rollouts(model, 1, (), law=WornFriction())({}, start, control, values)[1]


def by_scipy(friction, width, t_s):
    """Return the speed of a coasting joint at times [s], as long as it turns."""
    slope = lambda _, v: -(friction * np.exp(-np.abs(v) / width) + DAMPING * v) / INERTIA  # noqa: E731
    return solve_ivp(slope, (0.0, t_s[-1]), [FAST], t_eval=t_s, rtol=1e-9, atol=1e-9).y[0]


@pytest.mark.parametrize("width", [0.3, 1.0, 5.0])
def test_joints_coast_as_the_equation_says_until_they_stick(width):
    friction = np.array([0.1, 0.02])
    speeds = coasting({"frictionloss": friction, "stribeck_rad_s": np.array([width, np.inf])})
    t_s = STEP_S * np.arange(len(speeds))
    for joint, own in enumerate((width, np.inf)):
        expected = by_scipy(friction[joint], own, t_s)
        turns = np.minimum.accumulate(expected) > 0.05
        assert turns.sum() > 100
        np.testing.assert_allclose(speeds[turns, joint], expected[turns], atol=0.03)
    still = by_scipy(friction[0], width, t_s) < -0.05
    assert np.all(np.abs(speeds[still, 0]) < 1e-3), "it sticks where it stopped, held by all of the friction"
