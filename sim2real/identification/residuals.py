"""Residuals, losses and derivatives of segments: numpy on the host, around ``Rollouts.errors``.

Each evaluation solves for the initial states of the segments, so that a fit is over dynamics and delays alone (variable
projection; the derivative neglects the change of the states' slopes: Kaufman, BIT 15, 1975). Rollouts take most of the
time: the slopes of initial states are reused while parameters change little, and one rollout serves several parameters
or states if no residual depends on two of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np

from sim2real.identification.rollouts import Rollouts
from sim2real.identification.segments import Data
from sim2real.types import MjModel

mj: Any = mujoco

_STATE_STEPS = 2
"""Gauss-Newton steps of an initial state. With one, the loss of a pendulum's log jumped by 3 % where the delays changed
by 0.3 ms, with two by 0.2 %."""
_STATE_DIFFERENCE = 0.03
"""Step of finite differences by an initial state, in its prior deviation."""
_CACHED = 3
"""Cached points: a descent evaluates its end, then begins its next round there."""
_RESPONDS = 1e-9
"""Share of the largest derivative below which a residual is independent of a column; decoupled derivatives are exactly
0."""
_TRUSTED = 0.3
"""Largest error of the predicted change of the residuals, as a share of it, with which a Jacobian is corrected."""
_SEARCHED = 8
"""Fewest segments that a search simulates; at least two for each channel."""
Stacked = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Part:
    """The segments that are fitted, and the parameters.

    Attributes:
        live: Shape ``(S,)``, bool: which of the problem's fitted segments.
        present: Shape ``(P,)``, bool: which parameters; others have their values in a model without them.
    """

    live: np.ndarray
    present: np.ndarray

    @property
    def key(self) -> bytes:
        """What tells it from other parts of the problem."""
        return self.live.tobytes() + self.present.tobytes()


@dataclass(frozen=True)
class Linearised:
    """Residuals and their Jacobian at a point.

    Attributes:
        residuals: Shape ``(S, K, F)``, with the robust loss: their half square is the loss.
        jacobian: Shape ``(S, K, F, P)``: d residual / d x.
        prior: Shape ``(P, P)``: precision that priors and bounds add; the bounds' is that of a uniform distribution.
        x: Shape ``(P,)``: the point, on the parameters' scales.
        raw: Shape ``(S, K, F)``: the residuals without the robust loss.
        compared: Shape ``(S, K)``, bool: where a measurement was compared, as an exact residual is 0, too; default: in
            all places.
        loss: Half the mean square of the residuals, plus the priors.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray
    x: np.ndarray
    raw: np.ndarray
    compared: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))
    loss: float = np.nan

    def __post_init__(self) -> None:
        if not self.compared.size:
            object.__setattr__(self, "compared", np.ones(self.residuals.shape[:2], bool))

    @property
    def count(self) -> int:
        """Number of residuals."""
        return int(self.compared.sum()) * self.residuals.shape[-1]

    def of(self, segments: np.ndarray) -> Linearised:
        """Return some of the segments, ``(S,)`` bool or numbers."""
        rows = (a[segments] for a in (self.residuals, self.jacobian, self.raw, self.compared))
        r, J, raw, compared = rows
        return replace(self, residuals=r, jacobian=J, raw=raw, compared=compared)


class _States(NamedTuple):
    """Initial states of segments; leaves ``(R, ...)``.

    Attributes:
        shift: Shape ``(R, n)``: distance from the estimate from the log, in deviations of the prior.
        slope: Shape ``(R, n, K, F)``: d residual / d shift.
        residuals: Shape ``(R, K, F)``: the residuals there.
    """

    shift: np.ndarray
    slope: np.ndarray
    residuals: np.ndarray


