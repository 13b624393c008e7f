"""What runs on the robot: the agent around a bundle's runner, in numpy alone."""

import jax
import jax.extend
import numpy as np
import pytest

from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.policy import ActionTerm, PolicyContract
from sim2real.policy.bundle import make_runner
from sim2real.policy.contract import observation_size
from sim2real.robots.loop import SENSOR
from sim2real.robots.nodes import PolicyNode, in_numpy
from sim2real.stages.load import load_robot
from sim2real.training.networks.policy import Policy

STEPS = 4


@pytest.fixture(scope="module", params=["pendulum", "arm", pytest.param("so101", marks=pytest.mark.night)])
def robot(request):
    return load_robot(request.param)


@pytest.fixture(scope="module")
def weights(robot):
    rng = np.random.default_rng(0)
    size, n = observation_size(robot.task.observation), len(robot.task.action)
    low, high = (np.array([getattr(a, side) for a in robot.task.action], np.float32) for side in ("low", "high"))
    kernels = {"layers.0.kernel": rng.normal(size=(size, 8)) / size, "layers.1.kernel": rng.normal(size=(8, n)) / 8}
    biases = {"layers.0.bias": rng.normal(size=8), "layers.1.bias": np.zeros(n)}
    own = {"mean": np.zeros(size), "std": np.ones(size), "low": low, "high": high, "log_std": np.zeros(n)}
    return {name: np.asarray(v, np.float32) for name, v in (own | kernels | biases).items()}


@pytest.fixture(scope="module")
def runner(robot, weights):
    bounds = zip(robot.task.action, weights["low"].tolist(), weights["high"].tolist(), strict=True)
    actions = tuple(ActionTerm(a.name, a.unit, low, high) for a, low, high in bounds)
    return make_runner(weights, PolicyContract(robot.task.observation, actions, robot.drive.rate_hz))


def steps_of(node, robot, policy):
    """Return the messages of a few steps on the same measurements."""
    params = in_numpy(node.init_params(None, GraphState()))
    params = params if policy is None else params.replace(policy=policy)
    start = GraphState(params={node.name: params})
    state = StepState(params=params, state=node.init_state(None, start), seq=np.int32(0))
    messages, none = [], np.zeros(1, np.float32)
    for k in range(STEPS):
        reading = jax.tree_util.tree_map(lambda x, k=k: np.asarray(x, np.float32)[None] + 0.1 * k, robot.drive.at_rest)
        seen = InputState(np.array([k], np.int32), none, none, reading)
        state, message = node.step(state.replace(inputs={SENSOR: seen}, seq=np.int32(k)))
        messages.append(message)
    return messages, state


def leaves(tree):
    return jax.tree_util.tree_leaves(tree)


def test_it_does_what_the_agent_does_with_the_policy_in_jax(robot, weights, runner):
    found, _ = steps_of(PolicyNode(robot.task.make_agent(robot.drive.rate_hz), runner), robot, None)
    expected, _ = steps_of(robot.task.make_agent(robot.drive.rate_hz), robot, Policy.from_weights(weights))
    for ours, theirs in zip(found, expected, strict=True):
        for a, b in zip(leaves(ours), leaves(theirs), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)


def test_a_step_on_the_robot_calls_nothing_of_jax(robot, runner, monkeypatch):
    node = PolicyNode(robot.task.make_agent(robot.drive.rate_hz), runner)
    params = in_numpy(node.init_params(None, GraphState()))
    state = node.init_state(None, GraphState(params={node.name: params}))

    def refuse(*arguments, **options):
        raise AssertionError("JAX was asked to compute")

    monkeypatch.setattr(jax.extend.core.Primitive, "bind", refuse)
    monkeypatch.setattr(node, "init_params", lambda *_: params)
    monkeypatch.setattr(node, "init_state", lambda *_: state)
    messages, after = steps_of(node, robot, None)
    assert {type(leaf) for leaf in leaves((messages, after.state))} <= {np.ndarray, np.float32, np.float64}


def test_an_episode_begins_with_a_reset(robot, runner, monkeypatch):
    begun = []
    monkeypatch.setattr(runner, "reset", lambda: begun.append(1), raising=False)
    PolicyNode(robot.task.make_agent(robot.drive.rate_hz), runner).startup(GraphState())
    assert begun == [1]
