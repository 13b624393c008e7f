"""A composed task as a node of a graph, as a brax environment and as a gymnasium vector environment."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import MJCFFeature
from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph import Base, BaseNode
from sim2real.graph.base import GraphState
from sim2real.graph.schedule import draw
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.worlds.recorded import DelayParams

CART = """
<mujoco model="cart"><option timestep="0.01"/>
  <worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="0.2"/>
    <geom size=".1" mass="0.5"/></body></worldbody>
  <actuator><motor joint="rail" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""


class Push(composer.Task):
    """Go to the right; the position is seen two physics steps late."""

    def __init__(self, start=0.0):
        self._root_entity = composer.ModelWrapperEntity(mjcf.from_xml_string(CART))
        self.rail = self._root_entity.mjcf_model.find("joint", "rail")
        self.control_timestep, self.start = 0.02, start

    @property
    def task_observables(self):
        found = {
            "late": MJCFFeature("qpos", self.rail, delay=2),
            "v": MJCFFeature("qvel", self.rail),
            "x": MJCFFeature("qpos", self.rail),
        }
        for value in found.values():
            value.enabled = True
        return found

    def initialize_episode(self, physics, random_state):
        physics.bind(self.rail).qpos = self.start * random_state.uniform(-1, 1)

    def get_reward(self, physics):
        return physics.bind(self.rail).qpos[0]

    def should_terminate_episode(self, physics):
        return physics.bind(self.rail).qpos[0] > 0.5


@struct.dataclass
class Force(Base):
    action: jax.Array


class Waves(BaseNode):
    def init_output(self, rng=None, graph_state=None):
        return Force(jnp.zeros(1))

    def step(self, step_state):
        return step_state, Force(jnp.sin(4.0 * step_state.ts)[None])


def play(parameters):
    """Return the commands and the observations of a second in a graph, at other parameters."""
    task = Push()
    places = {"damping": (task.rail, "damping"), "mass": (task.root_entity.mjcf_model.find("body", "cart"), "mass")}
    world = composer.ComposedWorld("world", task, parameters=places)
    agent = Waves("actuator", 50.0)
    world.connect(agent, skip=True, delay_dist=0.005)
    nodes = {"actuator": agent, "world": world}
    graph = CompiledGraph(nodes, "actuator", draw(nodes, 1.0))
    params = world.init_params()
    assert {k: np.asarray(v).tolist() for k, v in params.values.items()} == {"damping": [np.float32(0.2)], "mass": 0.5}
    values = {k: jnp.asarray(v, jnp.float32).reshape(params.values[k].shape) for k, v in parameters.items()}
    params = {"world": params.replace(values=values)}
    records = jax.jit(lambda: graph.rollout(graph.init(jax.random.key(0), params), record=("world", "actuator"))[1])()
    made = np.asarray(records["actuator"].seq)
    commands = {int(k): np.asarray(records["actuator"].output.action)[i] for i, k in enumerate(made) if k >= 0}
    consumed = graph.timeline.edges["world", "actuator"].seq_in[0]
    actions = []
    for tick in range(graph.rows * graph.wiring.ticks):
        arrived = np.flatnonzero((consumed >= 0) & (consumed <= tick))
        actions.append(commands[arrived[-1]] if arrived.size else np.zeros(1))
    return actions, records["world"].output.values


def test_a_graph_plays_the_task_of_the_c_engine_at_given_parameters():
    actions, found = play({"damping": 0.8, "mass": 0.4})
    task = Push()
    env = composer.Environment(task)
    env.reset()
    task.initialize_episode = lambda physics, random_state: None
    env.physics.bind(task.rail).damping = 0.8
    env.physics.bind(task.root_entity.mjcf_model.find("body", "cart")).mass = 0.4
    env.physics.recompute_constants()
    env.physics.forward()
    for i, action in enumerate(actions):
        env._reset_next_step = False  # the graph's world goes on where the task would end
        observation = env.step(action).observation
        for name in ("late", "x", "v"):
            np.testing.assert_allclose(found[name][i], observation[name], atol=1e-5)
    assert np.abs(found["x"]).max() > 0.01


