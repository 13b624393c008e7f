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
from sim2real.training.environment.composed import TaskEnvironment
from sim2real.training.environment.graph_environment import _require_reward
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


def test_actions_without_bounds_are_refused():
    with pytest.raises(UsageError, match="PPO's actions are vectors with bounds"):
        TaskEnvironment(cart(""))


class Named(composer.NullTask):
    """A cart of random friction that is to go 3.5 mm to the right, whose reward has two terms."""

    @property
    def rail(self):
        return self.root_entity.mjcf_model.find("joint", "rail")

    def initialize_episode(self, physics, random_state):
        physics.bind(self.rail).damping = random_state.uniform(0.5, 2.0)

    def get_reward(self, physics):
        return {"far": -(physics.bind(self.rail).qpos[0] ** 2), "alive": 0.25}

    def should_terminate_episode(self, physics):
        return physics.bind(self.rail).qpos[0] > 0.0035


@pytest.fixture(scope="module")
def named():
    task = Named(cart('ctrlrange="-2 1" ctrllimited="true"').task.root_entity)
    task.set_timesteps(0.01, 0.01)
    return TaskEnvironment(composer.MjxEnvironment(task, time_limit=0.1))


@pytest.mark.parametrize(("force", "rows", "truncated"), [(0.0, 10, True), (1.0, 6, False)])
def test_a_task_keeps_the_protocol_and_sums_terms_by_name(named, force, rows, truncated):
    """A time limit is no end: the value of what follows counts."""
    check_environment(named)
    assert (named.observation_size, named.action_low.tolist(), named.action_high.tolist()) == (2, [-2], [1])
    step = jax.jit(named.step)
    state, _ = jax.jit(named.reset)(jax.random.key(0))
    assert set(map(float, state.terms.values())) == {0.0}
    made = [step(state, jnp.full(1, force), jax.random.key(0))]
    while not (made[-1].terminated or made[-1].truncated):
        made.append(step(made[-1].state, jnp.full(1, force), jax.random.key(0)))
    assert (len(made), bool(made[-1].truncated), bool(made[-1].terminated)) == (rows, truncated, not truncated)
    metrics = {name: float(value) for name, value in made[-1].metrics.items()}
    assert metrics.keys() == {"reward/far", "reward/alive"}
    assert metrics["reward/alive"] == pytest.approx(0.25 * rows)
    assert sum(metrics.values()) == pytest.approx(sum(float(m.reward) for m in made), rel=1e-5)
    position = np.array([float(m.observation[0]) for m in made])
    assert metrics["reward/far"] == pytest.approx(-np.sum(position**2), rel=1e-4, abs=1e-12)


def test_the_truth_of_a_composed_task_has_what_its_hooks_drew(named):
    reset = jax.jit(lambda key: named.privileged(named.reset(key)[0]))
    one, other = np.asarray(reset(jax.random.key(0))), np.asarray(reset(jax.random.key(1)))
    assert one.shape == (3,)
    np.testing.assert_array_equal(one[:2], 0.0)
    assert one[-1] != other[-1]
    assert 0.5 <= one[-1] <= 2.0


@struct.dataclass
class State:
    done: jax.Array
    truncated: jax.Array
    observation: dict = struct.field(default_factory=dict)


def test_what_is_over_stays_over(monkeypatch):
    world = composer.ComposedWorld.__new__(composer.ComposedWorld)
    after = State(jnp.array(False), jnp.array(False))
    world.environment = SimpleNamespace(step=lambda *_: after)
    world.input_name, world.field = "actuator", "action"
    monkeypatch.setattr(world, "_model", lambda params: None)
    given = {"actuator": SimpleNamespace(data=SimpleNamespace(action=jnp.zeros((1, 1))))}
    for truncated in (False, True):
        state = State(jnp.array(True), jnp.array(truncated))
        made = SimpleNamespace(
            state=state, inputs=given, params=None, replace=lambda state: SimpleNamespace(state=state)
        )
        new, _ = world.step(made)
        assert tuple(map(bool, world.ends(new.state))) == (not truncated, truncated)


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
