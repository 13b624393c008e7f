"""The contract question: which way of making observations and targets gives what the deployment's log has."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares, linear_sum_assignment

from sim2real.doctor.contract import Policy
from sim2real.doctor.deployed import FRAMES, Deployed, Making, known
from sim2real.doctor.log import Log
from sim2real.doctor.search import Candidate, Dial, Finding, explain, shortened

_SOUND, _FINE = 0.01, 0.0015
"""Mean errors below this share of the signal's deviation are none: rounding, and samples a few milliseconds apart;
in a logged observation one term of many may be wrong."""
_LATE_S = 0.012
"""Measurements that are older than the log's newest by less are no fault."""
_SIDES = {"the observation": ("seen",), "the targets": ("moved",), "observation and targets": ("seen", "moved")}
_LEFT_AND_RIGHT = ("fl fr", "rl rr", "lf rf", "lh rh", "hl hr", "bl br", "lb rb", "left right", "l r")
_STEPS = np.array((0.6, 0.75, 0.87, 0.95, 0.99, 1.01, 1.05, 1.15, 1.33, 1.67))
_SCALE = Dial(
    "scale", "{name} has {value:.3g} times the contract's scale",
    (1 / 57.3, 0.05, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 20.0, 57.3), lambda factor: factor * _STEPS,
)  # fmt: skip
_DIALS = {
    "reversed": Dial("history reversed", "the history is in the reversed order", (1.0,)),
    "normalised": Dial("normaliser", "the normaliser is applied {value:.0f} times", (0.0, 2.0)),
    "frozen": Dial("frozen imu", "gyro and gravity in the observation do not change any more",
                   np.arange(0.0, 0.95, 0.05).tolist(),
                   lambda share: np.clip(share + np.arange(-0.05, 0.051, 0.005), 0.0, 0.99)),
    "late": Dial("delay", "the policy sees measurements that are {ms:.0f} ms older than the log's newest",
                 (0.01, 0.02, 0.03, 0.04, 0.06),
                 lambda late_s: np.maximum(late_s + np.arange(-0.008, 0.009, 0.002), 1e-4)),
}  # fmt: skip


