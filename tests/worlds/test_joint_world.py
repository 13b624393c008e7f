"""The integrator of JointWorld against solutions in closed form, scipy, and MuJoCo's dry friction."""

import math
from itertools import pairwise

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from oracles.conformance import NodeConformance
from oracles.hash_nodes import Value
from scipy.integrate import solve_ivp

from sim2real.errors import UsageError
from sim2real.graph.node import BaseNode
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.worlds.joint import Forces, JointState, JointWorld

GRAVITY, DAMPING, DRY = 30.0, 0.7, 2.5


class Pendulum(JointWorld):
    """Hangs down at 0; params are (gravity, damping, dry friction), the command is an acceleration."""

    top = 1e9

    def init_params(self, rng=None, graph_state=None):
        return GRAVITY, DAMPING, DRY

    def init_state(self, rng=None, graph_state=None):
        return JointState(jnp.float32(1.0), jnp.float32(0.0))

    def init_output(self, rng=None, graph_state=None):
        return self.init_state()

    def command(self, step_state):
        return step_state.inputs["motor"][-1].data.x

    def forces(self, params, position, velocity, command):
        gravity, damping, dry = params
        return Forces(command - gravity * jnp.sin(position), damping, dry)

    def confine(self, params, state):
        return state.replace(velocity=jnp.clip(state.velocity, -self.top, self.top))


class Motor(BaseNode):
    def init_output(self, rng=None, graph_state=None):
        return Value(x=jnp.float32(0.0))

    def step(self, step_state):
        return step_state, Value(x=jnp.float32(7.0))


def connected():
    world, motor = Pendulum("world", 50), Motor("motor", 50)
    world.connect(motor, skip=True)
    return {"motor": motor, "world": world}


class TestPendulum(NodeConformance):
    def graph(self):
        return connected(), "world"


def swing(world, params, start, ticks, command=0.0):
    """Return positions and velocities after every tick, in the precision that is set."""

    def tick(state, _):
        state = world.integrate(params, state, command)
        return state, state

    first = JointState(*(jnp.asarray(x, jnp.result_type(float)) for x in start))
    states = jax.jit(lambda s: jax.lax.scan(tick, s, length=ticks)[1])(first)
    return np.asarray(states.position), np.asarray(states.velocity)


