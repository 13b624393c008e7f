"""Weighs the load of a robot on its feet by the torques of its joints.

In slow motion each posture is a static balance. With the feet in place the base has six free directions; along each of
them the work of the joints' torques equals the work against gravity, and the forces on the feet do no work. So the load
in the base follows from linear equations, without the forces on the feet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from sim2real.artifacts.identification import Estimate, Identification
from sim2real.artifacts.posterior import Posterior, from_scale
from sim2real.errors import OtherMotion, UsageError
from sim2real.graph.episode import Episode
from sim2real.robots.loop import ACTUATOR, DELAYS, SENSOR
from sim2real.robots.walking.drive import gravity_of
from sim2real.robots.walking.robot import ComposedRobot
from sim2real.robots.walking.world import MOTOR_STRENGTH, PAYLOAD
from sim2real.types import MjData, MjModel

_mj: Any = mujoco
_SETTLED_S, _BEND_S = 0.5, 3.0
"""Length of the first part of a log that is not used, as gains change there; and shortest motion after it: over one
bend down and up again, errors of delays and accelerations cancel [s].
"""
_UPRIGHT, _FREE = -0.95, 6
"""Largest z component of gravity's direction in the base, and number of directions in which the base moves."""
_MOVING_RAD_S, _FAST_RAD_S = 0.03, 0.6
"""Speed at which friction has 3/4 of its size, as its direction at rest is unknown; and a speed above all bending legs
[rad/s].
"""
_SMOOTHED, _BLOCKS, _MOST_SAMPLES, _STEP = 5, 8, 600, 1e-4
"""Number of samples of a mean speed; parts of a log that are weighed alone; used samples of a log; step of a
derivative.
"""
_WIDER = 2.365 / 1.96
"""Factor on a standard error from 8 parts, to allow for their small number (Student's distribution)."""


@dataclass(frozen=True)
class Balances:
    """Static balances of a log: the load is ``sum(rest - share . torque) / sum(size)``.

    Attributes:
        law, speed, direction: Shape ``(K, joints)``: commanded torque of the motors [N m], speed [rad/s], and direction
            of the motion, between -1 and 1.
        share: Shape ``(K, joints)``: weight of each joint's torque.
        rest, size: Shape ``(K,)``: the weighted sum of torques that carries the robot itself, and the sum for 1 kg of
            load.
    """

    law: np.ndarray
    speed: np.ndarray
    direction: np.ndarray
    share: np.ndarray
    rest: np.ndarray
    size: np.ndarray

    def load(self, robot: ComposedRobot, values: Mapping[str, float], part: slice = slice(None)) -> float:
        """Return the load that agrees best with some of the balances [kg]."""
        joints = robot.model.joints
        damping, friction = (joints.of_group(values, name) for name in ("damping", "friction"))
        torque = joints.of_motor(values, MOTOR_STRENGTH) * self.law - damping * self.speed - friction * self.direction
        return float((self.rest - (self.share * torque).sum(axis=1))[part].sum() / self.size[part].sum())


def weighed(
    robot: object, identification: Identification, episode: Episode, truth: Mapping[str, float]
) -> Identification:
    """Return an identification with the load, from a log of the robot on its feet.

    Args:
        truth: True parameters of the embedded robot.

    Raises:
        OtherMotion: The load, with its interval, is outside of its bounds.
    """
    if identification.posterior is None or not isinstance(robot, ComposedRobot):
        return identification
    values, balances = identification.values, balances_of(robot, episode, identification.values)
    load = balances.load(robot, values)
    row = next(p for p in robot.model.parameters_without_joint() if p.name == PAYLOAD)
    # The spread of parts of the log is the error of the balances; the posterior adds that of the other parameters.
    edges = np.linspace(0, len(balances.size), _BLOCKS + 1).astype(int)
    parts = [balances.load(robot, values, slice(a, b)) for a, b in pairwise(edges)]
    scatter = _WIDER * float(np.std(parts, ddof=1)) / np.sqrt(_BLOCKS)
    load_of = lambda some: balances.load(robot, {**values, **some})  # noqa: E731
    posterior = _with_load(identification.posterior, load_of, scatter, (row.low, row.high))
    deviation = float(np.sqrt(posterior.covariance[-1, -1]))
    # If the load is outside of its bounds by less than its error, put it on the bound.
    require_load(load, row.low, row.high, 1.96 * deviation)
    load, left, right = np.clip(load + 1.96 * deviation * np.array([0.0, -1.0, 1.0]), row.low, row.high).tolist()
    known = row.unit, "dynamics", row.about, row.nominal, load, "ok", deviation, left, right, row.low, row.high
    estimate = Estimate(PAYLOAD, *known, truth.get(PAYLOAD))
    return replace(identification, parameters=(*identification.parameters, estimate), posterior=posterior)


def check(robot: object, episode: Episode, nominal: Mapping[str, float]) -> None:
    """Refuse a log of a robot that does not stand on its feet, before a fit.

    Args:
        nominal: Nominal values of the parameters; with them the load may be wrong by half of the robot's mass.
    """
    if not isinstance(robot, ComposedRobot):
        raise UsageError("this robot does not stand on legs", hint="leave --standing out")
    mass_kg = float(_mj.MjModel.from_xml_path(str(robot.mjcf)).body_mass.sum())
    require_load(balances_of(robot, episode, nominal).load(robot, nominal), -0.5 * mass_kg, 0.5 * mass_kg)