class Groups:
    """Columns of a Jacobian that finite differences move together, as no residual depends on two of them.

    Method of Curtis, Powell and Reid (J. Inst. Maths Applics 13, 1974). Joints of separate trees move independently, so
    the motors' strengths of four legs need one rollout.

    Args:
        apart: Whether only bodies couple joints; otherwise each column is moved alone.
        by_tree: Whether a column belongs to all residuals of its tree, as states do that couple at other points.
    """

    def __init__(self, apart: bool, by_tree: bool = False) -> None:
        self._apart, self._by_tree, self._belongs = apart, by_tree, np.zeros((0, 0), bool)

    def members(self, columns: Sequence[int]) -> list[list[int]]:
        """Return the groups of some columns; each alone before the first Jacobian is known."""
        if not self._belongs.size:
            return [[c] for c in columns]
        groups: list[tuple[list[int], np.ndarray]] = []
        for c in columns:
            belongs = self._belongs[c]
            free = next((g for g in groups if not (g[1] & belongs).any()), None)
            if free is None:
                groups.append(([c], belongs.copy()))
            else:
                free[0].append(c)
                np.logical_or(free[1], belongs, out=free[1])
        return [members for members, _ in groups]

    def spread(self, changes: np.ndarray, groups: Sequence[Sequence[int]], size: int) -> np.ndarray:
        """Return derivatives ``(..., F, size)`` from those along groups ``(G, ..., F)``; the first ones form groups."""
        J = np.zeros((*changes.shape[1:], size))
        for change, members in zip(changes, groups, strict=True):
            for c in members:
                J[..., c] = change if len(members) == 1 else np.where(self._belongs[c], change, 0.0)
        if self._apart and not self._belongs.size:
            self._belongs = self._found(np.abs(J).max(axis=tuple(range(J.ndim - 2))).T)
        return J

    def _found(self, slope: np.ndarray) -> np.ndarray:
        """Return which residuals belong to each column ``(n, F)``, bool, from the largest derivatives ``(n, F)``."""
        belongs = slope > _RESPONDS * slope.max(axis=1, keepdims=True)
        if self._by_tree:
            for _ in range(len(belongs)):  # columns that share a residual share all of them
                shares = (belongs.astype(int) @ belongs.T.astype(int)) > 0
                belongs = (shares.astype(int) @ belongs.astype(int)) > 0
        # A column without effect at this point may have one elsewhere: it is moved alone.
        belongs[~belongs.any(axis=1)] = True
        return belongs


def trees_are_apart(model: MjModel | None) -> bool:
    """Return whether only bodies couple joints: there is no contact, equality or tendon."""
    if model is None:
        return False
    contacts = model.opt.disableflags & mj.mjtDisableBit.mjDSBL_CONTACT == 0
    touching = contacts and (model.npair > 0 or bool(np.any(model.geom_contype) and np.any(model.geom_conaffinity)))
    return model.ntree > 1 and not touching and model.neq == 0 and model.ntendon == 0


