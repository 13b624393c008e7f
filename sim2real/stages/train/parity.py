"""Observations for the comparison of a bundle's runner with JAX, before the bundle is written."""

from typing import Protocol, runtime_checkable

import jax
import numpy as np

from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.episode import named_leaves
from sim2real.policy.bundle import PolicyReference
from sim2real.policy.runner import PolicyRunner
from sim2real.robots.loop import SENSOR
from sim2real.robots.nodes import in_numpy
from sim2real.robots.robot import Robot
from sim2real.training.networks.policy import Policy
from sim2real.types import Array, PyTree

MAX_OBSERVATIONS = 1000
"""Number of observations of one source that are compared."""


@runtime_checkable
class _Agent(Protocol):
    """A supervisor with the methods of a ``TrainingTask``."""

    name: str

    def init_params(self, rng: jax.Array | None, graph_state: GraphState) -> PyTree:
        """Return the parameters."""
        ...

    def init_state(self, rng: jax.Array | None, graph_state: GraphState) -> PyTree:
        """Return the state."""
        ...

    def observe(self, step_state: StepState) -> jax.Array:
        """Return the observation, shape ``(O,)``."""
        ...

    def act(self, step_state: StepState, action: Array) -> tuple[StepState, PyTree]:
        """Return the new step state and the output."""
        ...


def observations_of(robot: Robot, recording: Recording, runner: PolicyRunner) -> np.ndarray:
    """Return the observations ``(N, O)`` that a policy would get from a recording's measurements."""
    agent, sensor = robot.agent.make(robot.rate_hz), SENSOR
    if not isinstance(agent, _Agent):
        raise Sim2RealError(f"a {type(agent).__name__} has no `observe` and `act`, which a policy needs")

    # Arrange the recorded readings as the leaves of a message.
    leaves, form = jax.tree_util.tree_flatten(robot.sensor.at_rest)
    columns = [recording.episode.outputs[sensor][name] for name in named_leaves(robot.sensor.at_rest)]
    columns = [c.astype(np.float32).reshape(-1, *np.shape(leaf)) for c, leaf in zip(columns, leaves, strict=True)]

    # Play the agent over them.
    params = in_numpy(agent.init_params(None, GraphState()))
    state = StepState(params=params, state=in_numpy(agent.init_state(None, GraphState(params={agent.name: params}))))
    observations, zero = [], np.zeros(1, np.float32)
    runner.reset()
    for k in range(min(MAX_OBSERVATIONS, len(columns[0]))):
        message = jax.tree_util.tree_unflatten(form, [c[k : k + 1] for c in columns])
        state = state.replace(inputs={sensor: InputState(np.array([k], np.int32), zero, zero, message)})
        observations.append(np.asarray(agent.observe(state), np.float32))
        state, _ = agent.act(state, runner(observations[-1]))
    return np.array(observations)


def reference_of(policy: Policy, observations: np.ndarray) -> PolicyReference:
    """Return JAX's actions for observations ``(N, O)``, as those of one episode."""
    # On the processor: an accelerator multiplies matrices with less precision, by 1e-3 of the range.
    policy, x = jax.device_put((policy, observations), jax.devices("cpu")[0])
    actions = jax.jit(lambda policy, x: jax.lax.scan(policy.step, policy.initial_carry(), x)[1])(policy, x)
    return PolicyReference(observations, np.asarray(actions))
