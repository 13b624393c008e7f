"""The bundle of a trained policy: contract, weights, graph, history, and JAX's actions to compare a runner with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from sim2real.artifacts.bundle import Bundle, History
from sim2real.artifacts.episodes import Episodes
from sim2real.artifacts.identification import ROUND_TRIP
from sim2real.artifacts.recording import Recording
from sim2real.artifacts.sensitivity import Sensitivity
from sim2real.graph.base import GraphState, InputState, StepState
from sim2real.graph.episode import named_leaves
from sim2real.policy.bundle import PolicyReference, make_runner
from sim2real.policy.contract import PolicyContract
from sim2real.policy.runner import PolicyRunner
from sim2real.robots.loop import DELAYS, SENSOR
from sim2real.robots.nodes import in_numpy
from sim2real.robots.robot import Robot
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.setup import TrainingSetup
from sim2real.training.config import PPOConfig
from sim2real.training.environment.tasks import TrainingTask
from sim2real.training.networks.onnx_export import export_graph
from sim2real.training.networks.policy import Policy
from sim2real.training.ppo.trainer import Progress, TrainResult
from sim2real.training.sweep import Sweep, format_point
from sim2real.types import Json

Watch = Callable[[Progress], None]
"""A function that receives the figures of each evaluation."""
_MAX_OBSERVATIONS = 1000
"""Number of observations from training, and from the log, that are compared."""


def bundle_of_training(
    setup: TrainingSetup,
    config: TrainConfig,
    contract: PolicyContract,
    result: TrainResult,
    weakness: Sensitivity | None,
    recording: Recording | None,
) -> Bundle:
    """Return the best policy as a bundle, with JAX's actions on observations of training and log to compare with."""
    policy, weights = result.best, result.best.to_weights()
    graph = export_graph(policy)

    # Take observations from the end of the training, and from the robot's recording.
    observations = {"training": result.observations[:_MAX_OBSERVATIONS]}
    if recording is not None and has_readings(setup.robot, recording):
        runner = make_runner(weights, contract, None, policy.spec, graph)
        observations["log"] = _observations(setup.robot, recording, runner)

    curves = {name: np.asarray(v, np.float64) for name, v in result.history.items()}
    history = History(
        steps=np.asarray(result.env_steps, np.float64),
        seconds=np.asarray(result.elapsed_s, np.float64),
        returns=curves.pop("return"),
        success=curves.pop("success"),
        best_seed=result.best_seed,
        compile_s=result.compile_s,
        train_s=result.train_s,
        env_steps_per_s=result.env_steps_per_s,
        settings=tuple(map(format_point, result.members)) if any(result.members) else (),
        others=curves,
    )
    summary: dict[str, Json] = {"model": config.model}
    summary |= training_summary(result, config.ppo, Sweep.parse(config.sweep), setup.episodes)
    return Bundle(
        contract=contract,
        weights=weights,
        history=history,
        episodes=setup.episodes,
        path=None,
        sensitivity=weakness,
        spec=policy.spec,
        graph=graph,
        references={name: _reference(policy, array) for name, array in observations.items()},
        summary=summary if weakness is None else summary | {"what breaks it": weakness.advice},
    )


# -- the contract


def contract_of(
    robot: Robot, task: TrainingTask, values: Mapping[str, float], episodes: Episodes | None = None
) -> PolicyContract:
    """Return the contract of a policy: observation, action, and the delays in its training."""
    # The range of the round trip over the episodes, and the 1 and 99 % quantiles of each node's steps [s].
    trained: dict[str, tuple[float, float]] = {}
    if episodes is not None and set(DELAYS) <= set(values):
        trips = np.append(episodes.draws.get(ROUND_TRIP, []), sum(values[n] for n in DELAYS))
        trained[ROUND_TRIP] = (float(trips.min()), float(trips.max()))
    for node, took_s in (episodes.drawn_s if episodes is not None else {}).items():
        trained[node] = (float(np.quantile(took_s, 0.01)), float(np.quantile(took_s, 0.99)))
    return PolicyContract(
        observation=robot.task.observation,
        action=tuple(
            replace(term, low=float(low), high=float(high))
            for term, low, high in zip(robot.task.action, task.action_low, task.action_high, strict=True)
        ),
        rate_hz=robot.drive.rate_hz,
        delays_s={n: v for n, v in values.items() if n.endswith("_delay")},
        trained_s=trained,
        limits=dict(robot.task.limits),
        hashes={},
    )