class Link:
    """One link of the chain from measurements to targets, and what may be wrong in it.

    Args:
        name: ``observation``: measurements to the logged observations; ``network``: measurements to actions, if
            observations were not logged; ``normaliser``: logged observations to actions; ``target``: actions to
            targets.
        robot_joints: The joints in the order of the robot's motors.
    """

    def __init__(self, deployed: Deployed, name: str, robot_joints: Sequence[str]) -> None:
        self.d, self.name, self.robot_joints = deployed, name, robot_joints
        self._errors: dict[Making, float] = {}
        self._sees = name in ("observation", "network")
        # Without logged actions, the targets are a part of the question about the network.
        lacks = deployed.log.action is None and deployed.log.target is not None
        self._acts = name == "target" or (name == "network" and lacks)
        there = ["seen"] * self._sees + ["moved"] * self._acts
        self._places = [place for place, sides in _SIDES.items() if set(sides) <= set(there)]

    def predicted(self, how: Making, given: np.ndarray | None = None) -> np.ndarray:
        """Return what a deployment would have logged at the end of the link ``(R, outputs)``.

        Args:
            given: What the network is given, before gain and bias, if it is known already.
        """
        d, rows = self.d, self.d.rows
        if self.name == "target":
            return d.targets(how, d.acted[rows])
        x = self.given(how) if given is None else given
        if self.name == "observation":
            return x
        x = x * how.gain + how.bias if how.gain else x
        for _ in range(int(how.number("normalised"))):
            x = d.policy.normalised(x)
        return d.policy.network(x)

    def given(self, how: Making) -> np.ndarray:
        """Return the observations ``(R, O)``."""
        return known(self.d.logged)[self.d.rows] if self.name == "normaliser" else self.d.observations(how, self.d.rows)

    def residuals(self, how: Making, given: np.ndarray | None = None) -> np.ndarray:
        """Return the differences from what was logged ``(R, outputs)``, in units of its deviation."""
        d = self.d
        logged = {"target": d.log.target, "observation": d.logged}.get(self.name, d.actions(how))
        wanted = known(logged)[d.rows]
        each = wanted.std(0)
        return (self.predicted(how, given) - wanted) / np.maximum(each, 0.2 * np.median(each) + 1e-4)

    def error(self, how: Making) -> float:
        """Return the mean error, each part of which counts as at most 1.5."""
        if how not in self._errors:
            self._errors[how] = float(np.minimum(np.abs(self.residuals(how)), 1.5).mean())
        return self._errors[how]

    def solve(self) -> list[Candidate[Making]]:
        """Return what is wrong, the greatest first."""
        if (before := self.error(Making())) < (sound := _FINE if self.name == "observation" else _SOUND):
            return []
        chosen = [] if self.name == "normaliser" else explain(Making(), self.error, self.candidates, sound)
        error = self.error(chosen[-1].setting) if chosen else before
        clear = error < 0.1 * before
        if self.name not in ("network", "normaliser") or error < _SOUND or (clear and len(chosen) < 2):
            return chosen
        # Another normaliser, if it explains more: alone, or beside what leaves much unexplained.
        tried = []
        for count in sorted({0} if clear else {0, min(1, len(chosen)), len(chosen)}):
            made = self._normaliser(chosen[count - 1].setting if count else Making())
            tried.append([*chosen[:count], Candidate("normaliser", made, _says("the observation is normalised with "
                                                                              "other numbers"))])  # fmt: skip
        best = min(tried, key=lambda c: self.error(c[-1].setting) * (1 + 0.1 * len(c)))
        # Two free numbers for each entry halve many an error: they must explain three quarters of it.
        return best if self.error(best[-1].setting) < (_SOUND if clear else min(0.5 * error, 0.25 * before)) else chosen

    def _normaliser(self, how: Making) -> Making:
        """Return a making with the gain and the bias of each entry of the observation that fit best."""
        given = self.given(how)
        size, unit = given.shape[1], np.maximum(given.std(0), 1e-3)

        def made(theta: np.ndarray) -> Making:
            return replace(how, gain=tuple(1 + theta[:size]), bias=tuple(theta[size:] * unit))

        pulled = lambda theta: np.append(self.residuals(made(theta), given), 0.01 * theta)  # noqa: E731
        return made(_fitted(pulled, 2 * size, 1e-2, 1.0))

    # -- candidates

    def candidates(self, how: Making) -> Iterator[Candidate[Making]]:
        """Return what may be wrong beside what is known already."""
        d = self.d
        for place in self._places:
            yield from self._of_joints(how, place)
        yield from (c for name, dial in self._dials() if name not in dict(how.numbers)
                    for c in dial.candidates(how, name))  # fmt: skip
        for kind in [k for k in ("ang_vel", "gravity", "lin_vel") if self._sees and k in d.made]:
            if kind in dict(how.vectors):
                continue
            turned = lambda change, kind=kind: replace(how, vectors=(*how.vectors, (kind, change)))  # noqa: E731
            for frame, text in FRAMES.items() if d.log.quat is not None else ():
                fault = "gyro rotated twice" if (frame, kind) == ("twice", "ang_vel") else "world frame"
                yield Candidate(fault, turned(frame), _says(f"{kind} is {text}"))
            for signs in itertools.product((1.0, -1.0), repeat=3):
                if min(signs) < 0:
                    yield Candidate("sign", turned(signs), _says(f"{kind} has other signs: {signs}"))

    def _dials(self) -> Iterator[tuple[str, Dial]]:
        d = self.d
        if self._acts:
            yield "action_scale", _SCALE
        if not self._sees:
            return
        yield from ((kind, _SCALE) for kind in sorted(d.made))
        period_s = float(np.median(np.diff(d.log.t)))
        yield "late", replace(_DIALS["late"], grid=sorted({*_DIALS["late"].grid, period_s, 2 * period_s}))
        for name, there in (("frozen", {"ang_vel", "gravity"} & d.made), ("reversed", d.history > 1),
                            ("normalised", d.contract.mean and self.name == "network")):  # fmt: skip
            if there:
                yield name, _DIALS[name]

    def _of_joints(self, how: Making, place: str) -> Iterator[Candidate[Making]]:
        """Return other orders, signs and poses of the joints in a place."""
        joints, sides = self.d.contract.joints, [getattr(how, side) for side in _SIDES[place]]
        if len(joints) > 1 and not any(side.order for side in sides):
            same, mirror = tuple(range(len(joints))), mirror_of(joints)
            moves = [lambda at: self._exchanged(at, place)] if self.name == "network" else []
            for order in dict.fromkeys(tuple(int(i) for i in order) for order in self._orders(how)):
                if order != same:
                    fault = "left and right" if order == mirror else "joint order"
                    yield Candidate(fault, _changed(how, place, order=order), self._order_text(place), moves)
        for i, joint in enumerate(joints):
            signs = np.array(sides[0].signs or np.ones(len(joints)))
            signs[i] *= -1.0
            text = _says(f"{joint} has the other sign in {place}")
            for whole in (False, True):
                yield Candidate("sign", _changed(how, place, signs=tuple(signs.tolist()), whole=whole), text)
        if any(side.offset for side in sides) or (place != "the targets" and "joint_pos" not in self.d.made):
            return
        moved = lambda shift: self.residuals(_changed(how, place, offset=tuple(shift.tolist()))).ravel()  # noqa: E731
        offset = np.clip(_fitted(moved, len(joints), 0.02, 0.1), -2.0, 2.0)
        offset[np.abs(offset) < 0.01] = 0.0
        worst = int(np.argmax(np.abs(offset)))
        if abs(offset[worst]) >= 0.02:
            text = f"the default pose in {place} is another: by {offset[worst]:+.3f} rad at {joints[worst]}"
            yield Candidate("default pose", _changed(how, place, offset=tuple(offset.tolist())), _says(text))

    def _order_text(self, place: str) -> Callable[[Making], str]:
        joints, mirror = self.d.contract.joints, mirror_of(self.d.contract.joints)

        def text(how: Making) -> str:
            order = getattr(how, _SIDES[place][0]).order
            words = "left and right are exchanged" if order == mirror else "the joints are in another order"
            moved = [f"{joints[j]} in place of {joints[i]}" for i, j in enumerate(order) if i != j]
            return f"{words} in {place}: {shortened(moved)}"

        return text

    def _exchanged(self, how: Making, place: str) -> Iterator[Making]:
        """Return the makings with two joints exchanged, but for the contract's own order."""
        for order in _exchanges(getattr(how, _SIDES[place][0]).order):
            if order != sorted(order):
                yield _changed(how, place, order=tuple(order))

    def _orders(self, how: Making) -> Iterator[Any]:
        """Return orders in which joints may come: matched to the log, mirrored, sorted, by type or leg, exchanged."""
        joints = self.d.contract.joints
        count = len(joints)
        if self.name in ("observation", "target"):
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
        if self.name == "target":
            cost = _distance(d.targets(how, d.acted[rows]), known(d.log.target)[rows])
        else:
            cost, made = np.zeros((len(d.contract.joints),) * 2), d.quantities(how)
            for i, term in enumerate(d.contract.observation):
                if term.kind in {"joint_pos", "joint_vel"} & d.made:
                    lag = term.history - 1 if how.number("reversed", 0.0) else 0
                    cost += _distance(d.logged_block(i, lag)[rows], made[term.kind][rows])
        return linear_sum_assignment(cost)[1]


