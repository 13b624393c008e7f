"""The contract question: which way of making observations and targets gives what the deployment's log has."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from sim2real.doctor.contract import Policy
from sim2real.doctor.log import Log

SOUND = 0.01
"""A mean error below this share of the signal's deviation is none: rounding, and samples a few milliseconds apart."""
_FINE = 0.0015
"""The same for a logged observation, of which one term of many may be wrong."""
_ROWS, _MOST = 300, 4
_SCALES = (1 / 57.3, 0.05, 0.1, 0.2, 0.25, 0.5, 2.0, 4.0, 5.0, 10.0, 20.0, 57.3)
_LATE_S = (0.01, 0.02, 0.03, 0.04, 0.06)
_SIDES = ("fl fr", "rl rr", "lf rf", "lh rh", "hl hr", "bl br", "lb rb", "left right", "l r")


@dataclass(frozen=True)
class Making:
    """How a deployment makes observations of measurements, and targets of actions; the default is the contract's.

    Attributes:
        order, signs, offset: Of the joints in the observation: entry i is joint ``order[i]``, times its sign, less the
            default pose plus an offset.
        turned: Joints whose angle was negated after the default pose was subtracted.
        target_order, target_signs, target_offset, target_scale: The same of the targets.
        frames: Kind of a vector -> ``world``, ``twice`` or ``conjugate``.
        scales: Kind -> factor beside the contract's; ``axes``: kind -> signs of its three entries.
        frozen_from: Share of the log after which the IMU's entries stay as they are; 1: never.
        late_s: Age of the measurements beyond the newest one in the log [s].
        gain, bias: Of each entry of the observation: another normaliser.
        normalised: How often the contract's normaliser is applied.
    """

    order: tuple[int, ...] = ()
    signs: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    turned: tuple[float, ...] = ()
    target_order: tuple[int, ...] = ()
    target_signs: tuple[float, ...] = ()
    target_negated: bool = False
    target_offset: tuple[float, ...] = ()
    target_scale: float = 1.0
    frames: tuple[tuple[str, str], ...] = ()
    scales: tuple[tuple[str, float], ...] = ()
    axes: tuple[tuple[str, tuple[float, ...]], ...] = ()
    reversed_history: bool = False
    frozen_from: float = 1.0
    late_s: float = 0.0
    gain: tuple[float, ...] = ()
    bias: tuple[float, ...] = ()
    normalised: int = 1


