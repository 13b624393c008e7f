"""The policy's node: goals that a policy moves, and what it is shown."""

import jax
import jax.numpy as jnp
import numpy as np
from oracles.conformance import NodeConformance

from sim2real import pytree
from sim2real.graph import BaseNode
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.robots.agent import AgentParams, GoalAgent
from sim2real.robots.messages import JointReading
from sim2real.stages.load import load_module

LOW, HIGH, RATE_HZ = np.array([-1.0, -0.5]), np.array([0.8, 1.2]), 50.0
AIM, START = np.array([0.25, -0.5, 2.0]), np.array([0.1, -0.2])


def make_agent(history=3):
    def features(reading, goal, aim):
        return jnp.concatenate([reading.position - goal, aim])

    return GoalAgent("agent", RATE_HZ, LOW, HIGH, features, history, len(AIM))


class Still(BaseNode):
    """A robot that does not move."""

    def init_output(self, rng=None, graph_state=None):
        return JointReading(jnp.zeros(2), jnp.zeros(2))

    def step(self, step_state):
        return step_state, self.init_output()


class Push:
    """A policy that remembers what it was shown."""

    def __init__(self, action):
        self.action, self.shown = action, []

    def get_action(self, observation):
        self.shown.append(np.asarray(observation))
        return self.action


class TestGoalAgent(NodeConformance):
    def graph(self):
        sensor, agent = Still("sensor", RATE_HZ), make_agent()
        agent.connect(sensor, blocking=True)
        return {"sensor": sensor, "agent": agent}, "agent"


def started(agent, **params):
    params = AgentParams(**{"aim": jnp.asarray(AIM), "start": jnp.asarray(START), **params})
    gs = GraphState(params={"agent": params})
    return StepState(state=agent.init_state(None, gs), params=params), agent.init_output(None, gs)


def seeing(step_state, position, velocity):
    one = jnp.zeros(1)
    reading = JointReading(jnp.asarray(position)[None], jnp.asarray(velocity)[None])
    return step_state.replace(inputs={"sensor": InputState(jnp.zeros(1, jnp.int32), one, one, reading)})


def test_an_action_is_the_speed_of_the_goals_and_they_stay_within_their_limits():
    agent = make_agent()
    step_state, first = started(agent)
    np.testing.assert_allclose(first.command, START, rtol=1e-6)
    actions = np.random.default_rng(1).uniform(-2, 2, (150, 2)) + np.array([1.0, -1.0])
    expected = START
    clipped = False
    for action in actions:
        step_state, decision = agent.act(seeing(step_state, np.zeros(2), np.zeros(2)), action)
        clipped |= bool(np.any(np.abs(expected + action / RATE_HZ - 0.1) > 1.0))
        expected = np.clip(expected + action / RATE_HZ, LOW, HIGH)
        np.testing.assert_allclose(decision.command, expected, atol=1e-5)
        np.testing.assert_array_equal(step_state.state.command, decision.command)
    assert expected[0] > 0.7, "it was pushed to a limit"
    assert expected[1] < -0.4
    beyond, _ = started(agent, start=jnp.array([0.9, -0.6]))
    _, decision = agent.act(seeing(beyond, np.zeros(2), np.zeros(2)), np.zeros(2))
    np.testing.assert_allclose(decision.command, [0.8, -0.5], rtol=1e-6)


def test_history_is_what_was_seen_and_told_newest_first():
    agent = make_agent(history=3)
    step_state, _ = started(agent)
    rows = [np.zeros(6)] * 3
    for k in range(5):
        position, velocity = np.array([0.01 * k, -0.02 * k]), np.array([k, 10.0 * k])
        step_state = seeing(step_state, position, velocity)
        shown = np.asarray(agent.observe(step_state))
        features = np.concatenate([position - np.asarray(step_state.state.command), AIM])
        np.testing.assert_allclose(shown, np.concatenate([features, *rows]), atol=1e-6)
        assert shown.dtype == np.float32
        step_state, decision = agent.act(step_state, np.array([0.5, -0.5]))
        rows = [np.concatenate([position, velocity, np.asarray(decision.command)]), *rows[:2]]


def test_it_asks_the_policy_and_without_one_goals_stay():
    agent, policy = make_agent(), Push(np.array([1.0, -2.0]))
    step_state, _ = started(agent, policy=policy)
    now = seeing(step_state, np.array([0.3, 0.1]), np.zeros(2))
    _, decision = agent.step(now)
    np.testing.assert_allclose(decision.command, START + np.array([1.0, -2.0]) / RATE_HZ, atol=1e-6)
    np.testing.assert_array_equal(policy.shown[0], agent.observe(now))
    _, decision = agent.step(now.replace(params=now.params.replace(policy=None)))
    np.testing.assert_allclose(decision.command, START, atol=1e-7)


def test_the_pendulums_agent_sends_actions_as_they_are_and_shows_what_it_saw_and_did_before():
    model = load_module("pendulum", "model")
    agent, policy = model.Agent("agent", RATE_HZ), Push(None)
    state, sent, one = agent.init_state(), [], jnp.zeros(1)
    for k in range(3):
        reading = model.Measurement(th=jnp.zeros(1), thdot=jnp.array([10.0 * k]))
        heard = {"sensor": InputState(one.astype(int), one, one, reading)}
        policy.action = jnp.array([0.5 + k])
        made = agent.step(StepState(state=state, params=AgentParams(policy=policy), inputs=heard))
        state = made[0].state
        sent.append(float(made[1].command[0]))
    assert sent == [0.5, 1.5, 2.5]
    rows = np.zeros((3, model.HISTORY, 4))
    rows[1, 0], rows[2, :2] = [1, 0, 0, 0.5], [[1, 0, 1, 1.5], [1, 0, 0, 0.5]]
    for k, row in enumerate(rows):
        np.testing.assert_array_equal(policy.shown[k], [1, 0, k, *row[:, :3].ravel(), *row[:, 3]])


@pytree.dataclass
class Counting:
    """A policy that remembers in how many steps it was asked."""

    first: float

    def initial_carry(self):
        return jnp.zeros(())

    def step(self, carry, observation):
        return carry + 1.0, jnp.full(2, self.first + carry)


def test_a_policy_that_remembers_goes_on_and_begins_anew_with_each_episode():
    agent = make_agent()
    for _ in range(2):
        step_state, _ = started(agent, policy=Counting(0.1))
        sent = []
        for _ in range(3):
            step_state, message = agent.step(seeing(step_state, [0.0, 0.0], [0.0, 0.0]))
            sent.append(np.asarray(jax.tree.leaves(message)[0]))
        moved = np.diff([START, *sent], axis=0) * RATE_HZ
        np.testing.assert_allclose(moved, np.array([[0.1], [1.1], [2.1]]) * np.ones(2), rtol=1e-4)


def test_an_aim_that_moves_is_that_of_the_steps_time():
    agent = GoalAgent("agent", RATE_HZ, LOW, HIGH, lambda r, g, aim: aim, 0, 2, lambda n, t_s: n[:1] + n[1:] * t_s)
    step_state, first = started(agent, aim=np.array([0.5, 2.0]))
    np.testing.assert_allclose(first.aim, [0.5])
    for k in (0, 25, 100):
        now = seeing(step_state.replace(seq=k), np.zeros(2), np.zeros(2))
        np.testing.assert_allclose(agent.observe(now), [0.5 + 2.0 * k / RATE_HZ])
        np.testing.assert_allclose(agent.act(now, np.zeros(2))[1].aim, [0.5 + 2.0 * k / RATE_HZ])