def test_parameters_bring_the_constants_that_follow_from_them_and_wrong_ones_are_refused():
    task = Push()
    cart, geoms = (task.root_entity.mjcf_model.find_all(kind) for kind in ("body", "geom"))
    world = composer.ComposedWorld("world", task, parameters={"mass": (cart[0], "mass")})
    params = world.init_params().replace(values={"mass": jnp.array(2.0)})
    model = jax.jit(lambda params: world._model(params, starts=True))(params)
    np.testing.assert_allclose(model.body_invweight0[1], [0.5, 0.0], rtol=1e-6)
    state = jax.eval_shape(lambda: world.init_state(None, GraphState(params={"world": params})))
    assert {"body_invweight0", "body_subtreemass", "dof_invweight0"} <= set(state.leaves)  # steps go on with them
    with pytest.raises(UsageError, match=r"a tick of 0.01 s is no control step of 0.02 s"):
        composer.ComposedWorld("world", task, rate=100.0)
    with pytest.raises(UsageError, match="cannot change 'geom_contype'"):
        composer.ComposedWorld("world", task, parameters={"c": (geoms, "contype")})


class Witness(Push):
    """Leaves the start as it is, and keeps what it finds there."""

    def initialize_episode(self, physics, random_state):
        rail = physics.bind(self.rail)
        physics.variables["found"] = physics.np.concatenate([rail.qpos, rail.qvel])


@pytest.fixture(scope="module")
def witness():
    return composer.ComposedWorld("world", Witness())


def test_hooks_find_the_start_that_a_reset_is_given(witness):
    environment = witness.environment
    reset = jax.jit(lambda key, start: environment.reset(key, None, start))
    state = reset(jax.random.key(0), (jnp.array([0.3]), jnp.array([-1.5])))
    for found in (state.variables["found"], jnp.concatenate([state.data.qpos, state.data.qvel])):
        np.testing.assert_array_equal(found, np.float32([0.3, -1.5]))
    assert [np.asarray(state.observation[n]).item() for n in ("x", "v")] == [np.float32(0.3), -1.5]
    at_rest = jax.jit(environment.reset)(jax.random.key(0))
    np.testing.assert_array_equal(at_rest.variables["found"], [0.0, 0.0])


@pytest.mark.night
def test_a_world_starts_where_its_parameters_say(witness):
    nothing = witness.init_params()
    assert (nothing.qpos, nothing.qvel) == (None, None)

    def started(**start):
        gs = GraphState(params={"world": nothing.replace(**start)})
        state = jax.jit(lambda key: witness.init_state(key, gs))(jax.random.key(0))
        shown = witness.init_output(None, gs.replace(state={"world": state})).values
        assert [np.asarray(shown[n]).item() for n in ("x", "v")] == state.variables["found"].tolist()
        return state.variables["found"].tolist()

    assert started() == [0.0, 0.0]
    assert started(qpos=jnp.array([0.25])) == [0.25, 0.0]
    assert started(qvel=jnp.array([2.0])) == [0.0, 2.0]
    assert started(qpos=jnp.array([0.25]), qvel=jnp.array([2.0])) == [0.25, 2.0]


@pytest.mark.night
def test_the_end_of_a_task_is_no_truncation_and_divergence_is_the_end():
    pytest.importorskip("gymnasium", reason="the vector environment: the extra interop")
    vector = composer.MjxVectorEnv(composer.MjxEnvironment(Push(start=0.1), time_limit=0.2), 4)
    vector.reset(seed=0)
    places = jnp.array([[1.0], [jnp.nan], [0.0], [0.0]])
    state = vector._last
    vector._last = state.replace(data=state.data.replace(qpos=places))
    _, reward, terminated, truncated, infos = vector.step(np.zeros((4, 1)))
    assert terminated.tolist() == [True, True, False, False]
    assert not truncated.any()
    assert infos["discount"].tolist() == [1.0, 0.0, 1.0, 1.0]
    assert reward[:2].tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    ("name", "module", "needed"), [("BraxEnv", "brax", "brax.envs.base"), ("MjxVectorEnv", "vector", "gymnasium")]
)
def test_without_the_other_library_the_error_names_the_extra(name, module, needed, monkeypatch):
    monkeypatch.delitem(vars(composer), name, raising=False)
    monkeypatch.delitem(sys.modules, f"sim2real.interop.{module}", raising=False)
    monkeypatch.setitem(sys.modules, needed, None)
    library = needed.partition(".")[0]
    with pytest.raises(Sim2RealError, match=f"for {library} need {library}, which is not installed") as caught:
        getattr(composer, name)
    assert "gymnasium" in caught.value.hint


def test_commands_are_as_late_as_the_parameters_of_their_sender(witness):
    sender = DelayParams(delay=jnp.float32(0.012))
    delays = witness.init_delays(None, GraphState(params={"actuator": sender}))
    assert {name: float(delay) for name, delay in delays.items()} == {"actuator": pytest.approx(0.012)}
    assert witness.init_delays(None, GraphState(params={"actuator": DelayParams()})) == {}
