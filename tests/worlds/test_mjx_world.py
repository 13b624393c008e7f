import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from flax import struct
from mujoco import mjx

from sim2real.composer.physics.mjx import stepping
from sim2real.errors import UsageError
from sim2real.graph import Base, BaseNode
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.worlds.mjx import MjxState, MjxWorld

ARM = """
<mujoco>
  <option timestep="0.005" {option}/>
  <worldbody>
    <body><joint name="a" axis="0 1 0" damping="0.05"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass=".3"/>
      <body pos="0 0 .3"><joint name="b" axis="0 1 0" damping="0.05"/>
        <geom type="capsule" fromto="0 0 0 0 0 .3" size=".02" mass=".2" contype="0" conaffinity="0"/></body></body>
  </worldbody>
  <actuator><motor joint="a" {actuator}/><motor joint="b"/></actuator>
</mujoco>
"""


def arm(option="", actuator=""):
    return mujoco.MjModel.from_xml_string(ARM.format(option=option, actuator=actuator))


@struct.dataclass
class Torque(Base):
    action: jax.Array


class Waves(BaseNode):
    def init_output(self, rng=None, graph_state=None):
        return Torque(jnp.zeros(2))

    def step(self, step_state):
        return step_state, Torque(0.5 * jnp.sin(4.0 * step_state.ts + jnp.arange(2.0)))


def test_a_push_changes_velocities_and_nothing_else():
    world = MjxWorld("world", 100.0, arm())
    state = MjxState(jnp.array([0.1, 0.2]), jnp.array([1.0, -1.0]))
    pushed = world.with_velocity(state, world.velocity(state) + jnp.array([0.5, 0.0]))
    np.testing.assert_allclose(pushed.qvel, [1.5, -1.0])
    np.testing.assert_array_equal(pushed.qpos, state.qpos)


@pytest.mark.parametrize("friction", [0.0, 1e-44])
def test_a_joint_whose_friction_is_taken_away_coasts(friction):
    """Also to what underflows in single precision, as where friction wears off with speed: MJX braked it hard."""
    model = mujoco.MjModel.from_xml_string(ARM.format(option='gravity="0 0 0"', actuator="").replace("0.05", "0"))
    model.dof_frictionloss[:] = 0.1
    rough = mjx.put_model(model, impl="jax")
    smooth = rough.replace(dof_frictionloss=jnp.full(2, friction))
    data = mjx.make_data(model, impl="jax").replace(qvel=jnp.array([1.0, 0.0]))
    speeds = [float(stepping.JaxEngine().advance(own, data, legacy=False).qvel[0]) for own in (rough, smooth)]
    assert speeds[1] == pytest.approx(1.0, abs=0.01) != pytest.approx(speeds[0], abs=0.01)


def test_a_rollout_is_that_of_c_mujoco_under_the_same_commands():
    model = arm()
    world = MjxWorld("world", 100.0, model)
    agent = Waves("actuator", 50.0, delay_dist=0.003)
    world.connect(agent, skip=True, delay_dist=0.012)
    nodes = {"actuator": agent, "world": world}
    graph = CompiledGraph(nodes, "actuator", draw(nodes, 1.0))
    records = jax.jit(lambda key: graph.rollout(graph.init(key), record=("world", "actuator"))[1])(jax.random.key(0))
    made = np.asarray(records["actuator"].seq)
    commands = {int(k): np.asarray(records["actuator"].output.action)[i] for i, k in enumerate(made) if k >= 0}
    consumed = graph.timeline.edges["world", "actuator"].seq_in[0]
    data, angles = mujoco.MjData(model), []
    for tick in range(graph.rows * graph.wiring.ticks):
        arrived = np.flatnonzero((consumed >= 0) & (consumed <= tick))
        data.ctrl[:] = commands[arrived[-1]] if arrived.size else 0.0
        for _ in range(2):
            mujoco.mj_step(model, data)
        angles.append(data.qpos.copy())
    assert np.abs(np.array(angles)).max() > 0.1
    np.testing.assert_allclose(np.asarray(records["world"].output.qpos), angles, atol=2e-4)


@pytest.mark.parametrize(
    ("model", "rate", "match"),
    [
        (arm(), 70.0, "time steps"),
        (arm(option='noslip_iterations="3"'), 100.0, "no-slip"),
        (arm(option='integrator="implicit"'), 100.0, "world 'world': MJX has no integrator mjINT_IMPLICIT"),
        (arm(actuator='delay="0.02" nsample="8"'), 100.0, "ignores"),
    ],
)
def test_what_mjx_would_do_otherwise_is_refused(model, rate, match):
    with pytest.raises(UsageError, match=match):
        MjxWorld("world", rate, model)
