"""Rows in which the policy makes no step belong to its step before, for learners that know nothing of rows."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2real.errors import UsageError
from sim2real.graph.schedule import draw
from sim2real.interop.robot import RobotEnvironment
from sim2real.robots.training import training_loop
from sim2real.runtime.compiled.graph import CompiledGraph
from sim2real.stages.load import load_robot
from sim2real.stages.train.bundle import contract_of
from sim2real.training.environment.graph_environment import GraphEnvironment

VALUES = {"sensor_delay": 0.02, "actuator_delay": 0.025}


def robot_at(rate_hz, episode_s=0.5):
    """The pendulum, whose world ticks at 100 Hz, with a policy of another rate."""
    robot = load_robot("pendulum")
    nodes, task = training_loop(robot, {**robot.nominal(), **VALUES}, {}, {}, True)
    for name in ("sensor", "agent", "actuator"):
        nodes[name].rate = rate_hz
    env = GraphEnvironment(CompiledGraph(nodes, "agent", draw(nodes, episode_s)), task)
    return RobotEnvironment(env, contract_of(robot, task, {}))


@pytest.fixture(scope="module")
def played():
    """The same actions, row by row and policy step by policy step; at 40 Hz a step takes two or three ticks."""
    robot, key = robot_at(40.0), jax.random.key(3)
    env, turns = robot.env, robot.env.graph.turns[0]
    actions = jnp.linspace(-1.0, 1.0, int(turns.sum()))[:, None]

    def by_rows(state, action):
        made = env.step(state, action, key)
        return made.state, made._replace(state=made.state.step_state.seq)

    def by_steps(state, action):
        made = robot.step(state, action)
        return made, made._replace(env=made.env.step_state.seq, key=())

    of_row = actions[np.maximum(np.cumsum(turns) - 1, 0)][: env.length]
    rows = jax.jit(lambda: jax.lax.scan(by_rows, env.reset(jax.random.split(key)[0])[0], of_row)[1])()
    first = robot.reset(key)
    steps = jax.jit(lambda state: jax.lax.scan(by_steps, state, actions[: robot.step_limit])[1])(first)
    as_numpy = lambda tree: jax.tree.map(np.asarray, tree)  # noqa: E731
    return SimpleNamespace(turns=turns, rows=as_numpy(rows), steps=as_numpy(steps), state=first)


def test_every_step_is_one_of_the_policy(played):
    assert int(played.state.env.step_state.seq) == 0
    assert np.flatnonzero(played.steps.truncated).tolist() == [played.turns.sum() - 2]
    assert played.steps.env.tolist() == list(range(1, played.turns.sum()))


def test_rewards_of_the_rows_between_are_added_to_the_step_before(played):
    begins = np.flatnonzero(played.turns)
    wanted = [part.sum() for part in np.split(played.rows.reward[: begins[-1]], begins[1:-1])]
    np.testing.assert_allclose(played.steps.reward, wanted, rtol=1e-5)


def test_a_step_returns_what_the_policy_sees_next(played):
    before = np.flatnonzero(played.turns)[1:] - 1  # a row returns the observation of the row after it
    # The two programs round differently, and friction that bends near standstill makes 5.3e-6 of it in this episode.
    np.testing.assert_allclose(played.steps.observation, played.rows.observation[before], rtol=1e-5, atol=1e-5)


def test_a_timeline_with_a_single_step_is_refused():
    with pytest.raises(UsageError, match="'agent' makes fewer than two steps in a timeline"):
        robot_at(50.0, 0.02)
