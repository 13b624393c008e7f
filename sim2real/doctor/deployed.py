"""What a deployment makes of measurements and actions: observations and targets, for any way of making them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sim2real.doctor.contract import Policy
from sim2real.doctor.log import Log
from sim2real.doctor.search import Setting

FRAMES = {"world": "in the world's frame instead of the body's", "twice": "rotated into the body twice",
          "conjugate": "rotated the wrong way"}  # fmt: skip
_ROWS = 300


@dataclass(frozen=True)
class Joints:
    """How a deployment takes the policy's joints from the robot's, or back; the default is the contract's way.

    Attributes:
        order: Entry i of the policy is joint ``order[i]`` of the contract; empty: joint i.
        signs: Of each entry; ``whole``: they turn the angle itself, and not its distance from the default pose.
        offset: What the default pose has too much [rad].
    """

    order: tuple[int, ...] = ()
    signs: tuple[float, ...] = ()
    whole: bool = False
    offset: tuple[float, ...] = ()

    def taken(self, robot: np.ndarray, pose: Any) -> np.ndarray:
        """Return the policy's angles less the pose for the robot's ``(N, J)``."""
        rest = pose + np.array(self.offset or 0.0)
        return self.rates(robot) - (rest if self.whole else rest * self._signs)

    def given(self, policy: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the robot's angles for the policy's less the pose; the inverse of ``taken``."""
        rest = pose + np.array(self.offset or 0.0)
        placed = np.empty_like(policy)
        placed[:, self._order] = policy * self._signs + (rest * self._signs if self.whole else rest)
        return placed

    def rates(self, robot: np.ndarray) -> np.ndarray:
        """Return the policy's velocities for the robot's ``(N, J)``."""
        return robot[:, self._order] * self._signs

    @property
    def _order(self) -> Any:
        return list(self.order) or slice(None)

    @property
    def _signs(self) -> np.ndarray:
        return np.array(self.signs or 1.0)


@dataclass(frozen=True)
class Making(Setting):
    """How a deployment makes observations of measurements, and targets of actions; the default is the contract's.

    Its numbers are factors beside the contract's scales, by kind and ``action_scale``; ``frozen``: share of the log
    after which the IMU's entries do not change; ``late``: age of the measurements beyond the newest one in the log [s];
    ``reversed``: 1 for a history in the reversed order; ``normalised``: how often the normaliser is applied.

    Attributes:
        seen, moved: The joints in the observation and in the targets.
        vectors: Kind of a vector -> one of ``FRAMES``, or the signs of its entries.
        gain, bias: Of each entry of the observation: another normaliser.
    """

    seen: Joints = Joints()
    moved: Joints = Joints()
    vectors: tuple[tuple[str, Any], ...] = ()
    gain: tuple[float, ...] = ()
    bias: tuple[float, ...] = ()