@dataclass(frozen=True)
class Candidate:
    """One thing that may be wrong, as a making that has it."""

    fault: str
    text: str
    making: Making


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
        self._default = self._pose if c.drive == "position" else np.zeros_like(self._pose)  # the target of action 0
        self._states: dict[float, dict[str, np.ndarray]] = {}
        longest = max(term.history for term in c.observation)
        first = min(max(longest + 1, len(log.t) // 10), len(log.t) // 2)
        self.rows = np.unique(np.linspace(first, len(log.t) - 1, _ROWS).astype(int))
        kinds = [term.kind for term in c.observation]
        self.unknown = sorted({k for k in kinds if k not in self.quantities(Making())})

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
            state = state | {k: _held(state[k], stop) for k in ("turn", "gyro") if k in state}
        q, dq = state["q"], state["dq"]
        if how.order:
            q, dq = q[:, how.order], dq[:, how.order]
        if how.signs:
            q, dq = q * how.signs, dq * how.signs
        relative = {t.relative for t in self.contract.observation if t.kind == "joint_pos"} != {False}
        angle = q - self._pose * relative - (np.array(how.offset) if how.offset else 0.0)
        if how.turned:
            angle, dq = angle * how.turned, dq * how.turned
        made = {"joint_pos": angle, "joint_vel": dq, "sin_joint_pos": np.sin(q), "cos_joint_pos": np.cos(q)}
        frames = dict(how.frames)
        if "turn" in state:
            turn = state["turn"]
            made["gravity"] = _in_frame(turn, -turn[:, 2, :], frames.get("gravity", ""))
            for kind, source in (("ang_vel", "gyro"), ("lin_vel", "lin_vel")):
                if source in state:
                    made[kind] = _in_frame(turn, state[source], frames.get(kind, ""))
        elif "gyro" in state:
            made["ang_vel"] = state["gyro"]
        if self.log.command is not None:
            made["command"] = self.log.command
        action = self.actions(how)
        if action is not None:
            made["last_action"] = np.concatenate([np.zeros((1, action.shape[1])), action[:-1]])
        for kind, factor in how.scales:
            made[kind] = made[kind] * factor
        for kind, signs in how.axes:
            made[kind] = made[kind] * signs
        return made

    def actions(self, how: Making) -> np.ndarray | None:
        """Return the network's actions ``(N, A)``: the logged ones, or those that the targets say."""
        if self.log.action is not None:
            return self.log.action
        if self.log.target is None:
            return None
        target = self.log.target
        if how.target_order:
            target = target[:, how.target_order]
        if how.target_negated:
            target = target * how.target_signs
        move = target - self._default - (np.array(how.target_offset) if how.target_offset else 0.0)
        if how.target_signs and not how.target_negated:
            move = move * how.target_signs
        return move / (self._scale * how.target_scale)

    def targets(self, how: Making, action: np.ndarray) -> np.ndarray:
        """Return the targets ``(N, J)`` that actions ``(N, A)`` give."""
        move = action * self._scale * how.target_scale
        if how.target_signs and not how.target_negated:
            move = move * how.target_signs
        target = self._default + move + (np.array(how.target_offset) if how.target_offset else 0.0)
        if how.target_negated:
            target = target * how.target_signs
        if how.target_order:
            placed = np.empty_like(target)
            placed[:, how.target_order] = target
            return placed
        return target

    def observations(self, how: Making, rows: np.ndarray) -> np.ndarray:
        """Return the observations ``(R, O)`` at some steps, before the normaliser."""
        c, made, parts = self.contract, self.quantities(how), []
        for term, lag in c.layout:
            own = c.observation[term]
            back = own.history - 1 - lag if how.reversed_history else lag
            at = np.maximum(rows - back, 0)
            if own.kind in made:
                value = made[own.kind][at]
            elif self.log.obs is not None:
                value = self._logged_block(term, lag)[rows] / np.asarray(own.scale, float)
            else:
                value = np.zeros((len(rows), c.size_of(own)))
            parts.append(value * np.asarray(own.scale, float))
        x = np.concatenate(parts, axis=1)
        return x * how.gain + how.bias if how.gain else x

    def _logged_block(self, term: int, lag: int) -> np.ndarray:
        starts = np.cumsum([0, *(self.contract.size_of(self.contract.observation[t]) for t, _ in self.contract.layout)])
        at = self.contract.layout.index((term, lag))
        assert self.logged is not None
        return self.logged[:, starts[at] : starts[at + 1]]

    @cached_property
    def logged(self) -> np.ndarray | None:
        """The logged observations as before the normaliser ``(N, O)``; a log may have them from behind it."""
        obs, c = self.log.obs, self.contract
        if obs is None or not c.mean or obs.shape[1] != c.size:
            return obs
        unlogged = Deployed(replace(self.log, obs=None), self.policy)
        rebuilt = unlogged.observations(Making(), self.rows)
        spread = rebuilt.std(0) + 1e-3
        behind = obs * np.array(c.std) + np.array(c.mean)
        gap = lambda values: np.median(np.abs(values[self.rows] - rebuilt) / spread)  # noqa: E731
        return behind if gap(behind) < 0.5 * gap(obs) else obs

    def act(self, how: Making, x: np.ndarray) -> np.ndarray:
        """Return the network's actions for observations of a making."""
        for _ in range(how.normalised):
            x = self.policy.normalised(x)
        return self.policy.network(x)


def matrices(quat: np.ndarray) -> np.ndarray:
    """Return rotations from the body to the world ``(N, 3, 3)`` of quaternions w, x, y, z."""
    w, x, y, z = (quat / np.linalg.norm(quat, axis=1, keepdims=True)).T
    return np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
         2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
         2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1
    ).reshape(-1, 3, 3)  # fmt: skip


def _in_frame(turn: np.ndarray, body: np.ndarray, frame: str) -> np.ndarray:
    """Return vectors of the body, as a deployment with a wrong frame has them."""
    if frame == "world":
        return np.einsum("nij,nj->ni", turn, body)
    if frame == "twice":
        return np.einsum("nji,nj->ni", turn, body)
    if frame == "conjugate":
        return np.einsum("nij,nj->ni", turn, np.einsum("nij,nj->ni", turn, body))
    return body


def _held(values: np.ndarray, stop: int) -> np.ndarray:
    return np.concatenate([values[:stop], np.broadcast_to(values[stop : stop + 1], values[stop:].shape)])


# -- the search


class Search:
    """Looks for the makings that explain one link of the chain.

    Args:
        link: ``observation``: measurements to the logged observations; ``network``: measurements to actions, if
            observations were not logged; ``target``: actions to targets.
        errors: Making -> error of each output, as a share of its deviation.
    """

    def __init__(self, deployed: Deployed, link: str, joint_sides: Sequence[str]) -> None:
        self.d, self.link, self.sides = deployed, link, joint_sides
        self._errors: dict[Making, float] = {}
        self._sound = _FINE if link == "observation" else SOUND

    def residuals(self, how: Making) -> np.ndarray:
        """Return the differences from what was logged ``(R, outputs)``, in units of its deviation."""
        d, rows = self.d, self.d.rows
        if self.link == "observation":
            assert d.logged is not None
            wanted = d.logged[rows]
            return (d.observations(how, rows) - wanted) / self._spread(wanted)
        if self.link == "target":
            assert d.log.target is not None
            action = d.log.action if d.log.action is not None else d.policy(_known(d.logged))
            return (d.targets(how, action[rows]) - d.log.target[rows]) / self._spread(d.log.target[rows])
        action = d.actions(how)
        assert action is not None
        x = _known(d.logged)[rows] if self.link == "normaliser" else d.observations(how, rows)
        x = x * how.gain + how.bias if self.link == "normaliser" and how.gain else x
        return (d.act(how, x) - action[rows]) / self._spread(action[rows])

    @staticmethod
    def _spread(wanted: np.ndarray) -> np.ndarray:
        each = wanted.std(0)
        return np.maximum(each, 0.2 * np.median(each) + 1e-4)

    def error(self, how: Making) -> float:
        """Return the mean error, each part of which counts as at most 1.5."""
        if how not in self._errors:
            self._errors[how] = float(np.minimum(np.abs(self.residuals(how)), 1.5).mean())
        return self._errors[how]

    def run(self) -> tuple[list[tuple[Candidate, float]], float, float]:
        """Return what is wrong, with the share that each explains, and the errors before and after."""
        start = Making()
        before = self.error(start)
        if before < self._sound:
            return [], before, before
        chosen = self._greedy(start, before)
        if self.link in ("network", "normaliser"):
            chosen = self._with_normaliser(chosen, before)
        after = self.error(chosen[-1].making) if chosen else before
        parts, last = [], before
        for candidate in chosen:
            now = self.error(candidate.making)
            parts.append((candidate, max(0.0, (last - now) / before)))
            last = now
        return parts, before, after

    def _greedy(self, start: Making, before: float) -> list[Candidate]:
        if self.link == "normaliser":
            return []
        chosen: list[Candidate] = []
        how, error = start, before
        while error > self._sound and len(chosen) < _MOST:
            best = self._best(how)
            if best is None:
                break
            found, gained = best, error - self.error(best.making)
            if gained < max(0.12 * error, 0.4 * self._sound):
                found = self._pair(how, error)
                if found is None:
                    break
                chosen += found
            else:
                chosen.append(found)
            how, error = chosen[-1].making, self.error(chosen[-1].making)
        return chosen

    def _best(self, how: Making) -> Candidate | None:
        ranked = sorted(self.candidates(how), key=lambda c: self.error(c.making))
        refined = [r for c in ranked[:4] for r in self._refined(c, how)]
        return min([*ranked[:1], *refined], key=lambda c: self.error(c.making), default=None)

    def _pair(self, how: Making, error: float) -> list[Candidate] | None:
        """Return two candidates that explain together what none explains alone."""
        ranked = sorted(self.candidates(how), key=lambda c: self.error(c.making))
        heads: dict[str, Candidate] = {}
        for candidate in ranked:
            heads.setdefault(candidate.fault, candidate)
        pairs = []
        for first in itertools.islice(heads.values(), 6):
            second = self._best(first.making)
            if second is not None:
                pairs.append((first, second))
        best = min(pairs, key=lambda p: self.error(p[1].making), default=None)
        return [*best] if best is not None and self.error(best[1].making) < 0.6 * error else None

    def _with_normaliser(self, chosen: list[Candidate], before: float) -> list[Candidate]:
        """Return the candidates, or another normaliser if it explains more than they do."""
        error = self.error(chosen[-1].making) if chosen else before
        if error < max(SOUND, 0.1 * before):
            return chosen
        tried = []
        for base in {len(part): part for part in ([], chosen[:1], chosen)}.values():
            how = base[-1].making if base else Making()
            fitted = self._affine(how)
            tried.append([*base, Candidate("normaliser", "the observation is normalised with other numbers", fitted)])
        best = min(tried, key=lambda c: self.error(c[-1].making) * (1 + 0.1 * len(c)))
        return best if self.error(best[-1].making) < 0.5 * error else chosen

    def _affine(self, how: Making) -> Making:
        """Fit gain and bias of each entry of the observation by Gauss and Newton's steps."""
        d, rows = self.d, self.d.rows[:: 1 if self.d.contract.size < 60 else 2]
        bare = replace(how, gain=(), bias=())
        x = _known(d.logged)[rows] if self.link == "normaliser" else d.observations(bare, rows)
        action = d.actions(how)
        assert action is not None
        spread = self._spread(action[rows])
        unit = np.maximum(x.std(0), 1e-3)
        size = x.shape[1]
        theta = np.zeros(2 * size)
        damping, best = 1e-2, np.inf
        step, jacobian, error = theta, np.zeros((1, 2 * size)), np.zeros(1)
        for _ in range(14):
            trial = theta + step
            z = x * (1 + trial[:size]) + trial[size:] * unit
            r = (d.act(how, z) - action[rows]) / spread
            cost = float(np.minimum(np.abs(r), 1.5).mean())
            if cost >= best:
                damping *= 8
            elif cost < SOUND / 4 or cost > 0.995 * best:
                theta = trial
                break
            else:
                theta, best, damping = trial, cost, max(damping / 4, 1e-5)
                slope = self._slopes(how, z, unit) / spread[None, :, None]
                weight = 1.0 / np.maximum(1.0, np.abs(r))[:, :, None]
                full = np.concatenate([slope * (x / unit)[:, None, :], slope], axis=2) * weight
                jacobian, error = full.reshape(-1, 2 * size), (r * weight[:, :, 0]).ravel()
            gram = jacobian.T @ jacobian / len(jacobian)
            pull = jacobian.T @ error / len(jacobian) + 1e-6 * theta
            step = -np.linalg.solve(gram + (1e-6 + damping * np.trace(gram) / len(gram)) * np.eye(len(gram)), pull)
        return replace(how, gain=tuple(1 + theta[:size]), bias=tuple(theta[size:] * unit))

    def _slopes(self, how: Making, x: np.ndarray, unit: np.ndarray) -> np.ndarray:
        """Return the derivatives of the actions ``(R, A, O)`` after the entries, in their units."""
        size, small = x.shape[1], 1e-2
        base = self.d.act(how, x)
        shifted = np.repeat(x[None], size, 0)
        shifted[np.arange(size), :, np.arange(size)] += small * unit[:, None]
        moved = self.d.act(how, shifted.reshape(-1, size)).reshape(size, len(x), -1)
        return np.moveaxis((moved - base) / small, 0, 2)

    # -- candidates

    def candidates(self, how: Making) -> Iterator[Candidate]:
        """Return what may be wrong beside what is known already."""
        sees, acts = self.link in ("observation", "network"), self.link == "target"
        # Without logged actions, the targets are a part of the same question.
        acts = acts or (self.link == "network" and self.d.log.action is None and self.d.log.target is not None)
        ways = [w for w, has in (("observation", sees), ("action", acts), ("both", sees and acts)) if has]
        for way in ways:
            yield from self._orders(how, way)
            yield from self._signs(how, way)
            yield from self._offsets(how, way)
        if acts and how.target_scale == 1.0:
            for factor in _SCALES:
                text = f"action_scale is {factor:.3g} times the contract's"
                yield Candidate("scale", text, replace(how, target_scale=factor))
        if sees:
            yield from self._of_observations(how)

    def _orders(self, how: Making, way: str) -> Iterator[Candidate]:
        count = len(self.d.contract.joints)
        if count < 2 or (how.order and way != "action") or (how.target_order and way != "observation"):
            return
        for order in self._permutations(how, way):
            mirrored = self._mirror() == tuple(order)
            fault = "left and right" if mirrored else "joint order"
            words = "left and right are exchanged" if mirrored else "the joints are in another order"
            new = how if way == "action" else replace(how, order=tuple(order))
            new = new if way == "observation" else replace(new, target_order=tuple(order))
            yield Candidate(fault, f"{words} in {_place(way)}: {self._named(order)}", new)

    def _permutations(self, how: Making, way: str) -> Iterable[tuple[int, ...]]:
        joints = self.d.contract.joints
        count, seen = len(joints), {tuple(range(len(joints)))}
        proposals: list[Any] = []
        if self.link in ("observation", "target"):
            proposals.append(self._matched(how))
        if (mirror := self._mirror()) is not None:
            proposals.append(mirror)
        identity = list(range(count))
        proposals += [np.argsort(np.array(joints), kind="stable"), np.argsort(np.argsort(np.array(joints)))]
        if list(self.sides) and set(self.sides) == set(joints):
            there = [self.sides.index(j) for j in joints]
            proposals += [there, np.argsort(there)]
        for width in [w for w in range(2, count) if count % w == 0]:
            by_type = np.arange(count).reshape(-1, width).T.ravel()
            proposals += [by_type, np.argsort(by_type)]
            groups = np.arange(count).reshape(-1, width)
            if len(groups) <= 4:
                proposals += [groups[list(p)].ravel() for p in itertools.permutations(range(len(groups)))]
            if width <= 4:
                proposals += [groups[:, list(p)].ravel() for p in itertools.permutations(range(width))]
        proposals += [identity[::-1]]
        for i, j in itertools.combinations(range(count), 2):
            swapped = identity.copy()
            swapped[i], swapped[j] = j, i
            proposals.append(swapped)
        for proposal in proposals:
            order = tuple(int(i) for i in proposal)
            if order not in seen:
                seen.add(order)
                yield order

    def _matched(self, how: Making) -> Any:
        """Return the order in which the logged columns fit the expected ones best."""
        d, rows = self.d, self.d.rows
        if self.link == "target":
            action = d.log.action if d.log.action is not None else d.policy(_known(d.logged))
            assert d.log.target is not None
            expected, logged = d.targets(how, action[rows]), d.log.target[rows]
            return linear_sum_assignment(_distance(expected, logged))[1]
        cost = np.zeros((len(d.contract.joints),) * 2)
        made = d.quantities(how)
        for i, term in enumerate(d.contract.observation):
            if term.kind in ("joint_pos", "joint_vel"):
                lag = term.history - 1 if how.reversed_history else 0
                cost += _distance(d._logged_block(i, lag)[rows], made[term.kind][rows])
        return linear_sum_assignment(cost)[1]

    def _mirror(self) -> tuple[int, ...] | None:
        return mirror_of(self.d.contract.joints)

    def _named(self, order: Sequence[int]) -> str:
        joints = self.d.contract.joints
        moved = [(joints[i], joints[j]) for i, j in enumerate(order) if i != j]
        text = ", ".join(f"{b} in place of {a}" for a, b in moved[:2])
        return text + (f" and {len(moved) - 2} more" if len(moved) > 2 else "")

    def _signs(self, how: Making, way: str) -> Iterator[Candidate]:
        joints = self.d.contract.joints
        for i, joint in enumerate(joints):
            ones = [1.0] * len(joints)
            ones[i] = -1.0
            text = f"{joint} has the other sign in {_place(way)}"
            new = how
            if way != "action":
                seen = tuple(np.multiply(how.signs or 1.0, ones))
                turned = tuple(np.multiply(how.turned or 1.0, ones))
                if way == "observation":
                    yield Candidate("sign", text, replace(how, turned=turned))
                new = replace(how, signs=seen)
            if way != "observation":
                signs = tuple(np.multiply(how.target_signs or 1.0, ones))
                yield Candidate("sign", text, replace(new, target_signs=signs, target_negated=False))
                new = replace(new, target_signs=signs, target_negated=True)
            yield Candidate("sign", text, new)

    def _offsets(self, how: Making, way: str) -> Iterator[Candidate]:
        kinds = {t.kind for t in self.d.contract.observation}
        if (way != "action" and (how.offset or "joint_pos" not in kinds)) or (
            way != "observation" and how.target_offset
        ):
            return
        offset = self._fitted_offset(how, way)
        if offset is None or np.abs(offset).max() < 0.02:
            return
        offset = np.where(np.abs(offset) < 0.01, 0.0, offset)
        worst = int(np.argmax(np.abs(offset)))
        joint = self.d.contract.joints[worst]
        text = f"the default pose in {_place(way)} is another: by {offset[worst]:+.3f} rad at {joint}"
        yield Candidate("default pose", text, _with_offset(how, way, offset))

    def _fitted_offset(self, how: Making, way: str) -> np.ndarray | None:
        count = len(self.d.contract.joints)
        shift = np.zeros(count)
        for _ in range(1 if self.link != "network" else 3):
            base = self.residuals(_with_offset(how, way, shift))
            slopes = []
            for i in range(count):
                moved = shift.copy()
                moved[i] += 0.02
                slopes.append((self.residuals(_with_offset(how, way, moved)) - base) / 0.02)
            jacobian = np.stack(slopes, -1)
            for _ in range(4):  # robust: large residuals come from other faults
                weight = 1.0 / np.maximum(np.abs(base), 0.1)
                a = (jacobian * weight[..., None]).reshape(-1, count)
                step = np.linalg.lstsq(a.T @ jacobian.reshape(-1, count) + 1e-6 * np.eye(count),
                                       -a.T @ base.ravel(), rcond=None)[0]  # fmt: skip
                base = base + jacobian @ step
                shift = shift + step
            shift = np.clip(shift, -2.0, 2.0)
        return shift

    def _of_observations(self, how: Making) -> Iterator[Candidate]:
        d, made = self.d, self.d.quantities(how)
        kinds = [t.kind for t in d.contract.observation]
        vectors = [k for k in ("ang_vel", "gravity", "lin_vel") if k in kinds and k in made]
        words = {"world": "in the world's frame instead of the body's", "twice": "rotated into the body twice",
                 "conjugate": "rotated the wrong way"}  # fmt: skip
        for kind in vectors:
            if d.log.quat is not None and kind not in dict(how.frames):
                for frame, text in words.items():
                    fault = "gyro rotated twice" if (frame, kind) == ("twice", "ang_vel") else "world frame"
                    new = replace(how, frames=(*how.frames, (kind, frame)))
                    yield Candidate(fault, f"{kind} is {text}", new)
            if kind not in dict(how.axes):
                for signs in itertools.product((1.0, -1.0), repeat=3):
                    if min(signs) < 0:
                        new = replace(how, axes=(*how.axes, (kind, signs)))
                        yield Candidate("sign", f"{kind} has other signs: {signs}", new)
        for kind in {k for k in kinds if k in made and k not in dict(how.scales)}:
            for factor in _SCALES:
                text = f"{kind} has {factor:.3g} times the contract's scale"
                yield Candidate("scale", text, replace(how, scales=(*how.scales, (kind, factor))))
        if max(t.history for t in d.contract.observation) > 1 and not how.reversed_history:
            yield Candidate("history reversed", "the history is in the reversed order",
                            replace(how, reversed_history=True))  # fmt: skip
        if vectors and how.frozen_from == 1.0:
            for share in (0.0, *np.arange(0.05, 0.95, 0.05)):
                text = "gyro and gravity in the observation do not change any more"
                yield Candidate("frozen imu", text, replace(how, frozen_from=float(share)))
        if not how.late_s:
            period = float(np.median(np.diff(d.log.t)))
            for late_s in sorted({*_LATE_S, period, 2 * period}):
                text = f"the policy sees measurements that are {1e3 * late_s:.0f} ms older than the log's newest"
                yield Candidate("delay", text, replace(how, late_s=float(late_s)))
        if d.contract.mean and self.link == "network" and how.normalised == 1:
            yield Candidate("normaliser", "the normaliser is not applied", replace(how, normalised=0))
            yield Candidate("normaliser", "the normaliser is applied twice", replace(how, normalised=2))

    def _refined(self, c: Candidate, before: Making) -> Iterator[Candidate]:
        """Return candidates near one: another factor, another pair of joints, another time."""
        how = c.making
        if c.fault == "scale":
            action = how.target_scale != before.target_scale
            kind, factor = ("action", how.target_scale) if action else how.scales[-1]
            for f in factor * np.geomspace(0.6, 1.7, 23):
                new = replace(how, target_scale=float(f)) if action else replace(
                    how, scales=(*how.scales[:-1], (kind, float(f))))  # fmt: skip
                name = "action_scale" if action else kind
                yield Candidate("scale", f"{name} has {f:.3g} times the contract's scale", new)
        if c.fault == "frozen imu":
            for share in how.frozen_from + np.arange(-0.05, 0.051, 0.005):
                yield replace(c, making=replace(how, frozen_from=float(np.clip(share, 0.0, 0.99))))
        if c.fault == "delay":
            for late_s in how.late_s + np.arange(-0.008, 0.009, 0.002):
                text = f"the policy sees measurements that are {1e3 * late_s:.0f} ms older than the log's newest"
                yield Candidate("delay", text, replace(how, late_s=float(max(late_s, 1e-4))))
        if c.fault == "joint order" and self.link == "network":
            yield from self._descent(c, before)

    def _descent(self, c: Candidate, before: Making) -> Iterator[Candidate]:
        """Exchange pairs of joints as long as the error falls."""
        how = c.making
        both = how.order != before.order, how.target_order != before.target_order
        way = "both" if all(both) else "observation" if both[0] else "action"
        order = list(how.order if both[0] else how.target_order)
        error = self.error(how)
        for _ in range(len(order)):
            trials = []
            for i, j in itertools.combinations(range(len(order)), 2):
                new = order.copy()
                new[i], new[j] = new[j], new[i]
                made = replace(how, order=tuple(new)) if both[0] else how
                made = replace(made, target_order=tuple(new)) if both[1] else made
                trials.append((self.error(made), new, made))
            best = min(trials, key=lambda t: t[0])
            if best[0] >= error or best[1] == list(range(len(order))):
                return
            error, order, how = best
            mirrored = tuple(order) == self._mirror()
            fault = "left and right" if mirrored else "joint order"
            words = "left and right are exchanged" if mirrored else "the joints are in another order"
            yield Candidate(fault, f"{words} in {_place(way)}: {self._named(order)}", how)


def _known(values: np.ndarray | None) -> np.ndarray:
    assert values is not None
    return values


def _place(way: str) -> str:
    return {"observation": "the observation", "action": "the targets", "both": "observation and targets"}[way]


def _with_offset(how: Making, way: str, offset: np.ndarray) -> Making:
    shift = tuple(float(v) for v in offset)
    how = how if way == "action" else replace(how, offset=shift)
    return how if way == "observation" else replace(how, target_offset=shift)


def _distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return how little the columns of two arrays vary together ``(A, B)``; means, scales and signs do not count."""
    a, b = first - first.mean(0), second - second.mean(0)
    norm = np.linalg.norm(a, axis=0)[:, None] * np.linalg.norm(b, axis=0) + 1e-9
    return 1.0 - np.abs(a.T @ b) / norm


def mirror_of(joints: Sequence[str]) -> tuple[int, ...] | None:
    """Return the joint on the other side of each joint, by the names; None if a name has no counterpart."""
    pairs: dict[str, str] = {}
    for a, b in (pair.split() for pair in _SIDES):
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
    findings: list[Finding] = frozen_sensors(log)
    has_obs, has_action, has_target = log.obs is not None, log.action is not None, log.target is not None
    links = ["observation" if has_obs else "network"]
    links += ["normaliser"] if has_obs and has_action else []
    links += ["target"] if has_target and (has_action or has_obs) else []
    for link in links:
        if link == "network" and deployed.unknown:
            errors["unknown"] = float(len(deployed.unknown))
            continue
        parts, before, after = Search(deployed, link, robot_joints).run()
        errors[link], errors[f"{link}_after"] = before, after
        for candidate, share in parts:
            if share < 0.005 or after > 0.75 * before:
                continue
            question = "timing" if candidate.fault == "delay" else "contract"
            numbers = {"late_s": candidate.making.late_s} if candidate.fault == "delay" else {}
            if candidate.fault == "delay" and candidate.making.late_s < 0.012:
                continue
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
        if values is None or not moving.any():
            continue
        same = (np.diff(values, axis=0) == 0.0).all(1) & moving
        run, longest, end = 0, 0, 0
        for i, repeated in enumerate(same | ~moving):
            run = run + 1 if repeated else 0
            if run > longest:
                longest, end = run, i + 1
        seconds = float(log.state_t[end] - log.state_t[end - longest])
        if seconds > 0.5 and same[end - longest : end].sum() > 20:
            begin = float(log.state_t[end - longest])
            text = f"the IMU's {name} repeats one value for {seconds:.1f} s from {begin:.2f} s on, while joints move"
            return [Finding("frozen imu", "contract", text, 1.0, {"from_s": begin, "for_s": seconds})]
    return []
