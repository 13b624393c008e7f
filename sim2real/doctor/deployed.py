"""Computes the observations and targets of a deployment from measurements and actions, with or without faults.

The faults are a ``Setting``: names of differences from the contract:

- a kind of a term, ``action_scale``: additional factor to the contract's scale
- ``degrees KIND``: whether the joints' angles or rates are in degrees, before the default pose is subtracted
- ``order SIDE``: entry i of the policy is joint ``order[i]`` of the contract; sides: ``seen``, ``moved``
- ``signs SIDE``, ``turned SIDE``: signs of the entries: of the angle minus the default pose; of the angle itself
- ``pose SIDE``: error of the default pose [rad]
- ``frame KIND``: a key of ``FRAMES``, or the signed axes of a vector, such as ``(2, 1, -3)``
- ``late``: additional age of the measurements [s]
- ``stale``: steps by which a whole observation is older
- ``frozen``: share of the log after which gyro and gravity in the observation stay constant
- ``stuck``: (joint, share of the log): after it, a joint in the observation stays constant
- ``history``: ``reversed``; ``layout``: ordered by step instead of by term, or the reverse; ``newest``: the newest step
  everywhere
- ``terms``: term i of the observation is term ``terms[i]`` of the contract
- ``last_action is``: ``older``: the action of the step before; ``target``: the action after scale and pose
- ``clipped``: whether actions end at the logged range
- ``normalised``: number of times that the normaliser is applied
- ``gain``, ``bias``: gain and bias of each entry of the observation, as by another normaliser
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from sim2real.doctor.contract import Policy
from sim2real.doctor.log import Log
from sim2real.doctor.search import Setting

_ROWS = 300
_turned = lambda turn, v: np.einsum("nij,nj->ni", turn, v)  # noqa: E731
_back = lambda turn, v: np.einsum("nji,nj->ni", turn, v)  # noqa: E731
FRAMES: dict[str, tuple[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]] = {
    "world": ("in the world's frame instead of the body's", lambda quat, v: _turned(matrices(quat), v)),
    "twice": ("rotated into the body twice", lambda quat, v: _back(matrices(quat), v)),
    "conjugate": ("rotated the wrong way", lambda quat, v: _turned(matrices(quat), _turned(matrices(quat), v))),
    "w last": ("made of a quaternion w, x, y, z that is read as x, y, z, w",
               lambda quat, v: _back(matrices(np.roll(quat, 1, 1)), _turned(matrices(quat), v))),
    "w first": ("made of a quaternion x, y, z, w that is read as w, x, y, z",
                lambda quat, v: _back(matrices(np.roll(quat, -1, 1)), _turned(matrices(quat), v))),
}  # fmt: skip
"""Wrong frame -> description, and function of quaternions and vectors in the body that gives the wrong vector."""


class Deployed:
    """A log with its policy: computes observations, actions and targets, with or without faults."""

    def __init__(self, log: Log, policy: Policy) -> None:
        self.log, self.policy, self.contract = log, policy, policy.contract
        c = self.contract
        self._pose, self._scale = c.per_joint("default_joint_pos"), c.per_joint("action_scale")
        self._resting = self._pose if c.drive == "position" else np.zeros_like(self._pose)  # the target of action 0
        self._states: dict[float, dict[str, np.ndarray]] = {}
        self.history = max(term.history for term in c.observation)
        first = min(max(self.history + 1, len(log.t) // 10), len(log.t) // 2)
        self.rows = np.unique(np.linspace(first, len(log.t) - 1, _ROWS).astype(int))
        widths = {kind: values.shape[1] for kind, values in self.quantities(Setting()).items()}
        fitting = [term for term in c.observation if widths.get(term.kind) == c.size_of(term)]
        self.made = {term.kind for term in fitting}
        self.unread = [term.term for term in c.observation if term not in fitting]

    def _state(self, late_s: float) -> dict[str, np.ndarray]:
        if late_s not in self._states:
            names = [n for n in ("q", "dq", "quat", "gyro", "lin_vel") if getattr(self.log, n) is not None]
            self._states[late_s] = {n: self.log.at_steps(n, late_s) for n in names}
        return self._states[late_s]

    def quantities(self, how: Setting) -> dict[str, np.ndarray]:
        """Return for each kind its newest entries at each step ``(N, size)``, before the contract's scale."""
        state, count = self._state(how.get("late", 0.0)), len(self.log.t)
        if "frozen" in how:
            held = np.minimum(np.arange(count), int(how.get("frozen") * count))
            state = state | {k: state[k][held] for k in ("quat", "gyro") if k in state}
        if "stuck" in how:
            joint, share = how.get("stuck")
            state = state | {k: state[k].copy() for k in ("q", "dq")}
            for k in ("q", "dq"):
                state[k][int(share * count) :, joint] = state[k][int(share * count), joint]
        pose = self._pose * any(t.relative for t in self.contract.observation if t.kind == "joint_pos")
        angles = np.degrees if how.get("degrees joint_pos", False) else np.asarray
        rates = np.degrees if how.get("degrees joint_vel", False) else np.asarray
        bare = _taken(how, "seen", state["q"], 0.0 * pose)
        made = {"joint_pos": _taken(how, "seen", angles(state["q"]), pose + np.array(how.get("pose seen", 0.0))),
                "joint_vel": _taken(how, "seen", rates(state["dq"]), 0.0 * pose),
                "sin_joint_pos": np.sin(bare), "cos_joint_pos": np.cos(bare)}  # fmt: skip
        made |= {kind: state[n] for kind, n in (("ang_vel", "gyro"), ("lin_vel", "lin_vel")) if n in state}
        if "quat" in state:
            made["gravity"] = -matrices(state["quat"])[:, 2, :]
        if self.log.command is not None:
            made["command"] = self.log.command
        if (action := self.actions(how)) is not None:
            ago = 2 if how.get("last_action is", "") == "older" else 1
            last = self.targets(how, action) if how.get("last_action is", "") == "target" else action
            made["last_action"] = np.concatenate([np.zeros((ago, action.shape[1])), last[:-ago]])
        for kind in ("ang_vel", "gravity", "lin_vel"):
            if f"frame {kind}" in how and kind in made:
                made[kind] = in_frame(how.get(f"frame {kind}"), state.get("quat"), made[kind])
        return {kind: values * how.get(kind) for kind, values in made.items()}

    def actions(self, how: Setting) -> np.ndarray | None:
        """Return the network's actions ``(N, A)``: as logged, or computed back from the targets."""
        if self.log.action is not None or self.log.target is None:
            return self.log.action
        rest = self._resting + np.array(how.get("pose moved", 0.0))
        return _taken(how, "moved", self.log.target, rest) / (self._scale * how.get("action_scale"))

    def targets(self, how: Setting, action: np.ndarray) -> np.ndarray:
        """Return the targets ``(N, J)`` for actions ``(N, A)``."""
        signs, turned = np.array(how.get("signs moved")), np.array(how.get("turned moved"))
        rest = self._resting + np.array(how.get("pose moved", 0.0))
        placed = np.empty_like(action)
        order = list(how.get("order moved", ())) or slice(None)
        placed[:, order] = action * self._scale * how.get("action_scale") * signs * turned + rest * turned
        return placed

    def observations(self, how: Setting, rows: np.ndarray) -> np.ndarray:
        """Return the observations ``(R, O)`` at some steps, before the normaliser."""
        c, made, parts = self.contract, self.quantities(how), []
        order, history = how.get("terms", ()), how.get("history", "")
        if order or history == "layout":
            other = {"term": "step", "step": "term"}[c.history_layout] if history == "layout" else c.history_layout
            terms = tuple(c.observation[i] for i in order) or c.observation
            c = msgspec.structs.replace(c, observation=terms, history_layout=other)
        for term, lag in c.layout:
            own = c.observation[term]
            back = {"reversed": own.history - 1 - lag, "newest": 0}.get(history, lag)
            if own.kind in self.made:
                parts.append(made[own.kind][np.maximum(rows - back, 0)] * np.asarray(own.scale, float))
            elif self.log.obs is not None:
                parts.append(self.logged_block(order[term] if order else term, lag)[rows])
            else:
                parts.append(np.zeros((len(rows), c.size_of(own))))
        return np.concatenate(parts, axis=1)

    def logged_block(self, term: int, lag: int) -> np.ndarray:
        """Return the logged entries of a term of a step."""
        return known(self.logged)[:, self.contract.block(term, lag)]

    @cached_property
    def logged(self) -> np.ndarray | None:
        """The logged observations before the normaliser ``(N, O)``; the log may have normalised ones."""
        obs, c = self.log.obs, self.contract
        if obs is None or not c.mean or obs.shape[1] != c.size:
            return obs
        rebuilt = Deployed(replace(self.log, obs=None), self.policy).observations(Setting(), self.rows)
        gap = lambda values: np.median(np.abs(values[self.rows] - rebuilt) / (rebuilt.std(0) + 1e-3))  # noqa: E731
        before = obs * np.array(c.std) + np.array(c.mean)
        return before if gap(before) < 0.5 * gap(obs) else obs

    @cached_property
    def acted(self) -> np.ndarray:
        """The logged actions ``(N, A)``, or the network's actions for the logged observations."""
        return self.log.action if self.log.action is not None else self.policy(known(self.logged))


def _taken(how: Setting, side: str, robot: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the policy's entries, without the pose, for the robot's joints ``(N, J)``; inverse of ``targets``."""
    signs, order = np.array(how.get(f"signs {side}")), list(how.get(f"order {side}", ())) or slice(None)
    return robot[:, order] * signs * np.array(how.get(f"turned {side}")) - rest * signs


def known(values: np.ndarray | None) -> np.ndarray:
    """Return values that the caller knows to exist."""
    assert values is not None
    return values


def matrices(quat: np.ndarray) -> np.ndarray:
    """Return rotation matrices from the body to the world ``(N, 3, 3)`` for quaternions w, x, y, z."""
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()


def in_frame(change: Any, quat: np.ndarray | None, body: np.ndarray) -> np.ndarray:
    """Return vectors of the body ``(N, 3)`` in a wrong frame or with wrong axes."""
    if isinstance(change, str):
        return FRAMES[change][1](known(quat), body)
    axes = np.array(change)
    return body[:, np.abs(axes) - 1] * np.sign(axes)
