"""Which parameter breaks a policy: each is moved by multiples of its uncertainty, in simulation."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.artifacts.estimation.posterior import TRANSFORMS, Posterior, from_scale
from sim2real.artifacts.identification import ROUND_TRIP, Identification
from sim2real.artifacts.sensitivity import Moved, Sensitivity
from sim2real.identify.problem.programs import Program
from sim2real.robots.control_loop.loop import DELAYS, in_a_loop
from sim2real.robots.control_loop.loop_robot import LoopRobot
from sim2real.robots.control_loop.training_task import LoopTask
from sim2real.train.config import PPOConfig
from sim2real.train.environment.graph_environment import GraphEnvironment
from sim2real.train.ppo.rollout import evaluate
from sim2real.train.ppo.teacher import seen_by

TIMELINES = 8
"""Timelines that the episodes are drawn from."""
MULTIPLES = np.array([-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0])
_EPISODES = 16
"""Episodes of each model. All models play the same ones, so that what differs is the parameter's doing."""


@dataclass(frozen=True)
class Move:
    """A parameter that is moved.

    Attributes:
        name: Its name.
        unit: Its unit.
        estimate: The value found [unit].
        half_width: Half the width of its 95 % interval [unit].
        values: Shape ``(M,)``: what it is moved to [unit].
        models: M of them: the parameters that differ from the estimates, itself among them.
    """

    name: str
    unit: str
    estimate: float
    half_width: float
    values: np.ndarray
    models: tuple[Mapping[str, float], ...]


def moves_of(found: Identification) -> list[Move]:
    """Return how each parameter of the dynamics, each delay and the sum of all delays is moved.

    The others follow: they take the values that are most likely, by the covariance of the identification, when the
    parameter is what it is moved to. Recordings often tell a combination well and its parts badly, such as the sum of
    two delays. Parts, moved alone, would break every policy, in models that no recording agrees with. A move ends where
    a parameter comes to its bound. Parameters without interval stay.
    """
    known = found.posterior
    if known is None:
        return []
    moves = []
    for p in found.parameters:
        along = np.isin(known.names, DELAYS if p.name == ROUND_TRIP else [p.name]).astype(float)
        if p.low95 is None or p.high95 is None or p.kind == "measurement" or not along.any():
            continue
        if (half := (p.high95 - p.low95) / 2) <= 0.0:
            continue
        models = tuple(_followed(known, along, p.estimate, float(multiple * half)) for multiple in MULTIPLES)
        values = np.array([sum(v for v, one in zip(m.values(), along, strict=True) if one) for m in models])
        moves.append(Move(p.name, p.unit, p.estimate, half, values, models))
    return moves


def _followed(known: Posterior, along: np.ndarray, estimate: float, by: float) -> dict[str, float]:
    """Return the likeliest parameters where one of them, or the sum of several, has moved.

    Args:
        along: Shape ``(P,)``: 1 for what is moved, several for their sum, then on a linear scale; else 0.
        estimate: The value that is moved [its unit].
        by: How far [its unit].
    """
    moved = np.flatnonzero(along)
    kind = known.transform[moved[0]]
    low, high = (sum(float(from_scale(kind, bound[i])) for i in moved) for bound in (known.low, known.high))
    to_scale = TRANSFORMS[kind][0]
    step = to_scale(np.clip(estimate + by, low, high)) - to_scale(estimate)
    spread = known.covariance @ along
    variance = float(along @ spread)
    shift = (spread / variance if variance > 0.0 else along) * step
    room = np.where(shift > 0, known.high, known.low) - known.mean
    share = np.min(np.divide(room, shift, out=np.ones_like(shift), where=shift != 0.0), initial=1.0)
    x = np.clip(known.mean + max(share, 0.0) * shift, known.low, known.high)
    return {n: float(from_scale(t, v)) for n, t, v in zip(known.names, known.transform, x, strict=True)}


def models_of(values: Mapping[str, float], moves: Sequence[Move]) -> list[dict[str, float]]:
    """Return the parameters of each model: as identified, then each move at each of its values."""
    models = ({n: v for n, v in model.items() if n in values} for m in moves for model in m.models)
    return [dict(values), *({**values, **model} for model in models)]


def with_room(robot: LoopRobot, models: Sequence[Mapping[str, float]]) -> LoopRobot:
    """Return a robot whose graph has room for the delays of all models.

    Args:
        models: Parameters by name; the first model is the one that the graph is made of.
    """
    if not set(DELAYS) <= set(models[0]):
        return robot
    wide = copy.copy(robot)
    wide.delay_spread_s = max(robot.delay_spread_s, *(abs(_round_trip(m) - _round_trip(models[0])) for m in models))
    return wide


def _round_trip(values: Mapping[str, float]) -> float:
    return sum(values[name] for name in DELAYS)


def _in_one_loop(robot: LoopRobot, models: Sequence[Mapping[str, float]]) -> list[dict[str, float]]:
    """Return the models as one graph can play them: the actuator's delay stays, and the sensor's has what is moved.

    Only the sum of both affects what a policy sees of its commands; see ``in_a_loop``.
    """
    base = in_a_loop(models[0], robot.tick_s, robot.delay_spread_s)
    if not set(DELAYS) <= set(base):
        return [dict(m) for m in models]
    sensor, actuator = DELAYS
    total = _round_trip(models[0])
    return [{**m, sensor: base[sensor] + _round_trip(m) - total, actuator: base[actuator]} for m in models]


def sensitivity(
    robot: LoopRobot,
    env: GraphEnvironment,
    policy: Any,
    moves: Sequence[Move],
    models: Sequence[Mapping[str, float]],
    seed: int,
) -> Sensitivity:
    """Play a policy on every model, all in one program.

    Args:
        env: Its graph with room for all models, see ``with_room``.
        moves: The parameters that are moved.
        models: What ``models_of`` returned for them.
    """
    loops = _in_one_loop(robot, models)
    columns = {name: jnp.asarray([m[name] for m in loops], jnp.float32) for name in loops[0]}
    rows = env.length + 1
    config = PPOConfig(num_envs=_EPISODES, minibatches=1, rollout_steps=rows, eval_steps=rows)
    key = jax.random.key(seed)

    def play(values: dict[str, jax.Array]) -> jax.Array:
        game = seen_by(policy, GraphEnvironment(env.graph, moved_task(env.task, values)))
        return evaluate(game, config, policy, key)["success"]

    found = np.asarray(Program(jax.vmap(play))(columns), np.float64)
    success = found[1:].reshape(len(moves), len(MULTIPLES))
    told = [Moved(m.name, m.unit, m.estimate, m.half_width, m.values, s) for m, s in zip(moves, success, strict=True)]
    return Sensitivity.of(MULTIPLES, float(found[0]), _EPISODES, told)


def moved_task(task: Any, values: Mapping[str, Any]) -> LoopTask:
    """Return a task whose episodes all have the same parameters, traced ones too."""
    moved = copy.copy(task)
    moved.values, moved.draws = dict(values), {}
    return moved
