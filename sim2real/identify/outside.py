"""Residuals on C MuJoCo: numpy on the host, between a program that makes the controls and one that reads the sensor.

Both programs are small and hold no callback, so that they stay in a compilation cache. Rollouts take the time: a
segment's initial state keeps its derivatives while parameters move little, and padded segments are not rolled out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.identify.engine import CRollouts, Outside
from sim2real.identify.evaluator import Stacked, replaced
from sim2real.identify.programs import OnCompile
from sim2real.identify.residuals import STATE_DIFFERENCE, InitialState, LinearisedSegments, SegmentResiduals
from sim2real.identify.robust import tamed
from sim2real.identify.segments import Data
from sim2real.identify.sizes import padded

_COPIES = 128
"""Copies that one call of the two programs holds: one size compiles once."""
_STEPS = 2
"""Gauss-Newton steps of an initial state; they share the derivatives of the first point."""


class OutsideEvaluator:
    """Evaluates residuals on C; an ``Evaluator``.

    Args:
        residuals: The residuals.
        rollouts: C.
    """

    precision = 1e-4

    def __init__(self, residuals: SegmentResiduals, rollouts: CRollouts) -> None:
        self._residuals, self._rollouts = residuals, rollouts
        self._n, self._prior = len(residuals.prior), np.asarray(residuals.prior, np.float64)
        self._free = residuals.config.initial_state == "free"
        self.fresh = not self._free
        self._last: tuple[bytes, Data, LinearisedSegments] | None = None

    def linearised(self, z: np.ndarray, data: Data, on_compile: OnCompile | None = None) -> LinearisedSegments:
        """See ``Evaluator``; the last point is kept, since several judgements of an estimate begin there."""
        del on_compile  # both programs compile within two seconds
        if self._last is None or self._last[0] != z.tobytes() or self._last[1] is not data:
            self._last = z.tobytes(), data, self._linearised(z, data)
        return self._last[2]

    def loss(self, z: np.ndarray, data: Data, on_compile: OnCompile | None = None) -> float:
        """See ``Evaluator``."""
        del on_compile
        return float(self.losses(z[None], z, data)[0])

    def _linearised(self, z: np.ndarray, data: Data) -> LinearisedSegments:
        states = self._states(z, data, again=True)
        raw = self._raw(z[None], states, data)[0]
        J = self._slope(z, states, data)
        r, slope = self._tamed(raw), self._tamed_slope(raw)
        prior, of_prior = self._of_prior(z)
        loss = self._loss(r, prior, data)
        return LinearisedSegments(r, slope[..., None] * J, raw, prior, of_prior, loss)

    def around(self, z: np.ndarray, data: Data) -> tuple[Stacked, Stacked]:
        """See ``Evaluator``: initial states keep the derivatives that they have at ``z``.

        Differences are one-sided: a descent needs half the rollouts, and ends where the loss does.
        """
        states = self._states(z, data)

        def value(y: np.ndarray) -> np.ndarray:
            r = self._tamed(self._raw(y[None], states, data)[0])
            return np.concatenate([r.reshape(-1), self._of_prior(y)[0]])

        def slope(y: np.ndarray) -> np.ndarray:
            moved = self._moves(y, data)
            raw = self._raw(np.concatenate([y[None], y + moved]), states, data)
            J = self._tamed_slope(raw[0])[..., None] * self._by_parameter(raw[1:] - raw[0], data, y.size)
            return np.concatenate([J.reshape(-1, y.size), self._of_prior(y)[1]])

        return value, slope

    def losses(self, candidates: np.ndarray, around: np.ndarray, data: Data) -> np.ndarray:
        """See ``Evaluator``."""
        return self.losses_with(candidates, self._states(around, data), data)

    def searched(self, data: Data) -> Any:
        """See ``Evaluator``: ``HostLosses``; a block of generations keeps the initial states of its first."""
        states: list[InitialState | None] = [None]

        def losses(candidates: np.ndarray, around: np.ndarray, pick: np.ndarray | None, fresh: bool) -> np.ndarray:
            part = data
            if pick is not None:
                weight = np.zeros(len(data.fitted), np.float32)
                weight[pick] = 1.0
                part = data._replace(weight=weight)
            if fresh:
                states[0] = self._states(around, data)
            return self.losses_with(candidates, states[0], part)

        return losses

    def losses_with(self, candidates: np.ndarray, states: InitialState | None, data: Data) -> np.ndarray:
        """Return the loss of each candidate, ``(N,)``.

        Args:
            candidates: Shape ``(N, P)``.
            states: Their initial states, linearised before; None: they are not fitted.
            data: What is fitted.
        """
        raw = self._raw(candidates, states, data)
        priors = [self._of_prior(z)[0] for z in candidates]
        return np.array([self._loss(self._tamed(r), p, data) for r, p in zip(raw, priors, strict=True)])

    def predict(self, values: Any, eps: np.ndarray, fit_s: np.ndarray, data: Data) -> np.ndarray:
        """See ``Evaluator``."""
        own = {n: np.asarray(v, np.float32) for n, v in values.items()}
        if not self._free:
            return self._errors(own, eps, np.zeros((len(eps), self._n)), data)
        return self._fitted(own, np.asarray(eps), fit_s, data, _STEPS + 1).residuals

    def with_values(self, z: np.ndarray, rows: np.ndarray, data: Data) -> np.ndarray:
        """See ``Evaluator``."""
        program = self._residuals.program(
            "replaced", jax.vmap(lambda z, row: replaced(self._residuals, z, row), (None, 0))
        )
        values = jax.tree_util.tree_map(np.asarray, program(_single(z), _single(rows)))
        return self._tamed(self._projected(values, self._states(z, data, again=True), data))

    def _states(self, z: np.ndarray, data: Data, again: bool = False) -> InitialState | None:
        """Return the initial states of the fitted segments, leaves ``(S, ...)``; None where they are not fitted.

        ``again`` takes the derivatives once more at the states that were found.
        """
        if not self._free:
            return None
        live = np.flatnonzero(np.asarray(data.weight) > 0.0)
        segments = np.asarray(data.fitted)[live]
        values = {n: np.repeat(v, len(live), axis=0) for n, v in self._decoded(z[None], data).items()}
        found = self._fitted(values, segments, np.full(len(live), float(data.length_s)), data, 1)
        if again:
            found = found._replace(slope=self._slopes(values, segments, found.shift, data)[0])
        whole = [np.zeros((len(data.fitted), *leaf.shape[1:])) for leaf in found]
        for leaf, own in zip(whole, found, strict=True):
            leaf[live] = own
        return InitialState(*whole)

    def _fitted(
        self, values: Mapping[str, np.ndarray], eps: np.ndarray, fit_s: np.ndarray, data: Data, steps: int
    ) -> InitialState:
        """Fit the initial states of segments ``eps (R,)``; return shifts, derivatives at no shift, and residuals.

        The residuals are those at the best of the points that the steps lead to.
        """
        still = np.zeros((len(eps), self._n))
        slope, errors = self._slopes(values, eps, still, data)
        ts = np.asarray(data.ts)[eps]
        counts = ((ts >= 0.0) & (ts <= fit_s[:, None]))[..., None]
        best = InitialState(still, slope, errors)
        least, candidate = self._cost(best, counts), self._next(best, counts)
        for _ in range(steps):
            here = InitialState(candidate, slope, self._errors(values, eps, candidate, data))
            cost = self._cost(here, counts)
            better = cost < least
            shift = np.where(better[:, None], here.shift, best.shift)
            residuals = np.where(better[:, None, None], here.residuals, best.residuals)
            best, least = InitialState(shift, slope, residuals), np.where(better, cost, least)
            # Near kinks, such as friction that sticks, a whole step may make it worse.
            candidate = np.where(better[:, None], self._next(best, counts), (candidate + shift) / 2.0)
        return best

    def _slopes(
        self, values: Mapping[str, np.ndarray], eps: np.ndarray, shift: np.ndarray, data: Data
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives ``(R, n, K, F)`` by initial states at shifts ``(R, n)``, and residuals ``(R, K, F)``."""
        n, count = self._n, len(eps)
        moves = STATE_DIFFERENCE * np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
        spread = {k: np.repeat(v, len(moves), axis=0) for k, v in values.items()}
        shifts = (shift[:, None] + moves).reshape(-1, n)
        errors = self._errors(spread, np.repeat(eps, len(moves)), shifts, data)
        errors = errors.reshape(count, len(moves), *errors.shape[1:])
        return (errors[:, 1 : n + 1] - errors[:, n + 1 :]) / (2.0 * STATE_DIFFERENCE), errors[:, 0]

    @staticmethod
    def _cost(at: InitialState, counts: np.ndarray) -> np.ndarray:
        return np.sum(np.where(counts, at.residuals, 0.0) ** 2, axis=(1, 2)) + np.sum(at.shift**2, axis=1)

    @staticmethod
    def _next(at: InitialState, counts: np.ndarray) -> np.ndarray:
        """Return the shifts ``(R, n)`` after a Gauss-Newton step."""
        J = np.where(counts[:, None], at.slope, 0.0).reshape(*at.slope.shape[:2], -1)
        r = np.where(counts, at.residuals, 0.0).reshape(len(J), -1)
        H = J @ J.transpose(0, 2, 1) + np.eye(J.shape[1])
        pull = np.einsum("rnk,rk->rn", J, r) + at.shift
        return at.shift - np.linalg.solve(np.nan_to_num(H), np.nan_to_num(pull)[..., None])[..., 0]

    def _raw(self, z: np.ndarray, states: InitialState | None, data: Data) -> np.ndarray:
        """Return the residuals without the robust loss at points ``(N, P)``, ``(N, S, K, F)``."""
        return self._projected(self._decoded(z, data), states, data)

    def _projected(self, values: Mapping[str, np.ndarray], states: InitialState | None, data: Data) -> np.ndarray:
        """Return residuals ``(N, S, K, F)`` at the best initial states near ``states``; 0 where nothing has weight."""
        live = np.flatnonzero(np.asarray(data.weight) > 0.0)
        segments, copies = np.asarray(data.fitted)[live], len(next(iter(values.values())))
        spread = {n: np.repeat(v, len(live), axis=0) for n, v in values.items()}
        shift = np.zeros((len(live), self._n)) if states is None else states.shift[live]
        error = self._errors(spread, np.tile(segments, copies), np.tile(shift, (copies, 1)), data)
        error = error.reshape(copies, len(live), *error.shape[1:])
        if states is not None:
            counts = (np.asarray(data.ts)[segments] >= 0.0)[..., None]
            for row in error:
                own = InitialState(shift, states.slope[live], row.copy())
                row += np.einsum("sn,snkf->skf", self._next(own, counts) - shift, own.slope)
        whole = np.zeros((copies, len(data.fitted), *error.shape[2:]))
        whole[:, live] = error
        return whole

    def _slope(self, z: np.ndarray, states: InitialState | None, data: Data) -> np.ndarray:
        """Return d residual / d z without the robust loss, ``(S, K, F, P)``, by central differences."""
        moves = self._moves(z, data)
        raw = self._raw(np.concatenate([z + moves, z - moves]), states, data)
        return self._by_parameter((raw[: len(moves)] - raw[len(moves) :]) / 2.0, data, z.size)

    def _moves(self, z: np.ndarray, data: Data) -> np.ndarray:
        """Return the steps of finite differences, one row for each parameter that is part of the model."""
        return self._residuals.config.difference * np.eye(z.size)[np.asarray(data.kept)]

    def _by_parameter(self, changes: np.ndarray, data: Data, size: int) -> np.ndarray:
        """Return derivatives ``(S, K, F, P)`` from the changes of the residuals by each of ``_moves``."""
        J = np.zeros((*changes.shape[1:], size))
        J[..., np.asarray(data.kept)] = np.moveaxis(changes, 0, -1) / self._residuals.config.difference
        return J

    def _errors(self, values: Mapping[str, np.ndarray], eps: np.ndarray, shift: np.ndarray, data: Data) -> np.ndarray:
        """Return the residuals of segments ``eps (N,)`` with shifted initial states ``(N, n)``, ``(N, K, F)``."""
        own = self._residuals
        before = own.program("inputs", jax.vmap(own.inputs, (0, 0, 0, None)))
        after = own.program("errors", jax.vmap(own.errors, (0, 0, 0, 0, None)))
        found = []
        for first in range(0, len(eps), _COPIES):
            rows = slice(first, first + _COPIES)
            count = len(eps[rows])
            part = {n: np.asarray(v[rows], np.float32) for n, v in values.items()}
            shifts = np.asarray(shift[rows] * self._prior, np.float32)
            given = padded((part, np.asarray(eps[rows], np.int32), shifts), _COPIES)
            inputs: Outside = jax.tree_util.tree_map(lambda a, n=count: np.asarray(a)[:n], before(*given, data))
            moved = padded(tuple(a.astype(np.float32) for a in self._rollouts.step(inputs)), _COPIES)
            found.append(np.asarray(after(*given, moved, data), np.float64)[:count])
        return np.concatenate(found)

    def _decoded(self, z: np.ndarray, data: Data) -> dict[str, np.ndarray]:
        decode = self._residuals.program("decode", jax.vmap(self._residuals.table.decode, (0, None)))
        points = _single(padded(z, -(-len(z) // _COPIES) * _COPIES))
        return {n: np.asarray(v)[: len(z)] for n, v in decode(points, data.kept).items()}

    def _of_prior(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        of_prior = self._residuals.table.prior_residuals
        program = self._residuals.program("prior", lambda z: (of_prior(z), jax.jacfwd(of_prior)(z)))
        value, slope = (np.asarray(a, np.float64) for a in program(_single(z)))
        return value, slope

    def _loss(self, r: np.ndarray, prior: np.ndarray, data: Data) -> float:
        compared = (np.asarray(data.ts)[np.asarray(data.fitted)] >= 0.0) & (np.asarray(data.weight)[:, None] > 0.0)
        share = float(np.sum(prior**2)) / float(data.count)
        return 0.5 * (float(np.sum(r**2)) / max(int(compared.sum()) * r.shape[-1], 1) + share)

    def _tamed(self, raw: np.ndarray) -> np.ndarray:
        return tamed(raw, self._residuals.config.loss, self._residuals.config.reach, np)

    def _tamed_slope(self, raw: np.ndarray) -> np.ndarray:
        step = 1e-6 * np.maximum(np.abs(raw), 1.0)
        return (self._tamed(raw + step) - self._tamed(raw - step)) / (2.0 * step)


def _single(a: Any) -> jax.Array:
    return jnp.asarray(np.asarray(a), jnp.float32)