def require_load(load: float, low: float, high: float, error: float = 0.0) -> None:
    """Refuse a load that is outside of its bounds by more than its error [kg]."""
    if not low - error <= load <= high + error:
        raise OtherMotion(
            f"in the log of standing the joints carry {load:+.3g} kg beside the robot's own weight, outside of "
            f"{low:.3g} to {high:.3g} kg",
            hint="record the robot on its feet, not in a stand: `record --excitation standing`",
        )


def balances_of(robot: ComposedRobot, episode: Episode, values: Mapping[str, float]) -> Balances:
    """Return the balances of a log; refuse a log in which the robot is not upright, or hardly moves."""
    sensed, sent = episode.outputs[SENSOR], episode.outputs[ACTUATOR]
    t_s, position = episode.steps[SENSOR].begun_s, sensed["position"].astype(np.float64)
    smooth = np.ones(_SMOOTHED) / _SMOOTHED
    speed = np.stack([np.convolve(v, smooth, "same") for v in sensed["velocity"].T.astype(np.float64)], axis=1)
    upright = np.array([gravity_of(q.astype(np.float64))[2] for q in sensed["quaternion"]])
    used = np.flatnonzero(t_s > t_s[0] + _SETTLED_S)[: -(_SMOOTHED // 2)]  # the last mean speeds have fewer samples
    if upright[used].max(initial=-1.0) > _UPRIGHT:
        raise OtherMotion("the robot does not stand upright in this log", hint="record it with --excitation standing")
    fastest = np.abs(speed[used]).max(axis=1)
    moving = (fastest > _MOVING_RAD_S) & (fastest < _FAST_RAD_S)
    if moving.sum() < max(0.5 * len(used), _BEND_S * robot.drive.rate_hz):
        slow_s = moving.sum() / robot.drive.rate_hz
        raise OtherMotion(
            f"the legs move slowly for {slow_s:.1f} s of this log, too short to weigh the robot",
            hint="record it on its feet with --excitation standing, which bends the legs",
        )
    used = used[moving][:: max(1, int(moving.sum()) // _MOST_SAMPLES)]
    # The command in effect when the state was sampled.
    acts_s = 1e-6 * episode.steps[ACTUATOR].end + values[DELAYS[1]]
    row = np.clip(np.searchsorted(acts_s, t_s[used] - values[DELAYS[0]], "right") - 1, 0, None)
    q, dq, kp, kd, tau = (sent[name].astype(np.float64)[row] for name in ("q", "dq", "kp", "kd", "tau"))
    law = tau + kp * (q - position[used]) + kd * (dq - sensed["velocity"][used])
    zero = robot.model.joints.of_motor(values, "zero")
    model = _mj.MjModel.from_xml_path(str(robot.mjcf))
    data = _mj.MjData(model)
    rows = [_balance(model, data, robot.feet, sensed["quaternion"][i], position[i] - zero) for i in used]
    share, rest, size = (np.array(column) for column in zip(*rows, strict=True))
    return Balances(law, speed[used], np.tanh(speed[used] / _MOVING_RAD_S), share, rest, size)


def _balance(
    model: MjModel, data: MjData, feet: Sequence[str], quaternion: np.ndarray, joints: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Return the share of each joint's torque, the rest and the size of the balance in a posture; see ``Balances``."""
    data.qpos[3:7], data.qpos[7:] = quaternion, joints
    _mj.mj_forward(model, data)
    # The motions that leave the feet in place: a basis, as columns.
    held, base = np.zeros((3 * len(feet), model.nv)), int(model.jnt_bodyid[0])
    for i, foot in enumerate(feet):
        _mj.mj_jacSite(model, data, held[3 * i : 3 * i + 3], None, model.site(foot).id)
    free = np.linalg.svd(held)[2][-_FREE:].T
    # The work along them against gravity and against 1 kg of load; all torques have equal errors.
    lifts = np.zeros((3, model.nv))
    _mj.mj_jac(model, data, lifts, None, data.xpos[base], base)
    per_kg, driven = free.T @ (lifts.T @ model.opt.gravity), free[-model.nu :]
    weights = per_kg @ np.linalg.inv(driven.T @ driven)
    return driven @ weights, float(weights @ free.T @ data.qfrc_bias), float(weights @ per_kg)


def _with_load(
    posterior: Posterior, load_of: Callable[[Mapping[str, float]], float], scatter: float, ends: tuple[float, float]
) -> Posterior:
    """Return the posterior with the load, which is correlated with the parameters from which it follows.

    Args:
        load_of: Parameters -> load [kg].
        scatter: Error of the balances [kg].
        ends: Bounds of the load [kg].
    """

    def load_at(x: np.ndarray) -> float:
        values = {n: float(from_scale(t, v)) for n, t, v in zip(posterior.names, posterior.transform, x, strict=True)}
        return load_of(values)

    load, covariance = load_at(posterior.mean), posterior.covariance
    slope = np.array([load_at(posterior.mean + step) - load for step in _STEP * np.eye(len(posterior.mean))]) / _STEP
    cross = covariance @ slope
    return replace(
        posterior,
        names=(*posterior.names, PAYLOAD),
        transform=(*posterior.transform, "linear"),
        mean=np.append(posterior.mean, np.clip(load, *ends)),
        covariance=np.block([[covariance, cross[:, None]], [cross[None], slope @ cross + scatter**2]]),
        lower=np.append(posterior.lower, ends[0]),
        upper=np.append(posterior.upper, ends[1]),
    )
