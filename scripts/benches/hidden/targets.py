"""Tasks of an arm in which dynamics and delays matter: follow a moving target, and arrive at one soon and stay there.

Both move the goals as fast as the servos can follow: at the speed of a reaching task, the goals' limit hides the rest.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from sim2real.arrays import namespace
from sim2real.later import jax, jnp
from sim2real.robots.messages import JointReading
from sim2real.robots.servo.servos import Servos
from sim2real.robots.servo.task import Aim, AimTask, Feature, ServoMoment, uniform
from sim2real.types import Array, Key, Scalar

FIGURE_HZ, FIGURE_M = 0.7, (0.05, 0.025)
"""Figures of eight in a second; how far they reach to either side, and up and down [m]."""
AHEAD_S = 0.1
"""How far ahead a policy sees a moving target [s]."""
CLOSE_M = 0.01
"""How near the tip must be to its target [m]."""
SETTLED_S = 1.0
"""Time in which the tip comes to the figure, which does not count [s]."""
FAST_RAD_S = {"arm": 5.0, "so101": 4.0}
"""Largest speed of the goals, where time counts [rad/s]: that of the profile, and near that of a servo without load."""
CENTRES = {
    "arm": ((-0.5, 0.3, 1.0), (0.5, 0.6, 1.3)),
    "so101": ((-0.5, -1.1, 0.8, -1.4, 0.0, 0.0), (0.5, -0.7, 1.1, -1.2, 0.0, 0.0)),
}
"""Joint angles between which the centres of figures are drawn [rad]: all points of a figure must be within reach."""
STILL = {"arm": (), "so101": (4, 5)}
"""Joints that do not move the tip, and shall stay at 0."""
_TARGET = tuple((f"target {axis}", "m") for axis in "xyz")
_AHEAD = tuple((f"target {axis}, {AHEAD_S:g} s ahead", "m") for axis in "xyz")
_AXES = "outwards, sideways, up"


def figure_of_eight(numbers: Array, t_s: Scalar) -> Array:
    """Return a point ``(3,)`` on a figure of eight that stands upright, and faces the z axis [m].

    Args:
        numbers: Its centre [m], and its phase at time 0 [rad], ``(4,)``.
    """
    xp = namespace(numbers, t_s)
    turn = 2.0 * np.pi * FIGURE_HZ * t_s + numbers[3]
    sideways = FIGURE_M[0] * xp.sin(turn) / xp.sqrt(numbers[0] ** 2 + numbers[1] ** 2)
    up = FIGURE_M[1] * xp.sin(2.0 * turn)
    return xp.stack([numbers[0] - sideways * numbers[1], numbers[1] + sideways * numbers[0], numbers[2] + up])


def tasked(robot: Any, task: str) -> Any:
    """Return an arm with the task ``follow``, the tip on a figure of eight, or ``fast``, the tip soon at a target."""
    from sim2real.stages.load import load_module

    module, name = load_module(robot.name, "robot"), robot.name
    servos = replace(robot.drive.servos, speed=FAST_RAD_S[name])
    ends = (module.LOW, module.HIGH), CENTRES[name]
    changed = copy.copy(robot)
    changed.task = target_tasks(servos, module.tip_of, module.way, *ends, robot.drive.rate_hz, STILL[name])[task]
    return changed


def target_tasks(
    servos: Servos,
    tip_of: Callable[[Array], Array],
    way: Callable[[Array, Array], Array],
    targets: tuple[tuple[float, ...], tuple[float, ...]],
    centres: tuple[tuple[float, ...], tuple[float, ...]],
    rate_hz: float,
    still: tuple[int, ...],
) -> dict[str, AimTask]:
    """Return the tasks ``follow``, the tip on a figure of eight, and ``fast``, the tip soon at a target.

    Args:
        servos: The servos, whose ``speed`` is the largest speed of the goals.
        tip_of: Returns where the tip is ``(3,)`` [m] for joint angles ``(joints,)`` [rad].
        way: Returns a distance ``(3,)`` [m] in the arm's axes for the joint angles: outwards, sideways, up.
        targets: Lowest and highest joint angles of which targets are drawn [rad].
        centres: The same for the centres of figures: all of their points must be within reach.
        rate_hz: Rate of the policy [Hz].
        still: Joints that do not move the tip, and shall stay at 0.
    """

    def figure(key: Key | int) -> Array:
        drawn = uniform(key, (*centres[0], 0.0), (*centres[1], 2.0 * np.pi))
        return namespace(drawn).append(tip_of(drawn[:-1]), drawn[-1])

    def seen(numbers: Array, t_s: Scalar) -> Array:
        points = [figure_of_eight(numbers, t_s), figure_of_eight(numbers, t_s + AHEAD_S)]
        return namespace(numbers, t_s).concatenate(points)

    def observe(reading: JointReading, goal: Array, aim: Array) -> Array:
        q, xp = reading.position, namespace(reading.position, goal, aim)
        tip = tip_of(q)
        ways = [10.0 * way(q, aim[i : i + 3] - tip) for i in range(0, len(aim), 3)]
        return xp.concatenate([q, reading.velocity / 5.0, goal - q, *ways])

    def distance_m(now: ServoMoment) -> jax.Array:
        # The square root has no derivative at 0.
        return jnp.sqrt(jnp.sum((tip_of(now.position) - now.aim[:3]) ** 2) + 1e-12)

    def reward(now: ServoMoment) -> jax.Array:
        distance = distance_m(now)
        near = sum(jnp.exp(-((distance / size) ** 2)) for size in (0.1, 0.03, CLOSE_M))
        return near - 2.0 * distance - 0.1 * jnp.sum(jnp.abs(now.position[np.array(still, int)]))

    def success(now: ServoMoment) -> jax.Array:
        return distance_m(now) < CLOSE_M

    def tracked(t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        since_s, distance = t_s - t_s[0], _distance_m(t_s, states, tip_of, rate_hz, len(servos.joints))
        later = distance[since_s >= min(SETTLED_S, since_s[-1] / 2)]
        return {"success": float((later < CLOSE_M).mean()), "error_m": float(later.mean())}

    def arrived(t_s: np.ndarray, states: Mapping[str, np.ndarray]) -> dict[str, float]:
        return arrival(t_s, _distance_m(t_s, states, tip_of, rate_hz, len(servos.joints)))

    n = len(servos.joints)
    features: tuple[Feature, ...] = (
        ("position", ("rad",) * n, 5.0),
        ("velocity / 5", ("rad/s",) * n, 6.0),
        ("goal less position", ("rad",) * n, 6.0),
        (f"10 x target less tip: {_AXES}", ("m",) * 3, 10.0),
    )
    ahead: Feature = (f"10 x target {AHEAD_S:g} s ahead less tip: {_AXES}", ("m",) * 3, 10.0)
    moving = Aim((*_TARGET, *_AHEAD), figure, seen)
    resting = Aim(_TARGET, lambda key: tip_of(uniform(key, *targets)))
    return {
        "follow": AimTask(servos, moving, reward, success, tracked, (*features, ahead), observe),
        "fast": AimTask(servos, resting, reward, success, arrived, features, observe),
    }


def arrival(t_s: np.ndarray, distance_m: np.ndarray) -> dict[str, float]:
    """Return when a tip arrived within 1 cm of its target for good, and how far it overshot.

    ``settled_s`` counts to the last time at which it was farther away, so a tip that passes by has not arrived; it is
    the whole time if it never stays. ``overshoot_m`` is its largest distance after it first came within 1 cm.

    Args:
        t_s: Times ``(N,)`` [s].
        distance_m: Distances ``(N,)`` [m].
    """
    away, there = np.flatnonzero(distance_m >= CLOSE_M), np.flatnonzero(distance_m < CLOSE_M)
    last = int(away[-1]) if away.size else 0
    settled = last < len(t_s) - 1
    return {
        "success": float(settled),
        "settled_s": float(t_s[min(last + 1, len(t_s) - 1)] - t_s[0]) if away.size else 0.0,
        "overshoot_m": float(distance_m[there[0] :].max()) if there.size else float("nan"),
        "distance_m": float(distance_m[t_s >= t_s[-1] - 0.5].mean()),
    }


def _distance_m(
    t_s: np.ndarray, states: Mapping[str, np.ndarray], tip_of: Callable[[Array], Array], rate_hz: float, joints: int
) -> np.ndarray:
    """Return the distances of the tip from the target ``(N,)`` [m]; aims are those of the policy's steps."""
    position = np.stack([states[f"position[{i}]"] for i in range(joints)], axis=-1)
    steps_s = np.arange(len(states["aim[0]"])) / rate_hz
    aim = np.stack([np.interp(t_s - t_s[0], steps_s, states[f"aim[{i}]"]) for i in range(3)], axis=-1)
    return np.linalg.norm(tip_of(position) - aim, axis=-1)
