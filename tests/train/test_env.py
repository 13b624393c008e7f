"""A graph as an environment: what ends an episode, and what its end is worth."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.graph.schedule import draw
from sim2real.robots.loop import AGENT
from sim2real.robots.robot import Judgement
from sim2real.robots.training import training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import load_robot
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.environment.tasks import checked_end, terms_of, total_of

FAST = 8.0
"""A pendulum that turns faster has failed [rad/s]."""
COPIES = 16


@pytest.fixture(scope="module")
def robot():
    robot = type(load_robot("pendulum"))()

    class Careful(type(robot.task)):
        def judge(self, graph_state, action):
            ended = jnp.abs(graph_state.state["world"].thdot) > FAST
            return super().judge(graph_state, action)._replace(ended=ended)

    robot.task = Careful()
    return robot


def make(robot, **of_world):
    nodes, task = training_loop(robot, robot.nominal(), {}, {}, False)
    vars(nodes["world"]).update(of_world)
    return GraphEnvironment(CompiledGraph(nodes, AGENT, draw(nodes, 0.6)), task)


@pytest.fixture(scope="module")
def env(robot):
    return make(robot)


def play(env):
    """Play episodes at full voltage on to the last row, whatever ends them; with the speeds after each row."""

    def one(key):
        def row(state, _):
            step = env.step(state, jnp.array([2.0]), key)
            return step.state, (step._replace(state=step.state.graph.state["world"].thdot))

        return jax.lax.scan(row, env.reset(key)[0], length=env.length)[1]

    steps = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), COPIES))
    return jax.tree.map(lambda leaf: np.swapaxes(np.asarray(leaf), 0, 1), steps)


@pytest.fixture(scope="module")
def played(env):
    return play(env)


def test_a_robot_says_when_an_episode_has_ended(played):
    fast = np.abs(played.state) > FAST
    np.testing.assert_array_equal(played.terminated, fast)
    assert 0.05 < fast.mean() < 0.95
    np.testing.assert_array_equal(np.flatnonzero(played.truncated.all(1)), [len(played.truncated) - 1])


def test_a_world_may_end_the_episode_or_cut_it():
    played = play(
        make(load_robot("pendulum"), ends=lambda state: (state.thdot > FAST, (state.thdot > 4.0) & (state.thdot < 5.0)))
    )
    np.testing.assert_array_equal(played.terminated, played.state > FAST)
    np.testing.assert_array_equal(played.truncated[:-1], ((played.state > 4.0) & (played.state < 5.0))[:-1])
    assert played.terminated.any()
    assert played.truncated[:-1].any()


def test_named_terms_of_the_reward_add_up_to_the_return(played):
    terms = {n.removeprefix("reward/"): v for n, v in played.metrics.items() if n.startswith("reward/")}
    assert set(terms) == {"angle", "speed", "voltage"}
    np.testing.assert_allclose(sum(terms.values()), played.metrics["return"], rtol=1e-5)
    np.testing.assert_allclose(np.cumsum(played.reward, axis=0), played.metrics["return"], rtol=1e-5)
    rows = np.arange(1, len(played.reward) + 1)[:, None]
    np.testing.assert_allclose(terms["voltage"], np.broadcast_to(-0.04 * rows, played.reward.shape), rtol=1e-5)


def test_a_value_function_may_see_the_true_state_and_the_parameters(env):
    state = jax.eval_shape(lambda key: env.reset(key)[0], jax.random.key(0))
    made = {name: jax.tree.map(lambda x: jnp.full(x.shape, 3, x.dtype), p) for name, p in state.graph.params.items()}
    graph = state.graph.replace(params=made)
    world = graph.state["world"].replace(th=jnp.float32(0.5), thdot=jnp.float32(-2.0))
    shown = env.privileged(state._replace(graph=graph.replace(state={**graph.state, "world": world})))
    np.testing.assert_array_equal(shown[:2], [0.5, -2.0])
    parameters = [leaf for leaf in jax.tree.leaves(graph.params) if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert len(shown) == 2 + sum(leaf.size for leaf in parameters)
    np.testing.assert_array_equal(shown[2:], 3.0)


def test_a_reward_is_a_number_or_its_terms_and_an_end_is_a_bool():
    for reward, total in ((2.0, 2.0), ({"a": 2.0, "b": -3.0}, -1.0)):
        assert total_of(reward) == total
        assert terms_of(reward) == (reward if isinstance(reward, dict) else {})
    with pytest.raises(UsageError, match=r"no terms[\s\S]*hint: return a number"):
        total_of({})
    for ended in (jnp.float32(0.3), jnp.zeros(2, bool)):
        with pytest.raises(UsageError, match=r"`terminated` of list must return a bool of shape \(\), got"):
            checked_end(ended, [])
    assert not Judgement(0.0, jnp.bool_(False)).ended
