"""The contract question: which way of making observations and targets gives what the deployment's log has."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import least_squares, linear_sum_assignment
from scipy.spatial.transform import Rotation

from sim2real.doctor.contract import Policy
from sim2real.doctor.log import Log

SOUND = 0.01
"""A mean error below this share of the signal's deviation is none: rounding, and samples a few milliseconds apart."""
_FINE = 0.0015
"""The same for a logged observation, of which one term of many may be wrong."""
_ROWS, _MOST = 300, 4
_LEFT_AND_RIGHT = ("fl fr", "rl rr", "lf rf", "lh rh", "hl hr", "bl br", "lb rb", "left right", "l r")
_FRAMES = {"world": "in the world's frame instead of the body's", "twice": "rotated into the body twice",
           "conjugate": "rotated the wrong way"}  # fmt: skip
_WAYS = {"observation": ("seen",), "action": ("moved",), "both": ("seen", "moved")}
_PLACES = {"observation": "the observation", "action": "the targets", "both": "observation and targets"}


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
        angle, signs, rest = self.rates(robot), self._signs, pose + np.array(self.offset or 0.0)
        return angle - rest if self.whole else angle - rest * signs

    def given(self, policy: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the robot's angles for the policy's less the pose; the inverse of ``taken``."""
        rest = pose + np.array(self.offset or 0.0)
        turned = (rest + policy) * self._signs if self.whole else rest + policy * self._signs
        placed = np.empty_like(turned)
        placed[:, self._order] = turned
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
class Making:
    """How a deployment makes observations of measurements, and targets of actions; the default is the contract's.

    Attributes:
        seen, moved: The joints in the observation and in the targets.
        vectors: Kind of a vector -> one of ``_FRAMES``, or the signs of its entries.
        scales: Kind, or ``action_scale`` -> factor beside the contract's.
        frozen_from: Share of the log after which the IMU's entries stay as they are; 1: never.
        late_s: Age of the measurements beyond the newest one in the log [s].
        gain, bias: Of each entry of the observation: another normaliser.
        normalised: How often the contract's normaliser is applied.
    """

    seen: Joints = Joints()
    moved: Joints = Joints()
    vectors: tuple[tuple[str, Any], ...] = ()
    scales: tuple[tuple[str, float], ...] = ()
    reversed_history: bool = False
    frozen_from: float = 1.0
    late_s: float = 0.0
    gain: tuple[float, ...] = ()
    bias: tuple[float, ...] = ()
    normalised: int = 1


@dataclass(frozen=True)
class Candidate:
    """One thing that may be wrong, as a making that has it; ``near`` gives the candidates around it."""

    fault: str
    text: str
    making: Making
    near: Callable[[], Iterable[Candidate]] = tuple


@dataclass(frozen=True)
class Finding:
    """Something that is wrong.

    Attributes:
        fault: Its name, such as ``joint order``.
        question: ``contract``, ``timing`` or ``plant``.
        text: One sentence.
        share: Share of the gap that it explains, from 0 to 1.
        numbers: Name -> value.
    """

    fault: str
    question: str
    text: str
    share: float
    numbers: Mapping[str, float] = field(default_factory=dict)


class Deployed:
    """A log beside its policy: observations, actions and targets for any making."""

    def __init__(self, log: Log, policy: Policy) -> None:
        self.log, self.policy, self.contract = log, policy, policy.contract
        c = self.contract
        self._pose, self._scale = c.per_joint("default_joint_pos"), c.per_joint("action_scale")
        self._resting = self._pose if c.drive == "position" else np.zeros_like(self._pose)  # the target of action 0
        self._states: dict[float, dict[str, np.ndarray]] = {}
        longest = max(term.history for term in c.observation)
        first = min(max(longest + 1, len(log.t) // 10), len(log.t) // 2)
        self.rows = np.unique(np.linspace(first, len(log.t) - 1, _ROWS).astype(int))
        self.kinds = [term.kind for term in c.observation]

    def _state(self, late_s: float) -> dict[str, np.ndarray]:
        if late_s not in self._states:
            found = {n: self.log.at_steps(n, late_s) for n in ("q", "dq", "quat", "gyro", "lin_vel")
                     if getattr(self.log, n) is not None}  # fmt: skip
            if "quat" in found:
                found["turn"] = matrices(found.pop("quat"))
            self._states[late_s] = found
        return self._states[late_s]

    def quantities(self, how: Making) -> dict[str, np.ndarray]:
        """Return the newest entries of each kind at each step ``(N, size)``, before the contract's scale."""
        state = self._state(how.late_s)
        if how.frozen_from < 1.0:
            stop = int(how.frozen_from * len(self.log.t))
            held = np.minimum(np.arange(len(self.log.t)), stop)
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
            made[kind] = in_frame(state["turn"], made[kind], change) if change in _FRAMES else made[kind] * change
        for kind, factor in how.scales:
            if kind in made:
                made[kind] = made[kind] * factor
        return made

    def actions(self, how: Making) -> np.ndarray | None:
        """Return the network's actions ``(N, A)``: the logged ones, or those that the targets say."""
        if self.log.action is not None or self.log.target is None:
            return self.log.action
        return how.moved.taken(self.log.target, self._resting) / self._scale_of(how)

    def targets(self, how: Making, action: np.ndarray) -> np.ndarray:
        """Return the targets ``(N, J)`` that actions ``(N, A)`` give."""
        return how.moved.given(action * self._scale_of(how), self._resting)

    def _scale_of(self, how: Making) -> np.ndarray:
        return self._scale * dict(how.scales).get("action_scale", 1.0)

    def observations(self, how: Making, rows: np.ndarray) -> np.ndarray:
        """Return the observations ``(R, O)`` at some steps, before the normaliser."""
        c, made, parts = self.contract, self.quantities(how), []
        for term, lag in c.layout:
            own = c.observation[term]
            back = own.history - 1 - lag if how.reversed_history else lag
            if own.kind in made:
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
        spread = rebuilt.std(0) + 1e-3
        gap = lambda values: np.median(np.abs(values[self.rows] - rebuilt) / spread)  # noqa: E731
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


def fitted(residuals: Callable[[np.ndarray], np.ndarray], size: int, step: float, outlier: float) -> np.ndarray:
    """Return the numbers that make residuals smallest; residuals above ``outlier`` count by their size alone."""

    def slopes(theta: np.ndarray) -> np.ndarray:
        base = residuals(theta)
        return np.stack([(residuals(theta + step * e) - base) / step for e in np.eye(size)], -1)

    jac: Any = slopes  # the stubs know names of methods only
    return least_squares(residuals, np.zeros(size), jac, loss="huber", f_scale=outlier, ftol=1e-3, max_nfev=10).x


# -- the search


@dataclass(frozen=True)
class Dial:
    """One number that may be wrong: the values that are tried first, those near the best, and how a making has it."""

    fault: str
    text: str
    grid: Sequence[float]
    near: Callable[[float], np.ndarray]
    turned: Callable[[Making, str, float], Making]

    def candidate(self, how: Making, name: str, value: float) -> Candidate:
        """Return a candidate with a value."""
        text = self.text.format(name=name, value=value, ms=1e3 * value)
        near = lambda: (self.candidate(how, name, float(v)) for v in self.near(value))  # noqa: E731
        return Candidate(self.fault, text, self.turned(how, name, value), near)


_SCALE = Dial(
    "scale", "{name} has {value:.3g} times the contract's scale",
    (1 / 57.3, 0.05, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 20.0, 57.3),
    lambda factor: factor * np.geomspace(0.6, 1.7, 23),
    lambda how, name, factor: replace(how, scales=(*how.scales, (name, factor))),
)  # fmt: skip
_FROZEN = Dial(
    "frozen imu", "gyro and gravity in the observation do not change any more", np.arange(0.0, 0.95, 0.05).tolist(),
    lambda share: np.clip(share + np.arange(-0.05, 0.051, 0.005), 0.0, 0.99),
    lambda how, _, share: replace(how, frozen_from=share),
)  # fmt: skip
_LATE = Dial(
    "delay", "the policy sees measurements that are {ms:.0f} ms older than the log's newest",
    (0.01, 0.02, 0.03, 0.04, 0.06), lambda late_s: np.maximum(late_s + np.arange(-0.008, 0.009, 0.002), 1e-4),
    lambda how, _, late_s: replace(how, late_s=late_s),
)  # fmt: skip


class Search:
    """Looks for the makings that explain one link of the chain.

    Args:
        link: ``observation``: measurements to the logged observations; ``network``: measurements to actions, if
            observations were not logged; ``normaliser``: logged observations to actions; ``target``: actions to
            targets.
        robot_joints: The joints in the order of the robot's motors.
    """

    def __init__(self, deployed: Deployed, link: str, robot_joints: Sequence[str]) -> None:
        self.d, self.link, self.robot_joints = deployed, link, robot_joints
        self._errors: dict[Making, float] = {}
        self._sound = _FINE if link == "observation" else SOUND
        self._sees = link in ("observation", "network")
        # Without logged actions, the targets are a part of the question about the network.
        lacks = deployed.log.action is None and deployed.log.target is not None
        self._acts = link == "target" or (link == "network" and lacks)
        self._ways = ["observation"] * self._sees + ["action"] * self._acts + ["both"] * (self._sees and self._acts)

    def residuals(self, how: Making, given: np.ndarray | None = None) -> np.ndarray:
        """Return the differences from what was logged ``(R, outputs)``, in units of its deviation.

        Args:
            given: What the network is given, before gain and bias, if it is known already.
        """
        d, rows = self.d, self.d.rows
        if self.link == "target":
            predicted, logged = d.targets(how, d.acted[rows]), d.log.target
        elif self.link == "observation":
            predicted, logged = d.observations(how, rows), d.logged
        else:
            predicted, logged = self._given(how) if given is None else given, d.actions(how)
            predicted = predicted * how.gain + how.bias if how.gain else predicted
            for _ in range(how.normalised):
                predicted = d.policy.normalised(predicted)
            predicted = d.policy.network(predicted)
        wanted = known(logged)[rows]
        each = wanted.std(0)
        return (predicted - wanted) / np.maximum(each, 0.2 * np.median(each) + 1e-4)

    def _given(self, how: Making) -> np.ndarray:
        """Return what the network is given, before gain and bias."""
        return known(self.d.logged)[self.d.rows] if self.link == "normaliser" else self.d.observations(how, self.d.rows)

    def error(self, how: Making) -> float:
        """Return the mean error, each part of which counts as at most 1.5."""
        if how not in self._errors:
            self._errors[how] = float(np.minimum(np.abs(self.residuals(how)), 1.5).mean())
        return self._errors[how]

    def run(self) -> tuple[list[tuple[Candidate, float]], float, float]:
        """Return what is wrong, with the share that each explains, and the errors before and after."""
        before = self.error(Making())
        if before < self._sound:
            return [], before, before
        chosen = [] if self.link == "normaliser" else self._greedy(before)
        if self.link in ("network", "normaliser"):
            chosen = self._with_normaliser(chosen, before)
        errors = [before, *(self.error(c.making) for c in chosen)]
        shares = [max(0.0, (a - b) / before) for a, b in itertools.pairwise(errors)]
        return list(zip(chosen, shares, strict=True)), before, errors[-1]

    def _greedy(self, error: float) -> list[Candidate]:
        chosen: list[Candidate] = []
        how = Making()
        while error > self._sound and len(chosen) < _MOST:
            best = self._best(how)
            if best is not None and error - self.error(best.making) >= max(0.12 * error, 0.4 * self._sound):
                chosen.append(best)
            elif pair := self._pair(how, error):
                chosen += pair
            else:
                break
            how, error = chosen[-1].making, self.error(chosen[-1].making)
        return chosen

    def _ranked(self, how: Making) -> list[Candidate]:
        return sorted(self.candidates(how), key=lambda c: self.error(c.making))

    def _best(self, how: Making) -> Candidate | None:
        ranked = self._ranked(how)
        near = [n for c in ranked[:4] for n in c.near()]
        return min([*ranked[:1], *near], key=lambda c: self.error(c.making), default=None)

    def _pair(self, how: Making, error: float) -> list[Candidate]:
        """Return two candidates that explain together what none explains alone; none: an empty list."""
        heads: dict[str, Candidate] = {}
        for candidate in self._ranked(how):
            heads.setdefault(candidate.fault, candidate)
        pairs = [[first, second] for first in itertools.islice(heads.values(), 6)
                 if (second := self._best(first.making)) is not None]  # fmt: skip
        best = min(pairs, key=lambda p: self.error(p[1].making), default=[])
        return best if best and self.error(best[1].making) < 0.6 * error else []

    def _with_normaliser(self, chosen: list[Candidate], before: float) -> list[Candidate]:
        """Return the candidates, or another normaliser if it explains more than they do."""
        error = self.error(chosen[-1].making) if chosen else before
        if error < max(SOUND, 0.1 * before):
            return chosen
        tried = []
        for count in sorted({0, min(1, len(chosen)), len(chosen)}):
            making = self._normaliser(chosen[count - 1].making if count else Making())
            text = "the observation is normalised with other numbers"
            tried.append([*chosen[:count], Candidate("normaliser", text, making)])
        best = min(tried, key=lambda c: self.error(c[-1].making) * (1 + 0.1 * len(c)))
        return best if self.error(best[-1].making) < 0.5 * error else chosen

    def _normaliser(self, how: Making) -> Making:
        """Return a making with the gain and the bias of each entry of the observation that fit best."""
        given = self._given(how)
        size, unit = given.shape[1], np.maximum(given.std(0), 1e-3)

        def made(theta: np.ndarray) -> Making:
            return replace(how, gain=tuple(1 + theta[:size]), bias=tuple(theta[size:] * unit))

        pulled = lambda theta: np.append(self.residuals(made(theta), given), 0.01 * theta)  # noqa: E731
        return made(fitted(pulled, 2 * size, 1e-2, 1.0))

    # -- candidates

    def candidates(self, how: Making) -> Iterator[Candidate]:
        """Return what may be wrong beside what is known already."""
        for way in self._ways:
            yield from self._orders(how, way)
            yield from self._signs(how, way)
            yield from self._offset(how, way)
        for dial, names in self._dials(how):
            for name, value in itertools.product(names, dial.grid):
                yield dial.candidate(how, name, value)
        if not self._sees:
            return
        d = self.d
        made = d.quantities(how)
        for kind in [k for k in ("ang_vel", "gravity", "lin_vel") if k in d.kinds and k in made]:
            if kind in dict(how.vectors):
                continue
            turned = lambda change, kind=kind: replace(how, vectors=(*how.vectors, (kind, change)))  # noqa: E731
            for frame, text in _FRAMES.items() if d.log.quat is not None else ():
                fault = "gyro rotated twice" if (frame, kind) == ("twice", "ang_vel") else "world frame"
                yield Candidate(fault, f"{kind} is {text}", turned(frame))
            for signs in itertools.product((1.0, -1.0), repeat=3):
                if min(signs) < 0:
                    yield Candidate("sign", f"{kind} has other signs: {signs}", turned(signs))
        if max(t.history for t in d.contract.observation) > 1 and not how.reversed_history:
            new = replace(how, reversed_history=True)
            yield Candidate("history reversed", "the history is in the reversed order", new)
        if d.contract.mean and self.link == "network" and how.normalised == 1:
            yield Candidate("normaliser", "the normaliser is not applied", replace(how, normalised=0))
            yield Candidate("normaliser", "the normaliser is applied twice", replace(how, normalised=2))

    def _dials(self, how: Making) -> Iterator[tuple[Dial, Iterable[str]]]:
        scaled = dict(how.scales)
        if self._acts and "action_scale" not in scaled:
            yield _SCALE, ["action_scale"]
        if self._sees:
            made = self.d.quantities(how)
            yield _SCALE, sorted({k for k in self.d.kinds if k in made and k not in scaled})
            if how.frozen_from == 1.0 and any(k in made and k in self.d.kinds for k in ("ang_vel", "gravity")):
                yield _FROZEN, [""]
            if not how.late_s:
                period = float(np.median(np.diff(self.d.log.t)))
                yield replace(_LATE, grid=sorted({*_LATE.grid, period, 2 * period})), [""]

    def _orders(self, how: Making, way: str) -> Iterator[Candidate]:
        joints = self.d.contract.joints
        if len(joints) > 1 and not any(getattr(how, side).order for side in _WAYS[way]):
            orders = (tuple(int(i) for i in order) for order in self._permutations(how))
            for order in dict.fromkeys(orders):
                if order != tuple(range(len(joints))):
                    yield self._ordered(how, way, order)

    def _ordered(self, how: Making, way: str, order: Sequence[int]) -> Candidate:
        joints = self.d.contract.joints
        mirrored = mirror_of(joints) == tuple(order)
        words = "left and right are exchanged" if mirrored else "the joints are in another order"
        moved = [f"{joints[j]} in place of {joints[i]}" for i, j in enumerate(order) if i != j]
        text = f"{words} in {_PLACES[way]}: {shortened(moved)}"
        near = (lambda: self._descent(how, way, order)) if self.link == "network" else tuple
        new = _changed(how, way, order=tuple(order))
        return Candidate("left and right" if mirrored else "joint order", text, new, near)

    def _descent(self, how: Making, way: str, order: Sequence[int]) -> Iterator[Candidate]:
        """Exchange pairs of joints as long as the error falls."""
        error = self.error(_changed(how, way, order=tuple(order)))
        while True:
            trials = [self._ordered(how, way, pair) for pair in _exchanges(order)]
            best = min(trials, key=lambda c: self.error(c.making))
            order = getattr(best.making, _WAYS[way][0]).order
            if self.error(best.making) >= error or list(order) == sorted(order):
                return
            error = self.error(best.making)
            yield best

    def _permutations(self, how: Making) -> Iterator[Any]:
        """Return orders in which joints may come: matched to the log, mirrored, sorted, by type or leg, exchanged."""
        joints = self.d.contract.joints
        count = len(joints)
        if self.link in ("observation", "target"):
            yield self._matched(how)
        if (mirror := mirror_of(joints)) is not None:
            yield mirror
        others = [np.argsort(np.array(joints), kind="stable")]
        if set(self.robot_joints) == set(joints):
            others.append(np.array([self.robot_joints.index(j) for j in joints]))
        for width in [w for w in range(2, count) if count % w == 0]:
            groups = np.arange(count).reshape(-1, width)
            others.append(groups.T.ravel())
            if len(groups) <= 4:
                yield from (groups[list(p)].ravel() for p in itertools.permutations(range(len(groups))))
            if width <= 4:
                yield from (groups[:, list(p)].ravel() for p in itertools.permutations(range(width)))
        for order in others:
            yield order
            yield np.argsort(order)
        yield range(count - 1, -1, -1)
        yield from _exchanges(range(count))

    def _matched(self, how: Making) -> Any:
        """Return the order in which the logged columns fit the expected ones best."""
        d, rows = self.d, self.d.rows
        if self.link == "target":
            cost = _distance(d.targets(how, d.acted[rows]), known(d.log.target)[rows])
        else:
            cost, made = np.zeros((len(d.contract.joints),) * 2), d.quantities(how)
            for i, term in enumerate(d.contract.observation):
                if term.kind in ("joint_pos", "joint_vel"):
                    lag = term.history - 1 if how.reversed_history else 0
                    cost += _distance(d.logged_block(i, lag)[rows], made[term.kind][rows])
        return linear_sum_assignment(cost)[1]

    def _signs(self, how: Making, way: str) -> Iterator[Candidate]:
        joints = self.d.contract.joints
        for i, joint in enumerate(joints):
            signs = np.array(getattr(how, _WAYS[way][0]).signs or np.ones(len(joints)))
            signs[i] *= -1.0
            text = f"{joint} has the other sign in {_PLACES[way]}"
            for whole in (False, True):
                yield Candidate("sign", text, _changed(how, way, signs=tuple(signs.tolist()), whole=whole))

    def _offset(self, how: Making, way: str) -> Iterator[Candidate]:
        sides = [getattr(how, side) for side in _WAYS[way]]
        if any(side.offset for side in sides) or (way != "action" and "joint_pos" not in self.d.kinds):
            return
        moved = lambda shift: self.residuals(_changed(how, way, offset=tuple(shift.tolist()))).ravel()  # noqa: E731
        offset = np.clip(fitted(moved, len(self.d.contract.joints), 0.02, 0.1), -2.0, 2.0)
        offset[np.abs(offset) < 0.01] = 0.0
        worst = int(np.argmax(np.abs(offset)))
        if abs(offset[worst]) >= 0.02:
            joint = self.d.contract.joints[worst]
            text = f"the default pose in {_PLACES[way]} is another: by {offset[worst]:+.3f} rad at {joint}"
            yield Candidate("default pose", text, _changed(how, way, offset=tuple(offset.tolist())))


def _changed(how: Making, way: str, **changes: Any) -> Making:
    """Return a making with other joints in the observation, the targets, or both."""
    return replace(how, **{side: replace(getattr(how, side), **changes) for side in _WAYS[way]})


def _exchanges(order: Sequence[int]) -> Iterator[list[int]]:
    for i, j in itertools.combinations(range(len(order)), 2):
        new = list(order)
        new[i], new[j] = new[j], new[i]
        yield new


def shortened(parts: Sequence[str]) -> str:
    """Return two of many parts of a sentence, and how many more there are."""
    return ", ".join(parts[:2]) + (f" and {len(parts) - 2} more" if len(parts) > 2 else "")


def _distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return how little the columns of two arrays vary together ``(A, B)``; means, scales and signs do not count."""
    a, b = first - first.mean(0), second - second.mean(0)
    norm = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0) + 1e-9
    return 1.0 - np.abs(a.T @ b) / norm


def mirror_of(joints: Sequence[str]) -> tuple[int, ...] | None:
    """Return the joint on the other side of each joint, by the names; None if a name has no counterpart."""
    pairs: dict[str, str] = {}
    for a, b in (pair.split() for pair in _LEFT_AND_RIGHT):
        pairs |= {a: b, b: a}
    words = [[w.lower() for w in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", joint)] for joint in joints]
    there = {tuple(w): i for i, w in enumerate(words)}
    found = [there.get(tuple(pairs.get(w, w) for w in own)) for own in words]
    if None in found or found == list(range(len(joints))):
        return None
    return tuple(i for i in found if i is not None)


def solve_contract(
    log: Log, policy: Policy, robot_joints: Sequence[str] = ()
) -> tuple[list[Finding], dict[str, float]]:
    """Return what is wrong between measurements, observations, actions and targets, and the error of each link."""
    deployed, errors = Deployed(log, policy), {}
    findings = frozen_sensors(log)
    has_obs, has_action, has_target = log.obs is not None, log.action is not None, log.target is not None
    links = ["observation" if has_obs else "network"]
    links += ["normaliser"] if has_obs and has_action else []
    links += ["target"] if has_target and (has_action or has_obs) else []
    for link in links:
        unknown = set(deployed.kinds) - set(deployed.quantities(Making()))
        if link == "network" and unknown:
            errors["unknown"] = float(len(unknown))
            continue
        parts, before, after = Search(deployed, link, robot_joints).run()
        errors[link], errors[f"{link}_after"] = before, after
        for candidate, share in parts:
            late_s = candidate.making.late_s if candidate.fault == "delay" else None
            if share < 0.005 or after > 0.75 * before or (late_s is not None and late_s < 0.012):
                continue
            question, numbers = ("contract", {}) if late_s is None else ("timing", {"late_s": late_s})
            findings.append(Finding(candidate.fault, question, candidate.text, share, numbers))
        if link in ("network", "normaliser") and after > 0.3 and not any(f.question == "contract" for f in findings):
            text = "the network does not give the logged actions, whatever order, sign, frame, scale or normaliser"
            findings.append(Finding("other network", "contract", f"{text}: is it the deployed one?", 0.0))
    return findings, errors


def frozen_sensors(log: Log) -> list[Finding]:
    """Return a finding if the IMU repeats itself while joints move."""
    moving = np.abs(np.diff(log.q, axis=0)).max(1) > 1e-4
    for name in ("gyro", "quat"):
        values: np.ndarray | None = getattr(log, name)
        if values is None:
            continue
        same = (np.diff(values, axis=0) == 0.0).all(1)
        ends = np.concatenate([[-1], np.flatnonzero(~same & moving), [len(same)]])
        longest = int(np.argmax(np.diff(ends)))
        begin, end = ends[longest] + 1, ends[longest + 1]
        from_s, for_s = float(log.state_t[begin]), float(log.state_t[end] - log.state_t[begin])
        if for_s > 0.5 and (same & moving)[begin:end].sum() > 20:
            text = f"the IMU's {name} repeats one value for {for_s:.1f} s from {from_s:.2f} s on, while joints move"
            return [Finding("frozen imu", "contract", text, 1.0, {"from_s": from_s, "for_s": for_s})]
    return []