# -- references


def has_readings(robot: Robot, recording: Recording) -> bool:
    """Return whether a log has all readings of a robot; an imported log may lack velocities."""
    return set(named_leaves(robot.drive.at_rest)) <= set(recording.episode.outputs.get(SENSOR, {}))


def _observations(robot: Robot, recording: Recording, runner: PolicyRunner) -> np.ndarray:
    """Return the observations ``(N, O)`` that a policy would get from a recording's measurements."""
    agent: Any = robot.task.make_agent(robot.drive.rate_hz)

    # Arrange the recorded readings as the leaves of a message.
    leaves, form = jax.tree_util.tree_flatten(robot.drive.at_rest)
    columns = [recording.episode.outputs[SENSOR][name] for name in named_leaves(robot.drive.at_rest)]
    columns = [c.astype(np.float32).reshape(-1, *np.shape(leaf)) for c, leaf in zip(columns, leaves, strict=True)]

    # Let the agent make observations from them.
    params = in_numpy(agent.init_params(None, GraphState()))
    state = StepState(params=params, state=in_numpy(agent.init_state(None, GraphState(params={agent.name: params}))))
    observations, zero = [], np.zeros(1, np.float32)
    runner.reset()
    for k in range(min(_MAX_OBSERVATIONS, len(columns[0]))):
        message = jax.tree_util.tree_unflatten(form, [c[k : k + 1] for c in columns])
        state = state.replace(inputs={SENSOR: InputState(np.array([k], np.int32), zero, zero, message)})
        observations.append(np.asarray(agent.observe(state), np.float32))
        state, _ = agent.act(state, runner(observations[-1]))
    return np.array(observations)


def _reference(policy: Policy, observations: np.ndarray) -> PolicyReference:
    """Return JAX's actions for observations ``(N, O)``, treated as one episode."""
    # Compute on the CPU: an accelerator's matrix products are less precise, by 1e-3 of the range.
    policy, x = jax.device_put((policy, observations), jax.devices("cpu")[0])
    actions = jax.jit(lambda policy, x: jax.lax.scan(policy.step, policy.initial_carry(), x)[1])(policy, x)
    return PolicyReference(observations, np.asarray(actions))


# -- the summary


def training_summary(result: TrainResult, ppo: PPOConfig, sweep: Sweep, episodes: Episodes) -> dict[str, Json]:
    """Return the figures of a training for its summary and its bundle."""
    best, success = sweep.names(ppo.num_seeds)[result.best_seed], result.history["success"]
    summary: dict[str, Json] = {
        "success in simulation": f"{success.max():.2f} ({best})",
        "policy steps": int(result.env_steps[-1]) * len(result.members),
    }
    if ppo.target is not None:
        steps = f"{ppo.target:g} reached after {int(result.env_steps[-1]):,} policy steps of each seed"
        missed = f"{ppo.target:g} not reached: {success[-1].max():.2f} at the end"
        summary["target"] = missed if success[-1].max() < ppo.target else steps
    summary |= {
        "policy steps a second": round(result.env_steps_per_s),
        "compile": f"{result.compile_s:.1f} s",
        "train": f"{result.train_s:.1f} s",
        "episodes that end at a pause": f"{episodes.cut} of {episodes.timelines}",
        "timelines drawn again": episodes.again,
        **disturbance_rows(episodes),
    }
    if episodes.follow:  # a curriculum that follows success
        share, last = float(result.history["width"][-1][result.best_seed]), episodes.curriculum[1]
        late = "" if share >= last - 1e-6 else f" of {last:g}: success did not stay above {episodes.follow:g}"
        summary["share reached"] = f"{share:.2f}{late}"
    return summary


def disturbance_rows(episodes: Episodes) -> dict[str, Json]:
    """Return texts on pushes and the curriculum; empty without them."""
    rows: dict[str, Json] = {"pushes": f"{episodes.push_hz:g} a second for each joint"} if episodes.push_hz else {}
    if episodes.curriculum != (1.0, 1.0):
        first, last = episodes.curriculum
        text = f"{first:g} of these differences at the first update, "
        how = f"up to {last:g} while success is above {episodes.follow:g}"
        rows["curriculum"] = text + (how if episodes.follow else f"{last:g} at the last one")
    return rows
