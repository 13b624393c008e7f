"""Sensitivity of a policy: its success in simulation with each parameter moved by multiples of its uncertainty."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.posterior import TRANSFORMS, Posterior, from_scale
from sim2real.artifacts.sensitivity import Moved, Sensitivity
from sim2real.artifacts.timing import Timing
from sim2real.identification.rollouts import jitted
from sim2real.robots.loop import DELAY_SPREAD_S, DELAYS, split_delay
from sim2real.robots.robot import Robot
from sim2real.robots.training import LoopTask
from sim2real.stages.train.config import TrainConfig
from sim2real.stages.train.setup import prepare
from sim2real.training.config import PPOConfig
from sim2real.training.environment.graph_environment import GraphEnvironment
from sim2real.training.networks.policy import Policy
from sim2real.training.ppo.rollout import evaluate

TIMELINES = 8
"""Number of timelines from which episodes are drawn."""
MULTIPLES = np.array([-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0])
_EPISODES = 16
"""Number of episodes of each model. All models play the same episodes, so differences come from the parameter."""


def policy_sensitivity(
    robot: Robot,
    config: TrainConfig,
    identification: Identification | None,
    timing: Timing | None,
    policy: Policy,
) -> Sensitivity | None:
    """Return the success of the policy with each parameter moved; None without intervals of the parameters."""
    if config.model == "nominal" or identification is None:
        return None
    moves = moves_of(identification)
    models = models_of(identification.values, moves)
    spread_s = room_s(models)
    setup = prepare(robot, replace(config, timelines=TIMELINES), identification, timing, spread_s=spread_s)
    return sensitivity(setup.env, policy, moves, fitted_to_graph(models, robot.model.tick_s, spread_s), config.seed)


@dataclass(frozen=True)
class Move:
    """Moves of one parameter.

    Attributes:
        half_width: Half the width of its 95 % interval [unit].
        values: Shape ``(M,)``: the values to which it is moved [unit].
        models: For each value, all parameters that then differ from the estimates.
    """

    name: str
    unit: str
    estimate: float
    half_width: float
    values: np.ndarray
    models: tuple[Mapping[str, float], ...]


def moves_of(identification: Identification) -> list[Move]:
    """Return the moves of each parameter of the dynamics, each delay and the sum of all delays.

    The other parameters take their most likely values given the moved one, by the covariance of the identification. A
    recording often determines a combination well, such as the sum of two delays, and its parts badly: a part that moved
    alone would contradict the recording and break every policy. A move ends at a parameter's bound. Parameters without
    an interval do not move.
    """
    if (posterior := identification.posterior) is None:
        return []
    moves = []
    for p in identification.parameters:
        if p.low95 is None or p.high95 is None or p.kind == "measurement" or p.name not in posterior.names:
            continue
        if (half := (p.high95 - p.low95) / 2) <= 0.0:
            continue
        models = tuple(_most_likely(posterior, p.name, p.estimate, float(multiple * half)) for multiple in MULTIPLES)
        values = np.array([model[p.name] for model in models])
        name = ROUND_TRIP if p.name in DELAYS else p.name  # the other delay is fixed
        moves.append(Move(name, p.unit, p.estimate, half, values, models))
    return moves


def _most_likely(posterior: Posterior, name: str, estimate: float, by: float) -> dict[str, float]:
    """Return the most likely parameters, given that one has moved from its estimate by ``by`` [its unit]."""
    # The move on the scale of the posterior, within the bounds.
    moved = posterior.names.index(name)
    kind = posterior.transform[moved]
    low, high = (float(from_scale(kind, bound[moved])) for bound in (posterior.lower, posterior.upper))
    to_scale = TRANSFORMS[kind][0]
    step = to_scale(np.clip(estimate + by, low, high)) - to_scale(estimate)

    # The others follow by regression on the moved one; all stop when the first one reaches its bound.
    spread = posterior.covariance[moved]
    shift = step * (spread / spread[moved] if spread[moved] > 0.0 else np.eye(len(spread))[moved])
    room = np.where(shift > 0, posterior.upper, posterior.lower) - posterior.mean
    share = np.min(np.divide(room, shift, out=np.ones_like(shift), where=shift != 0.0), initial=1.0)
    x = np.clip(posterior.mean + max(share, 0.0) * shift, posterior.lower, posterior.upper)
    return {n: float(from_scale(t, v)) for n, t, v in zip(posterior.names, posterior.transform, x, strict=True)}


def models_of(values: Mapping[str, float], moves: Sequence[Move]) -> list[dict[str, float]]:
    """Return the parameters of each model: the estimates, then each move at each of its values."""
    models = ({n: v for n, v in model.items() if n in values} for m in moves for model in m.models)
    return [dict(values), *({**values, **model} for model in models)]


def _round_trip(values: Mapping[str, float]) -> float:
    return sum(values[name] for name in DELAYS)


def room_s(models: Sequence[Mapping[str, float]]) -> float:
    """Return the largest deviation of a model's delay from the first model's [s], for which windows need room."""
    if not set(DELAYS) <= set(models[0]):
        return DELAY_SPREAD_S
    return max(DELAY_SPREAD_S, *(abs(_round_trip(m) - _round_trip(models[0])) for m in models))


def fitted_to_graph(models: Sequence[Mapping[str, float]], tick_s: float, spread_s: float) -> list[dict[str, float]]:
    """Return the models with the first model's actuator delay; the sensor's delay takes the whole difference.

    A policy notices only the sum of both delays; see ``split_delay``.
    """
    base = split_delay(models[0], tick_s, spread_s)
    if not set(DELAYS) <= set(base):
        return [dict(m) for m in models]
    sensor, actuator = DELAYS
    total = _round_trip(models[0])
    return [{**m, sensor: base[sensor] + _round_trip(m) - total, actuator: base[actuator]} for m in models]


def sensitivity(
    env: GraphEnvironment,
    policy: Policy,
    moves: Sequence[Move],
    models: Sequence[Mapping[str, float]],
    seed: int,
) -> Sensitivity:
    """Play a policy on every model, all in one program.

    Args:
        env: Environment with room for the delays of all models.
    """
    columns = {name: jnp.asarray([m[name] for m in models], jnp.float32) for name in models[0]}

    # Each copy plays one episode, so a rollout is as long as an episode.
    rows = env.length + 1
    config = PPOConfig(num_envs=_EPISODES, minibatches=1, rollout_steps=rows, eval_steps=rows)
    key, task = jax.random.key(seed), cast(LoopTask, env.task)

    def play(values: dict[str, jax.Array]) -> jax.Array:
        environment = GraphEnvironment(env.graph, task.with_data((values, {})))
        return evaluate(environment, config, policy, key)["success"]

    # The first model has the estimates; the models of the moves follow, in order.
    success = np.asarray(jitted(jax.vmap(play))(columns), np.float64)
    by_move = zip(moves, success[1:].reshape(len(moves), len(MULTIPLES)), strict=True)
    moved = [Moved(m.name, m.unit, m.estimate, m.half_width, m.values, s) for m, s in by_move]
    return Sensitivity.of(MULTIPLES, float(success[0]), _EPISODES, moved)
