"""Checks the contract: finds the faults with which computed observations, actions and targets equal the log's."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares, linear_sum_assignment

from sim2real.doctor.contract import Policy
from sim2real.doctor.deployed import FRAMES, Deployed, known
from sim2real.doctor.log import Log, newest
from sim2real.doctor.search import Candidate, Finding, Setting, Suspect, explain, shortened

_SOUND, _FINE = 0.01, 0.0015
"""Mean errors below this share of the signal's standard deviation are no fault, but rounding or samples a few
milliseconds apart. For logged observations it is smaller, because one term of many may be wrong.
"""
_LATE_S = 0.012
"""A smaller additional age of measurements is no fault [s]."""
_PLACES = {"the observation": ("seen",), "the targets": ("moved",), "observation and targets": ("seen", "moved")}
_LEFT_AND_RIGHT = ("fl fr", "rl rr", "lf rf", "lh rh", "hl hr", "bl br", "lb rb", "left right", "l r")
_FACTORS = (1 / 57.3, 0.05, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 20.0, 57.3)
_STEPS = np.array((0.6, 0.75, 0.87, 0.95, 0.99, 1.01, 1.05, 1.15, 1.33, 1.67))
_AXES = [tuple(s * i for s, i in zip(signs, order, strict=True)) for order in itertools.permutations((1, 2, 3))
         for signs in itertools.product((1, -1), repeat=3)][1:]  # fmt: skip


class Link:
    """One link of the chain from measurements to targets, with its possible faults.

    Args:
        name: ``observation``: measurements to the logged observations; ``network``: measurements to actions, if
            observations were not logged; ``normaliser``: logged observations to actions; ``target``: actions to
            targets.
        robot_joints: The joints in the order of the robot's motors.
    """

    def __init__(self, deployed: Deployed, name: str, robot_joints: Sequence[str]) -> None:
        self.d, self.name, self.robot_joints = deployed, name, robot_joints
        self._errors: dict[Setting, float] = {}
        self._sees = name in ("observation", "network")
        # Without logged actions, targets stand for the network's output.
        lacks = deployed.log.action is None and deployed.log.target is not None
        self._moves = name == "target" or (name == "network" and lacks)
        there = ["seen"] * self._sees + ["moved"] * self._moves
        self._places = [place for place, sides in _PLACES.items() if set(sides) <= set(there)]

    def wanted(self, how: Setting) -> np.ndarray:
        """Return the logged values at the end of the link ``(N, outputs)``."""
        return known({"target": self.d.log.target, "observation": self.d.logged}.get(self.name, self.d.actions(how)))

    def given(self, how: Setting) -> np.ndarray:
        """Return the observations at the start of the link ``(R, O)``."""
        d, rows = self.d, np.maximum(self.d.rows - how.get("stale", 0), 0)
        return known(d.logged)[rows] if self.name == "normaliser" else d.observations(how, rows)

    def predicted(self, how: Setting, given: np.ndarray | None = None) -> np.ndarray:
        """Return the values at the end of the link for a setting ``(R, outputs)``.

        Args:
            given: Observations before gain and bias, if they are computed already.
        """
        d = self.d
        if self.name == "target":
            return d.targets(how, d.acted[d.rows])
        x = self.given(how) if given is None else given
        if self.name == "observation":
            return x
        x = x * how.get("gain") + how.get("bias", 0.0)
        for _ in range(int(how.get("normalised"))):
            x = d.policy.normalised(x)
        return d.policy.network(x)

    def residuals(self, how: Setting, given: np.ndarray | None = None) -> np.ndarray:
        """Return the differences from the logged values ``(R, outputs)``, in standard deviations of the log."""
        all_rows = self.wanted(how)
        wanted, predicted = all_rows[self.d.rows], self.predicted(how, given)
        if how.get("clipped", False):
            predicted = np.clip(predicted, all_rows.min(0), all_rows.max(0))
        each = wanted.std(0)
        return (predicted - wanted) / np.maximum(each, 0.2 * np.median(each) + 1e-4)

    def error(self, how: Setting) -> float:
        """Return the mean error; each error counts at most 1.5."""
        if how not in self._errors:
            self._errors[how] = float(np.minimum(np.abs(self.residuals(how)), 1.5).mean())
        return self._errors[how]

    def solve(self) -> list[Candidate]:
        """Return the faults, the most important first."""
        if (before := self.error(Setting())) < (sound := _FINE if self.name == "observation" else _SOUND):
            return []
        chosen = explain(Setting(), self.error, self.candidates, sound)
        error = self.error(chosen[-1].setting) if chosen else before
        clear = error < 0.1 * before
        if self.name not in ("network", "normaliser") or error < _SOUND or (clear and len(chosen) < 2):
            return chosen
        # Try another normaliser: alone, and together with faults that leave much unexplained.
        tried = []
        for count in sorted({0} if clear else {0, min(1, len(chosen)), len(chosen)}):
            made = self._normaliser(chosen[count - 1].setting if count else Setting())
            text = "the observation is normalised with other numbers"
            tried.append([*chosen[:count], Candidate("normaliser", made, lambda _, text=text: text)])
        alone = [c for c in tried if self.error(c[-1].setting) < _SOUND][:1]
        best = min(alone or tried, key=lambda c: self.error(c[-1].setting) * (1 + 0.1 * len(c)))
        # Two free numbers for each entry lower any error: they must explain three quarters of it.
        return best if self.error(best[-1].setting) < (_SOUND if clear else min(0.5 * error, 0.25 * before)) else chosen

    def _normaliser(self, how: Setting) -> Setting:
        """Return the setting with the best gain and bias of each entry of the observation."""
        given = self.given(how)
        size, unit = given.shape[1], np.maximum(given.std(0), 1e-3)

        def made(theta: np.ndarray) -> Setting:
            return how.with_values({"gain": tuple(1 + theta[:size]), "bias": tuple(theta[size:] * unit)})

        pulled = lambda theta: np.append(self.residuals(made(theta), given), 0.01 * theta)  # noqa: E731
        return made(_fitted(pulled, 2 * size, 1e-2, 1.0))

    # -- suspects

    def candidates(self, how: Setting) -> Iterator[Candidate]:
        """Return further possible faults of a setting."""
        for suspect in self._suspects(how):
            if not any(name in how for name in suspect.names):
                yield from suspect.candidates(how)
        for place in self._places:
            yield from self._of_joints(how, place)

    def _suspects(self, how: Setting) -> Iterator[Suspect]:
        """Return all suspects except those of single joints."""
        d, c, sees = self.d, self.d.contract, self._sees
        shares = np.arange(0.0, 0.95, 0.01).tolist()
        period_s, imu = float(np.median(np.diff(d.log.t))), {"ang_vel", "gravity"} & d.made
        for kind in [*(sorted(d.made) if sees else ()), *(["action_scale"] if self._moves else ())]:
            text = f"{kind} has {{value:.3g}} times the contract's scale"
            yield Suspect("scale", (kind,), text, _FACTORS, lambda factor: factor * _STEPS)
        for kind in sorted(d.made) if sees else ():
            yield Suspect("missing term", (kind,), f"{kind} is 0 in the observation", (0.0,))
        for kind in ("joint_pos", "joint_vel") if sees else ():
            yield Suspect("scale", (f"degrees {kind}",), f"{kind} is in degrees before the pose is taken off", (True,))
        for kind in [k for k in ("ang_vel", "gravity", "lin_vel") if sees and k in d.made]:
            for frame, (words, _) in FRAMES.items() if d.log.quat is not None else ():
                fault = "quaternion order" if frame.startswith("w ") else "world frame"
                fault = "gyro rotated twice" if (kind, frame) == ("ang_vel", "twice") else fault
                yield Suspect(fault, (f"frame {kind}",), f"{kind} is {words}", (frame,))
            for axes in _AXES:
                fault = "sign" if np.abs(axes).tolist() == [1, 2, 3] else "axes"
                yield Suspect(fault, (f"frame {kind}",), f"{kind} has the axes {axes}", (axes,))
        if sees:
            yield Suspect(
                "delay", ("late",), "the policy sees measurements that are {ms:.0f} ms older than the log's newest",
                sorted({0.01, 0.02, 0.03, 0.04, 0.06, period_s, 2 * period_s}),
                lambda late_s: np.maximum(late_s + np.arange(-0.008, 0.009, 0.002), 1e-4))  # fmt: skip
            yield Suspect(
                "frozen joint", ("stuck",), lambda at: f"{c.joints[at[0]]} in the observation does not change any more",
                [(i, share) for i in range(len(c.joints)) for share in shares[::5]],
                lambda at: [(at[0], share) for share in _near_share(at[1])],
            )  # fmt: skip
        if sees and imu:
            yield Suspect("frozen imu", ("frozen",), "gyro and gravity in the observation do not change any more",
                          shares,
                          _near_share)  # fmt: skip
        if sees and d.history > 1:
            yield Suspect("history reversed", ("history",), "the history is in the reversed order", ("reversed",))
            text = "the history is by step and not by term, or the reverse"
            yield Suspect("history order", ("history",), text, ("layout",))
            text = "the history has the newest values in all its places"
            yield Suspect("history order", ("history",), text, ("newest",))
        if sees and "last_action" in d.made:
            text = "last_action is the action of one step more before"
            yield Suspect("last action", ("last_action is",), text, ("older",))
            yield Suspect("last action", ("last_action is",), "last_action is the target made of it", ("target",))
        if sees and len(c.observation) < 10:
            exchanged = lambda order: [tuple(o) for o in _exchanges(order)]  # noqa: E731
            text = lambda order: f"the terms come as {', '.join(c.observation[i].term for i in order)}"  # noqa: E731
            yield Suspect("term order", ("terms",), text, exchanged(range(len(c.observation))), exchanged)
        if self.name != "target":
            yield Suspect("delay", ("stale",), "the network answers the observation of {value} steps before", (1, 2))
        if self.name in ("network", "normaliser") and c.mean:
            yield Suspect("normaliser", ("normalised",), "the normaliser is applied {value:.0f} times", (0.0, 2.0))
        wanted = self.wanted(how)
        if self.name != "observation" and ((wanted == wanted.max(0)) | (wanted == wanted.min(0))).mean(0).max() > 0.03:
            text = "actions are clipped, where the contract has no limits"
            yield Suspect("action clipped", ("clipped",), text, (True,))

    def _of_joints(self, how: Setting, place: str) -> Iterator[Candidate]:
        """Return other orders, signs and poses of the joints, ``seen`` or ``moved``."""
        joints, sides = self.d.contract.joints, _PLACES[place]
        names = lambda what: tuple(f"{what} {side}" for side in sides)  # noqa: E731
        if len(joints) > 1 and not any(name in how for name in names("order")):
            same, mirror = tuple(range(len(joints))), mirror_of(joints)
            found = dict.fromkeys(tuple(int(i) for i in order) for order in self._orders(how))
            near = lambda order: [tuple(o) for o in _exchanges(order) if tuple(o) != same]  # noqa: E731
            for fault, orders in (("left and right", [o for o in found if o == mirror]),
                                  ("joint order", [o for o in found if o not in (same, mirror)])):  # fmt: skip
                text = lambda order: self._order_text(order, place)  # noqa: E731
                suspect = Suspect(fault, names("order"), text, orders)
                yield from (replace(suspect, near=near) if self.name == "network" else suspect).candidates(how)
        for i, joint in enumerate(joints):
            text = f"{joint} has the other sign in {place}"
            for what in ("signs", "turned"):
                signs = np.array(how.get(names(what)[0], np.ones(len(joints))))
                signs[i] *= -1.0
                yield from Suspect("sign", names(what), text, [tuple(signs.tolist())]).candidates(how)
        if any(name in how for name in names("pose")) or (self._sees and "joint_pos" not in self.d.made):
            return
        moved = lambda shift: how.with_values(dict.fromkeys(names("pose"), tuple(shift.tolist())))  # noqa: E731
        offset = np.clip(_fitted(lambda s: self.residuals(moved(s)).ravel(), len(joints), 0.02, 0.1), -2.0, 2.0)
        offset[np.abs(offset) < 0.01] = 0.0
        worst = int(np.argmax(np.abs(offset)))
        if abs(offset[worst]) >= 0.02:
            text = f"the default pose in {place} is another: by {offset[worst]:+.3f} rad at {joints[worst]}"
            yield Candidate("default pose", moved(offset), lambda _: text)

    def _order_text(self, order: Sequence[int], place: str) -> str:
        joints = self.d.contract.joints
        words = "left and right are exchanged" if order == mirror_of(joints) else "the joints are in another order"
        moved = [f"{joints[j]} in place of {joints[i]}" for i, j in enumerate(order) if i != j]
        return f"{words} in {place}: {shortened(moved)}"

    def _orders(self, how: Setting) -> Iterator[Any]:
        """Return possible orders of joints: matched to the log, mirrored, sorted, by type or leg, exchanged."""
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

    def _matched(self, how: Setting) -> Any:
        """Return the order in which logged columns fit the expected ones best."""
        d, rows = self.d, self.d.rows
        if self.name == "target":
            cost = _distance(d.targets(how, d.acted[rows]), known(d.log.target)[rows])
        else:
            cost, made = np.zeros((len(d.contract.joints),) * 2), d.quantities(how)
            for i, term in enumerate(d.contract.observation):
                if term.kind in {"joint_pos", "joint_vel"} & d.made:
                    lag = term.history - 1 if how.get("history", "") == "reversed" else 0
                    cost += _distance(d.logged_block(i, lag)[rows], made[term.kind][rows])
        return linear_sum_assignment(cost)[1]


def _near_share(share: float) -> list[float]:
    """Return shares near a given one, down to one step of the policy."""
    moves = np.concatenate([np.arange(-0.06, 0.061, 0.0015), np.arange(-0.0015, 0.0015, 0.0003)])
    return np.clip(share + moves, 0.0, 0.99).tolist()


def _fitted(residuals: Callable[[np.ndarray], np.ndarray], size: int, step: float, outlier: float) -> np.ndarray:
    """Return the numbers that minimise residuals, with a robust loss: linear above ``outlier``."""

    def slopes(theta: np.ndarray) -> np.ndarray:
        base = residuals(theta)
        return np.stack([(residuals(theta + step * e) - base) / step for e in np.eye(size)], -1)

    jac: Any = slopes  # scipy's stubs accept only names of methods
    return least_squares(residuals, np.zeros(size), jac, loss="huber", f_scale=outlier, ftol=1e-3, max_nfev=10).x


def _exchanges(order: Sequence[int]) -> Iterator[list[int]]:
    for i, j in itertools.combinations(range(len(order)), 2):
        new = list(order)
        new[i], new[j] = new[j], new[i]
        yield new


def _distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return 1 minus the absolute correlation of the columns of two arrays, ``(A, B)``."""
    a, b = first - first.mean(0), second - second.mean(0)
    norm = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0) + 1e-9
    return 1.0 - np.abs(a.T @ b) / norm


