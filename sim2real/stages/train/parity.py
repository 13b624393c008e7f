"""Observations on which what will run is compared with what was trained, before a bundle is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import numpy as np

from sim2real.artifacts.identification import Identification
from sim2real.artifacts.recording import Recording
from sim2real.errors import Sim2RealError
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.episode import named_leaves
from sim2real.policy.bundle import PolicyReference
from sim2real.policy.runner import PolicyRunner
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.control_loop.policy_node import in_numpy
from sim2real.stages.terminal.console import note
from sim2real.train.networks.policy import Policy

MOST = 1000
"""Observations of one source that are compared."""


def logged(identification: Identification | None, run_dir: Path) -> Recording | None:
    """Return the recording that was identified from, where it is still there: training does not need it."""
    if identification is None or not identification.logs:
        return None
    path = run_dir / identification.logs[0].path
    try:
        return Recording.load(path) if path.is_file() else None
    except Sim2RealError as error:
        note(f"warning: the runner is not compared with JAX on the log: {error}")
        return None


def observations_of(robot: LoopRobot, recording: Recording, runner: PolicyRunner) -> np.ndarray:
    """Return what a policy would have seen of a recording's measurements, had it been asked, ``(N, O)``.

    Args:
        runner: The policy, whose actions are part of what it sees later.
    """
    agent: Any = robot.make_agent()  # with observe and act, as training asks of it
    sensor = robot.roles.sensor
    leaves, form = jax.tree_util.tree_flatten(robot.at_rest)
    columns = [recording.episode.outputs[sensor][name] for name in named_leaves(robot.at_rest)]
    columns = [c.astype(np.float32).reshape(-1, *np.shape(leaf)) for c, leaf in zip(columns, leaves, strict=True)]
    params = in_numpy(agent.init_params(None, GraphState()))
    state = StepState(params=params, state=in_numpy(agent.init_state(None, GraphState(params={agent.name: params}))))
    seen, none = [], np.zeros(1, np.float32)
    runner.reset()
    for k in range(min(MOST, len(columns[0]))):
        message = jax.tree_util.tree_unflatten(form, [c[k : k + 1] for c in columns])
        state = state.replace(inputs={sensor: InputState(np.array([k], np.int32), none, none, message)})
        seen.append(np.asarray(agent.observe(state), np.float32))
        state, _ = agent.act(state, runner(seen[-1]))
    return np.array(seen)


def reference_of(policy: Policy, observations: np.ndarray) -> PolicyReference:
    """Return what JAX does on observations ``(N, O)``, as those of one episode."""
    # On the processor: an accelerator multiplies matrices with less precision, by 1e-3 of the range.
    policy, given = jax.device_put((policy, observations), jax.devices("cpu")[0])
    actions = jax.jit(lambda policy, given: jax.lax.scan(policy.step, policy.initial_carry(), given)[1])(policy, given)
    return PolicyReference(observations, np.asarray(actions))