class Deployed:
    """A log beside its policy: observations, actions and targets for any making."""

    def __init__(self, log: Log, policy: Policy) -> None:
        self.log, self.policy, self.contract = log, policy, policy.contract
        c = self.contract
        self._pose, self._scale = c.per_joint("default_joint_pos"), c.per_joint("action_scale")
        self._resting = self._pose if c.drive == "position" else np.zeros_like(self._pose)  # the target of action 0
        self._states: dict[float, dict[str, np.ndarray]] = {}
        self.history = max(term.history for term in c.observation)
        first = min(max(self.history + 1, len(log.t) // 10), len(log.t) // 2)
        self.rows = np.unique(np.linspace(first, len(log.t) - 1, _ROWS).astype(int))
        widths = {kind: values.shape[1] for kind, values in self.quantities(Making()).items()}
        fitting = [term for term in c.observation if widths.get(term.kind) == c.size_of(term)]
        self.made = {term.kind for term in fitting}
        self.unread = [term.term for term in c.observation if term not in fitting]

    def _state(self, late_s: float) -> dict[str, np.ndarray]:
        if late_s not in self._states:
            names = [n for n in ("q", "dq", "quat", "gyro", "lin_vel") if getattr(self.log, n) is not None]
            found = {n: self.log.at_steps(n, late_s) for n in names}
            if "quat" in found:
                found["turn"] = matrices(found.pop("quat"))
            self._states[late_s] = found
        return self._states[late_s]

    def quantities(self, how: Making) -> dict[str, np.ndarray]:
        """Return the newest entries of each kind at each step ``(N, size)``, before the contract's scale."""
        state, count = self._state(how.number("late", 0.0)), len(self.log.t)
        if (frozen := how.number("frozen")) < 1.0:
            held = np.minimum(np.arange(count), int(frozen * count))
            state = state | {k: state[k][held] for k in ("turn", "gyro") if k in state}
        pose = self._pose * any(t.relative for t in self.contract.observation if t.kind == "joint_pos")
        bare = replace(how.seen, offset=()).taken(state["q"], 0.0)
        made = {"joint_pos": how.seen.taken(state["q"], pose), "joint_vel": how.seen.rates(state["dq"]),
                "sin_joint_pos": np.sin(bare), "cos_joint_pos": np.cos(bare)}  # fmt: skip
        made |= {kind: state[n] for kind, n in (("ang_vel", "gyro"), ("lin_vel", "lin_vel")) if n in state}
        if "turn" in state:
            made["gravity"] = -state["turn"][:, 2, :]
        if self.log.command is not None:
            made["command"] = self.log.command
        if (action := self.actions(how)) is not None:
            made["last_action"] = np.concatenate([np.zeros((1, action.shape[1])), action[:-1]])
        for kind, change in how.vectors:
            made[kind] = in_frame(state["turn"], made[kind], change) if change in FRAMES else made[kind] * change
        return {kind: values * how.number(kind) for kind, values in made.items()}

    def actions(self, how: Making) -> np.ndarray | None:
        """Return the network's actions ``(N, A)``: the logged ones, or those that the targets say."""
        if self.log.action is not None or self.log.target is None:
            return self.log.action
        return how.moved.taken(self.log.target, self._resting) / (self._scale * how.number("action_scale"))

    def targets(self, how: Making, action: np.ndarray) -> np.ndarray:
        """Return the targets ``(N, J)`` that actions ``(N, A)`` give."""
        return how.moved.given(action * self._scale * how.number("action_scale"), self._resting)

    def observations(self, how: Making, rows: np.ndarray) -> np.ndarray:
        """Return the observations ``(R, O)`` at some steps, before the normaliser."""
        c, made, parts = self.contract, self.quantities(how), []
        for term, lag in c.layout:
            own = c.observation[term]
            back = own.history - 1 - lag if how.number("reversed", 0.0) else lag
            if own.kind in self.made:
                parts.append(made[own.kind][np.maximum(rows - back, 0)] * np.asarray(own.scale, float))
            elif self.log.obs is not None:
                parts.append(self.logged_block(term, lag)[rows])
            else:
                parts.append(np.zeros((len(rows), c.size_of(own))))
        return np.concatenate(parts, axis=1)

    def logged_block(self, term: int, lag: int) -> np.ndarray:
        """Return the logged entries of a term of a step."""
        return known(self.logged)[:, self.contract.block(term, lag)]

    @cached_property
    def logged(self) -> np.ndarray | None:
        """The logged observations as before the normaliser ``(N, O)``; a log may have them from behind it."""
        obs, c = self.log.obs, self.contract
        if obs is None or not c.mean or obs.shape[1] != c.size:
            return obs
        rebuilt = Deployed(replace(self.log, obs=None), self.policy).observations(Making(), self.rows)
        gap = lambda values: np.median(np.abs(values[self.rows] - rebuilt) / (rebuilt.std(0) + 1e-3))  # noqa: E731
        before = obs * np.array(c.std) + np.array(c.mean)
        return before if gap(before) < 0.5 * gap(obs) else obs

    @cached_property
    def acted(self) -> np.ndarray:
        """The logged actions, or the network's on the logged observations ``(N, A)``."""
        return self.log.action if self.log.action is not None else self.policy(known(self.logged))


def known(values: np.ndarray | None) -> np.ndarray:
    """Return values that the caller knows to be there."""
    assert values is not None
    return values


def matrices(quat: np.ndarray) -> np.ndarray:
    """Return rotations from the body to the world ``(N, 3, 3)`` of quaternions w, x, y, z."""
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()


def in_frame(turn: np.ndarray, body: np.ndarray, frame: str) -> np.ndarray:
    """Return vectors of the body, as a deployment with a wrong frame has them."""
    if frame == "twice":
        return np.einsum("nji,nj->ni", turn, body)
    world = np.einsum("nij,nj->ni", turn, body)
    return world if frame == "world" else np.einsum("nij,nj->ni", turn, world)