def test_without_friction_it_is_of_second_order():
    gravity, damping, command, start = 30.0, 0.7, 4.0, (1.2, -2.0)

    def f(_, x):
        return x[1], command - gravity * np.sin(x[0]) - damping * x[1]

    exact = solve_ivp(f, (0.0, 2.0), start, "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    errors = []
    with jax.enable_x64(True):
        for substep_s in (0.01, 0.005, 0.0025):
            world = Pendulum("w", 100, substep_s=substep_s)
            position, velocity = swing(world, (gravity, damping, 0.0), start, 200, command)
            errors.append(np.abs([position[-1] - exact[0], velocity[-1] - exact[1]]))
    assert np.all(errors[0] < [5e-3, 2e-2])
    for coarse, fine in pairwise(errors):
        np.testing.assert_allclose(coarse / fine, 4.0, rtol=0.05)


@pytest.mark.parametrize("damping", [0.5, 40.0])
def test_damping_alone_slows_exponentially(damping):
    with jax.enable_x64(True):
        position, velocity = swing(Pendulum("w", 100, substep_s=0.001), (0.0, damping, 0.0), (0.0, 3.0), 100)
    left = np.exp(-damping * 0.01 * np.arange(1, 101))
    np.testing.assert_allclose(velocity, 3.0 * left, rtol=1e-2, atol=3e-4)
    np.testing.assert_allclose(position, 3.0 / damping * (1.0 - left), rtol=3e-4)


def test_the_speed_at_which_damping_holds_a_push_is_exact_at_any_step():
    _, velocity = swing(Pendulum("w", 10, substep_s=0.1), (0.0, 8.0, 2.0), (0.0, 0.0), 100, 10.0)
    assert velocity[-1] == pytest.approx((10.0 - 2.0) / 8.0, rel=1e-6)


def mujocos_swing(start, duration_s):
    """Return positions every 10 ms of a hinge of unit inertia, at steps of 0.1 ms."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 1e-4
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    arm = spec.worldbody.add_body(mass=1.0, inertia=[1e-6, 1e-6, 1e-6], ipos=[0.0, 0.0, -1.0], explicitinertial=True)
    arm.add_joint(axis=[0.0, 1.0, 0.0], damping=DAMPING, frictionloss=DRY)
    model = spec.compile()
    model.dof_solref[:] = [2e-4, 1.0]  # as stiff as the step admits: friction is a soft constraint there
    model.dof_solimp[:, :2] = 0.9999
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = start
    rows = []
    for _ in range(round(duration_s * 100)):
        mujoco.mj_step(model, data, 100)
        rows.append(data.qpos[0])
    return np.array(rows)


@pytest.mark.parametrize("start", [(1.5, 0.0), (-0.4, 6.0)])
def test_a_damped_pendulum_with_dry_friction_moves_and_stops_as_in_mujoco(start):
    """Within 2 mrad over swings of radians, at steps of 1 ms; within 5 at those of 5 ms that worlds take."""
    expected = mujocos_swing(start, 4.0)
    assert np.ptp(expected) > 1.5
    assert abs(expected[-1]) > 0.01  # it came to rest beside the lowest point
    for substep_s, tolerance in ((0.001, 2e-3), (0.005, 5e-3)):
        position, velocity = swing(Pendulum("w", 100, substep_s=substep_s), (GRAVITY, DAMPING, DRY), start, 400)
        np.testing.assert_allclose(position, expected, atol=tolerance)
        assert set(velocity[-20:]) == {0.0}
        assert abs(position[-1]) <= math.asin(DRY / GRAVITY)


def test_a_tick_is_split_into_equal_parts():
    assert Pendulum("w", 100, substep_s=0.002).substeps == 5  # exactly, though 0.01 / 0.002 is a little more
    assert Pendulum("w", 100, substep_s=0.003).substeps == 4
    assert Pendulum("w", 100, substep_s=1.0).substeps == 1
    assert Pendulum("w", 100, substep_s=math.inf).substeps == 1
    assert Pendulum("w", 200).substeps == 1
    split = swing(Pendulum("w", 100, substep_s=0.002), (GRAVITY, DAMPING, DRY), (1.0, 0.0), 100)
    whole = swing(Pendulum("w", 500, substep_s=0.002), (GRAVITY, DAMPING, DRY), (1.0, 0.0), 500)
    for a, b in zip(split, whole, strict=True):
        np.testing.assert_allclose(a, b[4::5], atol=1e-4)


@pytest.mark.parametrize("substep_s", [0.0, -0.01, math.nan])
def test_a_bad_substep_is_an_error(substep_s):
    with pytest.raises(UsageError, match="world 'w': substep_s must be positive"):
        Pendulum("w", 100, substep_s=substep_s)


def test_stops_hold_after_every_substep():
    world = Pendulum("w", 10)
    world.top = 0.05
    position, velocity = swing(world, (GRAVITY, 0.0, 0.0), (1.0, 0.0), 1)
    assert velocity[-1] == pytest.approx(-0.05)
    assert 0.98 < position[-1] < 0.995  # it would have fallen to 0.87, were the last substep alone limited


def test_commands_come_in_through_the_graph():
    nodes = connected()
    graph = CompiledGraph(nodes, nodes["motor"], draw(nodes, 1.0))
    _, records = graph.rollout(graph.init(jax.random.key(0)), ("world",))
    world = nodes["world"]
    first = swing(world, (GRAVITY, DAMPING, DRY), (1.0, 0.0), 1)
    then = swing(world, (GRAVITY, DAMPING, DRY), [x[-1] for x in first], 48, 7.0)  # read by the second tick
    for name, a, b in zip(("position", "velocity"), first, then, strict=True):
        found = np.asarray(getattr(records["world"].output, name))[:49]
        np.testing.assert_allclose(found, np.concatenate([a, b]), atol=1e-5)


def test_a_pushed_joint_moves_as_one_that_had_this_velocity():
    world = Pendulum("world", 100.0)
    moving = JointState(jnp.float32(1.0), jnp.float32(2.0))
    pushed = world.with_velocity(world.init_state(), world.velocity(world.init_state()) + 2.0)
    params = world.init_params()
    assert world.integrate(params, pushed, 0.0) == world.integrate(params, moving, 0.0)