def mirror_of(joints: Sequence[str]) -> tuple[int, ...] | None:
    """Return for each joint the joint on the other side, by name; None if a name has no counterpart."""
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
    """Return the faults between measurements, observations, actions and targets, and the error of each link."""
    deployed, errors = Deployed(log, policy), dict[str, float]()
    findings = frozen_sensors(log, policy.contract.joints)
    has_obs, has_action, has_target = log.obs is not None, log.action is not None, log.target is not None
    links = ["observation" if has_obs else "network"]
    links += ["normaliser"] if has_obs and has_action else []
    links += ["target"] if has_target and (has_action or has_obs) else []
    for name in links:
        if name == "network" and deployed.unread:
            continue
        link = Link(deployed, name, robot_joints)
        chosen = link.solve()
        steps = [link.error(Setting()), *(link.error(c.setting) for c in chosen)]
        errors[name], errors[f"{name}_after"] = steps[0], steps[-1]
        for c, before, after in zip(chosen, steps, steps[1:], strict=False):
            share, late = (before - after) / steps[0], c.fault == "delay"
            late_s = c.setting.get("late", 0.0) + c.setting.get("stale", 0) * float(np.median(np.diff(log.t)))
            if share < 0.005 or steps[-1] > 0.75 * steps[0] or (late and late_s < _LATE_S):
                continue
            question, numbers = ("timing", {"late_s": late_s}) if late else ("contract", {})
            findings.append(Finding(c.fault, question, c.text(c.setting), share, numbers))
        none = not any(f.question == "contract" for f in findings)
        if name in ("network", "normaliser") and steps[-1] > 0.3 and none:
            text = "the network does not give the logged actions, whatever order, sign, frame, scale or normaliser"
            findings.append(Finding("other network", "contract", f"{text}: is it the deployed one?", 0.0))
    return findings, errors