def _says(text: str) -> Callable[[Making], str]:
    return lambda _: text


def _fitted(residuals: Callable[[np.ndarray], np.ndarray], size: int, step: float, outlier: float) -> np.ndarray:
    """Return the numbers that make residuals smallest; residuals above ``outlier`` count by their size alone."""

    def slopes(theta: np.ndarray) -> np.ndarray:
        base = residuals(theta)
        return np.stack([(residuals(theta + step * e) - base) / step for e in np.eye(size)], -1)

    jac: Any = slopes  # the stubs know names of methods only
    return least_squares(residuals, np.zeros(size), jac, loss="huber", f_scale=outlier, ftol=1e-3, max_nfev=10).x


def _changed(how: Making, place: str, **changes: Any) -> Making:
    """Return a making with other joints in the observation, the targets, or both."""
    return replace(how, **{side: replace(getattr(how, side), **changes) for side in _SIDES[place]})


def _exchanges(order: Sequence[int]) -> Iterator[list[int]]:
    for i, j in itertools.combinations(range(len(order)), 2):
        new = list(order)
        new[i], new[j] = new[j], new[i]
        yield new


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
    deployed, errors = Deployed(log, policy), dict[str, float]()
    findings = frozen_sensors(log)
    has_obs, has_action, has_target = log.obs is not None, log.action is not None, log.target is not None
    links = ["observation" if has_obs else "network"]
    links += ["normaliser"] if has_obs and has_action else []
    links += ["target"] if has_target and (has_action or has_obs) else []
    for name in links:
        if name == "network" and deployed.unread:
            continue
        link = Link(deployed, name, robot_joints)
        chosen = link.solve()
        steps = [link.error(c.setting) for c in (Candidate("", Making(), _says("")), *chosen)]
        errors[name], errors[f"{name}_after"] = steps[0], steps[-1]
        for candidate, before, after in zip(chosen, steps, steps[1:], strict=False):
            share = (before - after) / steps[0]
            late_s = candidate.setting.number("late", 0.0) if candidate.fault == "delay" else None
            if share < 0.005 or steps[-1] > 0.75 * steps[0] or (late_s is not None and late_s < _LATE_S):
                continue
            question, numbers = ("contract", {}) if late_s is None else ("timing", {"late_s": late_s})
            findings.append(
                Finding(candidate.fault, question, candidate.text(candidate.setting), share, numbers))  # fmt: skip
        none = not any(f.question == "contract" for f in findings)
        if name in ("network", "normaliser") and steps[-1] > 0.3 and none:
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