class Residuals:
    """The residuals of the fitted segments of a problem.

    Args:
        train: Numbers of the fitted segments.
        ts: Shape ``(E, K)``: time of each measurement [s]; -1 without a comparison.
        like: Residuals of the same model, whose groups are shared.

    Attributes:
        precision: Relative change of the loss below which the noise of finite differences dominates: a round keeps the
            slopes of initial states, so near the minimum its slope differs from the loss's.
    """

    def __init__(
        self, rollouts: Rollouts, data: Data, train: np.ndarray, ts: np.ndarray, like: Residuals | None = None
    ) -> None:
        self._rollouts, self._data, self._train, self._ts = rollouts, data, train, ts
        self._table, self._config = rollouts.table, rollouts.config
        self._n, self._free = len(rollouts.prior), rollouts.config.initial_state == "free"
        self.precision = 1e-4 if self._free else 1e-5
        apart, compiled = trees_are_apart(rollouts.engine.model), rollouts.engine.model is None
        self._groups: Groups = like._groups if like else Groups(apart)
        # Joints of a compiled world may act on each other at other points: its groups are for steps alone.
        self._step_groups: Groups = like._step_groups if like else Groups(True) if compiled else self._groups
        self._state_groups: Groups = like._state_groups if like else Groups(apart, by_tree=True)
        self._last_states: list[tuple[bytes, bool, _States]] = []
        self._last: list[tuple[np.ndarray, Part, Linearised, np.ndarray]] = []

    # -- what a fit asks for

    def linearise(self, x: np.ndarray, part: Part) -> Linearised:
        """Return the residuals of the fitted segments and their derivatives at ``x (P,)``; the last points are cached.

        Segments that are not live have residuals and derivatives 0, and are not compared.
        """
        for point, known, there, _ in self._last:
            if np.array_equal(point, x) and known.key == part.key:
                return there
        states = self._fitted_states(x, part, fresh=True)
        raw = self._raw(x[None], states, part)[0]
        groups = self._groups.members(np.flatnonzero(part.present).tolist())
        low, high = (self._moved(x, groups, sign) for sign in (-1.0, 1.0))
        both = self._raw(np.concatenate([high, low]), states, part)
        width = np.clip(x + self._step, None, self._table.high) - np.clip(x - self._step, self._table.low, None)
        J = self._groups.spread(both[: len(groups)] - both[len(groups) :], groups, len(x)) / width
        r, slope = robust(raw, self._config.reach)
        prior, of_prior = self._prior(x), self._prior_slope(x)
        precision = of_prior.T @ of_prior + np.diag(12.0 / self._table.span**2)
        loss = self._loss(r, prior, part)
        there = Linearised(r, slope[..., None] * J, precision, x, raw, self.compared(part), loss)
        self._last = [*self._last, (x.copy(), part, there, J)][-_CACHED:]
        return there

    def loss(self, x: np.ndarray, part: Part) -> float:
        """Return the loss at ``x (P,)``, with initial states linearised there."""
        return float(self.losses(x[None], x, part)[0])

    def losses(self, candidates: np.ndarray, middle: np.ndarray, part: Part) -> np.ndarray:
        """Return the loss of each candidate ``(N, P)``, with initial states linearised at ``middle (P,)``."""
        raw = self._raw(candidates, self._fitted_states(middle, part), part)
        rows = zip(robust(raw, self._config.reach)[0], candidates, strict=True)
        return np.array([self._loss(r, self._prior(x), part) for r, x in rows])

    def near(self, x: np.ndarray, part: Part, slopes: int | None = None) -> Nearby:
        """Return the residuals near ``x`` for a descent; initial states keep their slopes at ``x``.

        They are without the robust loss, and those of the priors follow; their Jacobian is by one-sided differences.

        Args:
            slopes: Most Jacobians that are computed; default: as many as the steps need.
        """
        states = self._fitted_states(x, part)

        def value(y: np.ndarray) -> np.ndarray:
            return np.concatenate([self._raw(y[None], states, part)[0].reshape(-1), self._prior(y)])

        def slope(y: np.ndarray) -> np.ndarray:
            sign = np.where(y + self._step > self._table.high, -1.0, 1.0)
            groups = self._step_groups.members(np.flatnonzero(part.present).tolist())
            moved = self._moved(y, groups, sign)
            raw = self._raw(np.concatenate([y[None], moved]), states, part)
            J = self._step_groups.spread(raw[1:] - raw[0], groups, len(y)) / (sign * self._step)
            return np.concatenate([J.reshape(-1, len(y)), self._prior_slope(y)])

        return Nearby(value, slope, self._table.span, self._known_nearby(x, part), slopes)

    def predict(
        self, values: Mapping[str, Any], segments: np.ndarray, fit_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals ``(R, K, F)`` of segments with states fitted to their first parts, and the states.

        Args:
            values: Parameters by name, ``(R, ...)``.
            fit_s: Shape ``(R,)``: lengths of the first parts [s].
        """
        arrays, still = {n: np.asarray(v, np.float64) for n, v in values.items()}, np.zeros((len(segments), self._n))
        if self._free:
            fitted = self._best_states(arrays, segments, fit_s, _STATE_STEPS + 1)
            still, errors = fitted.shift, fitted.residuals
        else:
            errors = self.errors(arrays, segments, still)
        return errors, self._rollouts.starts(arrays, segments, still, self._data)

    def robustly(self, points: np.ndarray, x: np.ndarray, part: Part) -> np.ndarray:
        """Return the robust residuals ``(N, S, K, F)`` at points ``(N, P)``; initial states are linearised at ``x``."""
        raw = self._raw(points, self._fitted_states(x, part, fresh=True), part)
        return robust(raw, self._config.reach)[0]

    def liveliest(self, part: Part, most: int | None = None) -> Part:
        """Return the segments in which the channels move most, of each channel in turn.

        If recordings are few, one segment of each is among them.

        Args:
            most: Number of segments; default: as many as suffice for a start.
        """
        live = np.flatnonzero(part.live)
        segments, reaches = self._train[live], []
        counts = self._ts[segments] >= 0.0
        for channel in self._rollouts.model.channels:
            measured = channel.of(np.asarray(self._data.measured[channel.position])[segments])[:, : counts.shape[1]]
            reaches.append(np.ptp(np.where(counts, measured, measured[:, :1]), axis=1))
        order = np.argsort(-np.array(reaches), axis=1).T.reshape(-1)  # the best of each channel, the second best, ...
        recordings = np.asarray(self._data.recording)[segments]
        firsts = order[np.unique(recordings[order], return_index=True)[1]]
        count = most or max(_SEARCHED, 2 * len(reaches))
        turns = dict.fromkeys([*(firsts if len(firsts) <= count else ()), *order.tolist()])
        chosen = np.zeros(len(part.live), bool)
        chosen[live[list(turns)[:count]]] = True
        return Part(chosen, part.present)

    def compared(self, part: Part) -> np.ndarray:
        """Return where measurements of live segments are compared, ``(S, K)``, bool."""
        return (self._ts[self._train] >= 0.0) & part.live[:, None]

    def errors(self, values: Mapping[str, np.ndarray], segments: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return ``Rollouts.errors`` without the padding of the programs."""
        found = self._rollouts.errors(values, segments, shift, self._data)[:, : self._ts.shape[1]]
        return np.where((self._ts[segments] >= 0.0)[..., None], found, 0.0)

    # -- finite differences by parameters

    @property
    def _step(self) -> np.ndarray:
        return self._config.difference * self._table.span

    def _moved(self, x: np.ndarray, groups: Sequence[Sequence[int]], sign: float | np.ndarray) -> np.ndarray:
        """Return points with each group of parameters moved by a step, within the bounds, ``(G, P)``."""
        moved = np.repeat(x[None], len(groups), axis=0)
        to = np.clip(x + sign * self._step, self._table.low, self._table.high)
        for row, group in zip(moved, groups, strict=True):
            row[group] = to[group]
        return moved

    def _known_nearby(self, x: np.ndarray, part: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return the cached Jacobian next to a point that covers its segments and parameters; None without one."""

        def covers(known: Part) -> bool:
            return not ((part.live & ~known.live).any() or (part.present & ~known.present).any())

        found = [(point, there, J) for point, known, there, J in self._last if covers(known)]
        if not found:
            return None
        span = self._table.span
        point, there, J = min(found, key=lambda row: float(np.linalg.norm(((row[0] - x) / span)[part.present])))
        r = np.where(part.live[:, None, None], there.raw, 0.0).reshape(-1)
        J = np.where(part.live[:, None, None, None] & part.present, J, 0.0).reshape(-1, len(x))
        start = np.where(part.present, point, x)
        return start, np.concatenate([r, self._prior(start)]), np.concatenate([J, self._prior_slope(start)])

    def _prior(self, x: np.ndarray) -> np.ndarray:
        return self._table.prior_residuals(x)

    def _prior_slope(self, x: np.ndarray) -> np.ndarray:
        moves, h = np.eye(len(x)), 1e-3 * self._table.span
        rows = [(self._prior(x + h[i] * m) - self._prior(x - h[i] * m)) / (2.0 * h[i]) for i, m in enumerate(moves)]
        return np.stack(rows, axis=-1) if rows else np.zeros((0, 0))

    def _loss(self, r: np.ndarray, prior: np.ndarray, part: Part) -> float:
        count = max(int(self.compared(part).sum()) * r.shape[-1], 1)
        every = max(int((self._ts[self._train] >= 0.0).sum()) * r.shape[-1], 1)
        return 0.5 * (float(np.sum(r**2)) / count + float(np.sum(prior**2)) / every)

    # -- residuals at the best initial states

    def _raw(self, x: np.ndarray, states: _States | None, part: Part) -> np.ndarray:
        """Return the residuals without the robust loss at points ``(N, P)``, ``(N, S, K, F)``."""
        return self._projected(self._table.decode(x, part.present), states, part)

    def _projected(self, values: Mapping[str, np.ndarray], states: _States | None, part: Part) -> np.ndarray:
        """Return residuals ``(N, S, K, F)`` at the best initial states near ``states``; 0 in segments left out."""
        # Roll out the live segments for all copies.
        live = np.flatnonzero(part.live)
        segments, copies = self._train[live], len(next(iter(values.values())))
        spread = {n: np.repeat(v, len(live), axis=0) for n, v in values.items()}
        shift = np.zeros((len(live), self._n)) if states is None else states.shift
        error = self.errors(spread, np.tile(segments, copies), np.tile(shift, (copies, 1)))
        error = error.reshape(copies, len(live), *error.shape[1:])
        # Move each initial state to its optimum along the linearisation.
        if states is not None:
            counts = (self._ts[segments] >= 0.0)[..., None]
            for row in error:
                step = _next_shift(states._replace(residuals=row.copy()), counts) - shift
                row += np.einsum("sn,snkf->skf", step, states.slope)
        whole = np.zeros((copies, len(part.live), *error.shape[2:]))
        whole[:, live] = error
        return whole

    # -- initial states

    def _fitted_states(self, x: np.ndarray, part: Part, fresh: bool = False) -> _States | None:
        """Return the initial states of the live segments; None if they are not fitted.

        Args:
            fresh: Whether the slopes are computed at the fitted states.
        """
        if not self._free:
            return None
        key = x.tobytes() + part.key
        for point, is_fresh, states in self._last_states:
            if point == key and is_fresh >= fresh:
                return states
        segments = self._train[part.live]
        values = {n: np.repeat(v, len(segments), axis=0) for n, v in self._table.decode(x[None], part.present).items()}
        if fresh and (states := self._fitted_states(x, part)):
            states = states._replace(slope=self._slopes(values, segments, states.shift)[0])
        else:
            states = self._best_states(values, segments, np.full(len(segments), np.inf), _STATE_STEPS - 1)
        self._last_states = [(key, fresh, states), *self._last_states[: _CACHED - 1]]
        return states

    def _best_states(
        self, values: Mapping[str, np.ndarray], segments: np.ndarray, fit_s: np.ndarray, steps: int
    ) -> _States:
        """Fit initial states by Gauss-Newton steps that share the slopes at no shift; return the best point of each.

        Args:
            fit_s: Shape ``(R,)``: length of the first part of each segment, to which its state is fitted [s].
        """
        # Linearise at the estimate from the log.
        still = np.zeros((len(segments), self._n))
        slope, errors = self._slopes(values, segments, still)
        ts = self._ts[segments]
        counts = ((ts >= 0.0) & (ts <= fit_s[:, None]))[..., None]
        best = _States(still, slope, errors)
        least, candidate = _state_cost(best, counts), _next_shift(best, counts)
        # Step with these slopes, and keep the best point.
        for _ in range(steps):
            here = _States(candidate, slope, self.errors(values, segments, candidate))
            cost = _state_cost(here, counts)
            better = cost < least
            shift = np.where(better[:, None], here.shift, best.shift)
            residuals = np.where(better[:, None, None], here.residuals, best.residuals)
            best, least = _States(shift, slope, residuals), np.where(better, cost, least)
            # Near kinks, such as sticking friction, a full step may increase the cost: go half way back.
            candidate = np.where(better[:, None], _next_shift(best, counts), (candidate + shift) / 2.0)
        return best

    def _slopes(
        self, values: Mapping[str, np.ndarray], segments: np.ndarray, shift: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return slopes ``(R, n, K, F)`` by initial states at shifts ``(R, n)``, and residuals ``(R, K, F)``."""
        groups = self._state_groups.members(range(self._n))
        member = np.array([[i in group for i in range(self._n)] for group in groups], float)
        moves = _STATE_DIFFERENCE * np.concatenate([np.zeros((1, self._n)), member, -member])
        spread = {k: np.repeat(v, len(moves), axis=0) for k, v in values.items()}
        shifts = (shift[:, None] + moves).reshape(-1, self._n)
        errors = self.errors(spread, np.repeat(segments, len(moves)), shifts)
        errors = np.moveaxis(errors.reshape(len(segments), len(moves), *errors.shape[1:]), 1, 0)
        changes = (errors[1 : len(groups) + 1] - errors[len(groups) + 1 :]) / (2.0 * _STATE_DIFFERENCE)
        return np.moveaxis(self._state_groups.spread(changes, groups, self._n), -1, 1), errors[0]


def _next_shift(at: _States, counts: np.ndarray) -> np.ndarray:
    """Return the shifts ``(R, n)`` after a Gauss-Newton step.

    Args:
        counts: Shape ``(R, K, 1)``, bool: which measurements count.
    """
    J = np.where(counts[:, None], at.slope, 0.0).reshape(*at.slope.shape[:2], -1)
    r = np.where(counts, at.residuals, 0.0).reshape(len(J), -1)
    H = J @ J.transpose(0, 2, 1) + np.eye(J.shape[1])
    pull = np.einsum("rnk,rk->rn", J, r) + at.shift
    lost = ~(np.isfinite(H).all(axis=(1, 2)) & np.isfinite(pull).all(axis=1))  # what diverged stays
    H[lost], pull[lost] = np.eye(J.shape[1]), 0.0
    return at.shift - np.linalg.solve(H, pull[..., None])[..., 0]


def _state_cost(at: _States, counts: np.ndarray) -> np.ndarray:
    return np.sum(np.where(counts, at.residuals, 0.0) ** 2, axis=(1, 2)) + np.sum(at.shift**2, axis=1)


def robust(raw: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals whose half square is a robust loss of the given ones, and their derivative.

    The loss is scipy's ``soft_l1``: squared below ``reach``, linear far above it.
    """
    root = np.hypot(1.0, raw / reach)  # a square may overflow to infinity, which would make the residual 0
    share = np.sqrt(2.0 / (root + 1.0))
    return raw * share, 1.0 / (root * share)


class Nearby:
    """Residuals near a point, and their Jacobian, which is corrected after each step, and computed again if that fails.

    Broyden's rank-one correction is exact along the last step (Math. Comp. 19, 1965).

    Args:
        value: Residuals ``(N,)`` at a point ``(P,)``.
        slope: Their Jacobian ``(N, P)``.
        scale: Shape ``(P,)``: length of a step of each parameter that counts as much as one of another.
        known: A point nearby, the residuals and the Jacobian there, which is corrected for the first point, too.
        most: Most Jacobians that are computed; then each is corrected. Default: as many as needed.
    """

    def __init__(
        self,
        value: Stacked,
        slope: Stacked,
        scale: np.ndarray | float = 1.0,
        known: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
        most: int | None = None,
    ) -> None:
        self._value, self._slope, self._scale = value, slope, scale
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # the point of the last evaluation, and the residuals
        self._known, self._left, self._computed = known, np.inf if most is None else most, False

    def residuals(self, y: np.ndarray) -> np.ndarray:
        """Return the residuals at a point."""
        if self._last is None or not np.array_equal(self._last[0], y):
            self._last = (y.copy(), self._value(y))
        return self._last[1]

    def jacobian(self, y: np.ndarray) -> np.ndarray:
        """Return the Jacobian at the point of a step, or at the point of the last one."""
        if self._known is not None and np.array_equal(self._known[0], y):
            return self._known[2]
        r, J = self.residuals(y), None
        if self._known is not None:
            J = _updated(*self._known, y, r, self._scale, _TRUSTED if self._left > 0 else np.inf)
        self._computed = J is None
        self._known = (y.copy(), r, self._compute(y) if J is None else J)
        return self._known[2]

    def renew(self, y: np.ndarray) -> bool:
        """Compute the Jacobian at the point of the last step; return False if that was done, or may not be."""
        if self._computed or self._left <= 0:
            return False
        self._computed = True
        self._known = (y.copy(), self.residuals(y), self._compute(y))
        return True

    def _compute(self, y: np.ndarray) -> np.ndarray:
        self._left -= 1
        return self._slope(y)


def _updated(
    point: np.ndarray,
    before: np.ndarray,
    J: np.ndarray,
    y: np.ndarray,
    r: np.ndarray,
    scale: np.ndarray | float,
    trusted: float,
) -> np.ndarray | None:
    """Return the corrected Jacobian after a step; None if the old one did not predict the step."""
    step = y - point
    expected = J @ step
    missed = r - before - expected
    direction = step / scale**2
    length = float(step @ direction)
    if length == 0.0:
        return J
    if not np.linalg.norm(missed) <= trusted * np.linalg.norm(expected):
        return None
    return J + np.outer(missed, direction / length)