def frozen_sensors(log: Log, joints: Sequence[str]) -> list[Finding]:
    """Return a finding if the IMU is constant while joints move, or a joint while its commands change."""
    moving = np.abs(np.diff(log.q, axis=0)).max(1) > 1e-4
    given = log.action if log.target is None else log.target
    commands = None if given is None else given[newest(log.t, log.state_t)].T
    sensors = [("frozen imu", f"the IMU's {n}", getattr(log, n), None) for n in ("gyro", "quat")]
    of_joints = () if commands is None else zip(joints, log.q.T, commands, strict=True)
    sensors += [("frozen joint", f"the encoder of {joint}", q[:, None], command) for joint, q, command in of_joints]
    findings: dict[str, Finding] = {}
    for fault, what, values, command in sensors:
        if values is None:
            continue
        same = (np.diff(values, axis=0) == 0.0).all(1)
        ends = np.concatenate([[-1], np.flatnonzero(~same & moving), [len(same)]])
        longest = int(np.argmax(np.diff(ends)))
        begin, end = ends[longest] + 1, ends[longest + 1]
        if command is not None and np.ptp(command[begin : end + 1]) <= 0.3 * np.ptp(command):  # a joint at rest
            continue
        from_s, for_s = float(log.state_t[begin]), float(log.state_t[end] - log.state_t[begin])
        if for_s > 0.5 and (same & moving)[begin:end].sum() > 20:
            text = f"{what} repeats one value for {for_s:.1f} s from {from_s:.2f} s on, while joints move"
            findings.setdefault(fault, Finding(fault, "contract", text, 1.0, {"from_s": from_s, "for_s": for_s}))
    return list(findings.values())
