"""Composed tasks in PPO: directly, and as the world of a graph."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from sim2real import composer
from sim2real.composer import mjcf
from sim2real.composer.observation.observable import MJCFFeature
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.training.environment.composed import TaskEnvironment, TaskState
from sim2real.training.environment.graph_environment import GraphEnvironment, _require_reward
from sim2real.training.environment.protocol import check_environment

CART = """
<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/><geom size=".1" mass="0.5"/></body></worldbody>
  <actuator><motor joint="rail" {limits}/></actuator></mujoco>
"""


def cart(limits):
    task = composer.NullTask(composer.ModelWrapperEntity(mjcf.from_xml_string(CART.format(limits=limits))))
    rail = task.root_entity.mjcf_model.find("joint", "rail")
    for name in ("qpos", "qvel"):
        task.root_entity.observables.add_observable(name, MJCFFeature(name, rail))
    return composer.MjxEnvironment(task, time_limit=0.1)


def test_a_task_keeps_the_protocol():
    env = TaskEnvironment(cart('ctrlrange="-2 1" ctrllimited="true"'))
    check_environment(env)
    assert (env.observation_size, env.action_low.tolist(), env.action_high.tolist()) == (2, [-2], [1])
    with pytest.raises(UsageError, match="PPO's actions are vectors with bounds"):
        TaskEnvironment(cart(""))


@struct.dataclass
class State:
    done: jax.Array
    truncated: jax.Array
    reward: jax.Array
    observation: dict
    terms: dict = struct.field(default_factory=dict)


@pytest.mark.parametrize(("done", "truncated"), [(True, True), (True, False), (False, False)])
def test_a_time_limit_is_no_end(done, truncated):
    state = State(jnp.array(done), jnp.array(truncated), jnp.float32(3), {"b": jnp.ones((1, 2)), "a": jnp.zeros(())})
    spec = SimpleNamespace(shape=(1,), minimum=-1.0, maximum=1.0)
    env = TaskEnvironment(
        SimpleNamespace(observation_spec=lambda: state.observation, action_spec=lambda: spec, step=lambda *_: state)
    )
    step = env.step(TaskState(state, {}), jnp.zeros(1), jax.random.key(0))
    assert (bool(step.terminated), bool(step.truncated)) == (done and not truncated, truncated)
    assert step.observation.tolist() == [1, 1, 0]


@pytest.mark.parametrize("ends", [(False, False), (True, False), (False, True)])
def test_a_composed_task_ends_the_episode_of_its_graph(ends):
    state = SimpleNamespace(step=jnp.int32(1), eps=jnp.int32(0), state={"world": None, "other": None})
    heard = SimpleNamespace(seq=jnp.int32(0))
    nodes = {"world": SimpleNamespace(ends=lambda state: tuple(map(jnp.bool_, ends))), "other": SimpleNamespace()}
    graph = SimpleNamespace(
        nodes=nodes,
        rows=9,
        last_row=lambda steps: steps - 1,
        advance=lambda *_, **__: state,
        observe=lambda gs, **_: (gs, heard, None),
        data=None,
        with_data=lambda _: graph,
    )
    task = SimpleNamespace(
        observation_size=1,
        action_low=np.zeros(1),
        action_high=np.ones(1),
        act=lambda step_state, action: (step_state, None),
        observe=lambda step_state: jnp.zeros(1),
        reward=lambda gs, action: jnp.float32(0),
        success=lambda gs: jnp.bool_(False),
        terminated=lambda gs: jnp.bool_(False),
        privileged=None,
    )
    env = GraphEnvironment(graph, task, np.array([9]))
    before = SimpleNamespace(step_state=heard, graph=state, total=0.0, good=0.0, width=None)
    step = env._step(env.data, before, jnp.zeros(1), jax.random.key(0))
    assert (bool(step.terminated), bool(step.truncated)) == ends


def test_what_is_over_stays_over(monkeypatch):
    world = composer.ComposedWorld.__new__(composer.ComposedWorld)
    after = State(jnp.array(False), jnp.array(False), jnp.float32(0), {})
    world.environment = SimpleNamespace(step=lambda *_: after)
    world.input_name, world.field = "actuator", "action"
    monkeypatch.setattr(world, "_model", lambda params: None)
    given = {"actuator": SimpleNamespace(data=SimpleNamespace(action=jnp.zeros((1, 1))))}
    for truncated in (False, True):
        state = State(jnp.array(True), jnp.array(truncated), jnp.float32(0), {})
        made = SimpleNamespace(
            state=state, inputs=given, params=None, replace=lambda state: SimpleNamespace(state=state)
        )
        new, _ = world.step(made)
        assert tuple(map(bool, world.ends(new.state))) == (not truncated, truncated)


class Named(composer.NullTask):
    """A cart of random friction, whose reward has two terms."""

    def initialize_episode(self, physics, random_state):
        rail = self.root_entity.mjcf_model.find("joint", "rail")
        physics.bind(rail).damping = random_state.uniform(0.5, 2.0)

    def get_reward(self, physics):
        rail = self.root_entity.mjcf_model.find("joint", "rail")
        return {"far": -(physics.bind(rail).qpos[0] ** 2), "alive": 0.25}


@pytest.fixture(scope="module")
def named():
    task = Named(cart('ctrlrange="-2 1" ctrllimited="true"').task.root_entity)
    return TaskEnvironment(composer.MjxEnvironment(task, time_limit=0.1))


def test_terms_of_a_reward_are_summed_by_name(named):
    check_environment(named)
    step = jax.jit(named.step)
    state, _ = jax.jit(named.reset)(jax.random.key(0))
    rewards = []
    for i in range(3):
        made = step(state, jnp.ones(1), jax.random.key(i))
        state, rewards = made.state, [*rewards, float(made.reward)]
    metrics = {name: float(value) for name, value in made.metrics.items()}
    assert metrics.keys() == {"reward/far", "reward/alive"}
    assert metrics["reward/alive"] == pytest.approx(0.75)
    assert sum(metrics.values()) == pytest.approx(sum(rewards), rel=1e-5)
    assert metrics["reward/far"] < 0.0
    again = jax.jit(named.reset)(jax.random.key(1))[0]
    assert set(map(float, again.terms.values())) == {0.0}


def test_the_truth_of_a_composed_task_has_what_its_hooks_drew(named):
    reset = jax.jit(lambda key: named.privileged(named.reset(key)[0]))
    one, other = np.asarray(reset(jax.random.key(0))), np.asarray(reset(jax.random.key(1)))
    assert one.shape == (3,)
    np.testing.assert_array_equal(one[:2], 0.0)
    assert one[-1] != other[-1]
    assert 0.5 <= one[-1] <= 2.0


@struct.dataclass
class Earned:
    """The part of a composed world's state that a reward may read."""

    reward: jax.Array
    terms: dict
    position: jax.Array


@pytest.mark.parametrize("reads", ["reward", "terms", "nothing", "other"])
def test_a_reward_that_ignores_the_composed_task_is_refused(reads):
    state = Earned(reward=jnp.float32(1.0), terms={"far": jnp.float32(2.0)}, position=jnp.float32(3.0))
    graph_state = GraphState(state={"world": state})
    rewards = {
        "reward": lambda gs, action: 2.0 * gs.state["world"].reward,
        "terms": lambda gs, action: gs.state["world"].terms["far"] - action[0],
        "nothing": lambda gs, action: -action[0],
        "other": lambda gs, action: gs.state["world"].position - action[0],
    }
    task = SimpleNamespace(reward=rewards[reads])
    if reads in ("reward", "terms"):
        _require_reward(task, graph_state, jnp.zeros(1), "world")
        return
    with pytest.raises(UsageError, match="ignores `get_reward`"):
        _require_reward(task, graph_state, jnp.zeros(1), "world")
