"""Residuals on C MuJoCo: numpy on the host, between a program for the controls and a program for the sensor.

Both programs are small and have no callback, so a compilation cache keeps them. Rollouts take most of the time. So the
derivatives by a segment's initial state are reused while parameters change little, and padding is not rolled out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2real import pytree
from sim2real.identify.problem.broyden import Slope, corrected
from sim2real.identify.problem.engine import CRollouts, Outside
from sim2real.identify.problem.evaluator import Stacked, replaced, single
from sim2real.identify.problem.initial_states import InitialStates, next_shift, trees_are_apart
from sim2real.identify.problem.programs import OnCompile
from sim2real.identify.problem.residuals import InitialState, LinearisedSegments, SegmentResiduals
from sim2real.identify.problem.robust import tamed
from sim2real.identify.problem.segments import Data
from sim2real.identify.problem.sizes import padded
from sim2real.identify.problem.together import Together
from sim2real.installation import has_jax
from sim2real.later import jax
from sim2real.types import PyTree

_FEW, _COPIES, _MANY = 24, 128, 512
"""Copies in one call of the two programs: each size compiles once. A descent evaluates one point in a call. Many logs
make thousands of copies: a Jacobian of 20 logs took 24 s of processor time with 128 at a time, 18 s with 512."""

_CACHED = 2
"""Points whose Jacobians are cached: that of a set of terms, and that of all terms around it."""
_SEARCHED = 8
"""Fewest segments that a search simulates; at least two for each channel."""


class OutsideEvaluator:
    """Evaluates residuals on C; an ``Evaluator``."""

    def __init__(self, residuals: SegmentResiduals, rollouts: CRollouts) -> None:
        self._residuals, self._rollouts = residuals, rollouts
        self._n, self._prior = len(residuals.prior), np.asarray(residuals.prior, np.float64)
        self._free = residuals.config.initial_state == "free"
        self.fresh = not self._free
        # A round keeps the derivatives of initial states, so near the minimum its slope differs from the loss's.
        self.precision = 1e-4 if self._free else 1e-5
        self._initial = InitialStates(residuals, self._errors, residuals.engine.model)
        self._together = Together(trees_are_apart(residuals.engine.model))
        self._last: list[tuple[np.ndarray, Data, LinearisedSegments]] = []

    def linearised(self, z: np.ndarray, data: Data, on_compile: OnCompile | None = None) -> LinearisedSegments:
        """See ``Evaluator``; the last points are cached, as several judgements of an estimate use them.

        Descents that begin there, without a part of the recordings or with a further term, need no Jacobian of theirs.
        """
        del on_compile  # both programs compile within two seconds
        for point, segments, there in self._last:
            if np.array_equal(point, z) and segments is data:
                return there
        there = self._linearised(z, data)
        self._last = [*self._last, (z.copy(), data, there)][-_CACHED:]
        return there

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
        """See ``Evaluator``: initial states keep their derivatives at ``z``.

        Differences are one-sided, which halves the rollouts of a descent; it still ends at the minimum of the loss.
        """
        states = self._states(z, data)

        def value(y: np.ndarray) -> np.ndarray:
            r = self._tamed(self._raw(y[None], states, data)[0])
            return np.concatenate([r.reshape(-1), self._of_prior(y)[0]])

        def slope(y: np.ndarray) -> np.ndarray:
            # Differences along each parameter, with the initial states of ``z``.
            groups = self._together.groups(np.asarray(data.present))
            raw = self._raw(np.concatenate([y[None], y + self._moves(groups, y.size)]), states, data)
            J = self._tamed_slope(raw[0])[..., None] * self._by_parameter(raw[1:] - raw[0], groups, y.size)
            return np.concatenate([J.reshape(-1, y.size), self._of_prior(y)[1]])

        return corrected(value, slope, self._nearby(z, data))

    def _nearby(self, z: np.ndarray, data: Data) -> Slope | None:
        """Return the cached Jacobian next to a point that covers its segments and parameters; None without one."""
        live, present = np.asarray(data.weight) > 0.0, np.asarray(data.present)

        def covers(segments: Data) -> bool:
            fitted = np.asarray(segments.weight) > 0.0
            same = len(fitted) == len(live) and segments.ts is data.ts and segments.fitted is data.fitted
            return bool(same and not (live & ~fitted).any() and not (present & ~np.asarray(segments.present)).any())

        near = [(point, there) for point, segments, there in self._last if covers(segments)]
        if not near:
            return None
        point, there = min(near, key=lambda pair: float(np.linalg.norm((pair[0] - z)[present])))
        # Leave out the rows of other segments, and the columns of other parameters.
        r = np.where(live[:, None, None], there.residuals, 0.0).reshape(-1)
        J = np.where(live[:, None, None, None] & present, there.jacobian, 0.0).reshape(-1, z.size)
        start = np.where(present, point, z)
        return start, np.concatenate([r, there.prior]), np.concatenate([J, there.prior_jacobian])

    def losses(self, candidates: np.ndarray, around: np.ndarray, data: Data) -> np.ndarray:
        """See ``Evaluator``."""
        return self.losses_with(candidates, self._states(around, data), data)

    def searched(self, data: Data) -> PyTree:
        """See ``Evaluator``: losses of the segments with most motion; generations of one middle share its states."""
        states: list[InitialState | None] = [None]
        most_moved = self.lively(data)

        def losses(candidates: np.ndarray, middle: np.ndarray, new: bool) -> np.ndarray:
            if new:
                states[0] = self._states(middle, most_moved)
            return self.losses_with(candidates, states[0], most_moved)

        return losses

    def lively(self, data: Data, most: int | None = None) -> Data:
        """See ``Evaluator``: segments of each channel in turn, and one of each recording, if these are few.

        These suffice for a search: all 23 segments of an arm took 2.6 times as long. Of many recordings each has one
        only if each has parameters of its own.
        """
        # Measure the range of each channel in each segment.
        live = np.flatnonzero(np.asarray(data.weight) > 0.0)
        segments = np.asarray(data.fitted)[live]
        counts, reaches = np.asarray(data.ts)[segments] >= 0.0, []
        for channel in self._residuals.channels:
            measured = channel.of(np.asarray(data.measured[channel.position])[segments])
            reaches.append(np.ptp(np.where(counts, measured, measured[:, :1]), axis=1))
        order = np.argsort(-np.array(reaches), axis=1).T.reshape(-1)  # the best of each channel, the second best, ...
        # Take the best segment of each recording, then the others in that order.
        recordings = np.asarray(data.recording)[segments]
        firsts = order[np.unique(recordings[order], return_index=True)[1]]
        count, alone = most or max(_SEARCHED, 2 * len(reaches)), any(p.per_recording for p in self._residuals.table)
        count = max(count, len(firsts)) if alone else count
        turns = dict.fromkeys([*(firsts if len(firsts) <= count else ()), *order.tolist()])
        weight = np.zeros(len(data.fitted), np.float32)
        weight[live[list(turns)[:count]]] = 1.0
        return data._replace(weight=weight)

    def losses_with(self, candidates: np.ndarray, states: InitialState | None, data: Data) -> np.ndarray:
        """Return the loss of each candidate, ``(N,)``.

        Args:
            candidates: Shape ``(N, P)``.
            states: Initial states, linearised; None if they are not fitted.
        """
        raw = self._raw(candidates, states, data)
        priors = self._priors(candidates)
        return np.array([self._loss(self._tamed(r), p, data) for r, p in zip(raw, priors, strict=True)])

    def predict(self, values: Any, eps: np.ndarray, fit_s: np.ndarray, data: Data) -> tuple[np.ndarray, np.ndarray]:
        """See ``Evaluator``."""
        arrays, shift = {n: np.asarray(v, np.float32) for n, v in values.items()}, np.zeros((len(eps), self._n))
        if self._free:
            fitted = self._initial.best(arrays, np.asarray(eps), fit_s, data)
            shift, errors = fitted.shift, fitted.residuals
        else:
            errors = self._errors(arrays, eps, shift, data)
        started = self._residuals.program("started", jax.vmap(self._residuals.started, (0, 0, 0, None)))
        starts = started(arrays, np.asarray(eps, np.int32), np.asarray(shift, np.float32), data)
        return np.asarray(errors), np.asarray(starts, np.float64)

    def with_values(self, z: np.ndarray, rows: np.ndarray, data: Data) -> np.ndarray:
        """See ``Evaluator``."""
        program = self._residuals.program(
            "replaced", jax.vmap(lambda z, row: replaced(self._residuals, z, row), (None, 0))
        )
        values = jax.tree_util.tree_map(np.asarray, program(single(z), single(rows)))
        return self._tamed(self._projected(values, self._states(z, data, again=True), data))

    def _states(self, z: np.ndarray, data: Data, again: bool = False) -> InitialState | None:
        """Return the initial states of the fitted segments, leaves ``(S, ...)``; None if they are not fitted."""
        return self._initial.fitted(z, self._decoded(z[None], data), data, again) if self._free else None

    def _raw(self, z: np.ndarray, states: InitialState | None, data: Data) -> np.ndarray:
        """Return the residuals without the robust loss at points ``(N, P)``, ``(N, S, K, F)``."""
        return self._projected(self._decoded(z, data), states, data)

    def _projected(self, values: Mapping[str, np.ndarray], states: InitialState | None, data: Data) -> np.ndarray:
        """Return residuals ``(N, S, K, F)`` at the best initial states near ``states``; 0 without weight."""
        # Roll out the segments that have a weight, for all copies.
        live = np.flatnonzero(np.asarray(data.weight) > 0.0)
        segments, copies = np.asarray(data.fitted)[live], len(next(iter(values.values())))
        spread = {n: np.repeat(v, len(live), axis=0) for n, v in values.items()}
        shift = np.zeros((len(live), self._n)) if states is None else states.shift[live]
        error = self._errors(spread, np.tile(segments, copies), np.tile(shift, (copies, 1)), data)
        error = error.reshape(copies, len(live), *error.shape[1:])
        # Move each initial state to its optimum along the linearisation.
        if states is not None:
            counts = (np.asarray(data.ts)[segments] >= 0.0)[..., None]
            for row in error:
                state = InitialState(shift, states.slope[live], row.copy())
                row += np.einsum("sn,snkf->skf", next_shift(state, counts) - shift, state.slope)
        whole = np.zeros((copies, len(data.fitted), *error.shape[2:]))
        whole[:, live] = error
        return whole

    def _slope(self, z: np.ndarray, states: InitialState | None, data: Data) -> np.ndarray:
        """Return d residual / d z without the robust loss, ``(S, K, F, P)``, by central differences."""
        groups = self._together.groups(np.asarray(data.present))
        moves = self._moves(groups, z.size)
        raw = self._raw(np.concatenate([z + moves, z - moves]), states, data)
        return self._by_parameter((raw[: len(moves)] - raw[len(moves) :]) / 2.0, groups, z.size)

    def _moves(self, groups: list[list[int]], size: int) -> np.ndarray:
        """Return the steps of finite differences, one row for each group of parameters."""
        moved = np.zeros((len(groups), size))
        for row, group in zip(moved, groups, strict=True):
            row[group] = self._residuals.config.difference
        return moved

    def _by_parameter(self, changes: np.ndarray, groups: list[list[int]], size: int) -> np.ndarray:
        """Return derivatives ``(S, K, F, P)`` from the changes of the residuals by each of ``_moves``."""
        return self._together.jacobian(changes / self._residuals.config.difference, groups, size)

    def _errors(self, values: Mapping[str, np.ndarray], eps: np.ndarray, shift: np.ndarray, data: Data) -> np.ndarray:
        """Return the residuals of segments ``eps (N,)`` with shifted initial states ``(N, n)``, ``(N, K, F)``."""
        residuals = self._residuals
        before = residuals.of_copies("inputs", residuals.inputs, (0, 0, 0, None))
        after = residuals.of_copies("errors", residuals.errors, (0, 0, 0, 0, None))
        errors, most = [], _MANY if len(eps) > 2 * _MANY else _COPIES
        for first in range(0, len(eps), most):
            rows = slice(first, first + most)
            count = len(eps[rows])
            # Pad the copies to one of few sizes, as each size compiles once.
            size = next(size for size in (_FEW, _COPIES, _MANY) if count <= size) if has_jax() else count
            part = {n: np.asarray(v[rows], np.float32) for n, v in values.items()}
            shifts = np.asarray(shift[rows] * self._prior, np.float32)
            arguments = padded((part, np.asarray(eps[rows], np.int32), shifts), size)
            inputs: Outside = before(*arguments, data)
            if has_jax():
                inputs = pytree.map(lambda a, n=count: np.asarray(a)[:n], inputs)
            moved = padded(tuple(a.astype(np.float32) for a in self._rollouts.step(inputs)), size)
            errors.append(np.asarray(after(*arguments, moved, data), np.float64)[:count])
        return np.concatenate(errors)

    def _decoded(self, z: np.ndarray, data: Data) -> dict[str, np.ndarray]:
        decode = self._residuals.of_copies("decode", self._residuals.table.decode, (0, None))
        points = single(padded(z, -(-len(z) // _COPIES) * _COPIES))
        return {n: np.asarray(v)[: len(z)] for n, v in decode(points, data.present).items()}

    def _priors(self, z: np.ndarray) -> np.ndarray:
        """Return the residuals of the priors at points ``(N, P)``, ``(N, Q)``."""
        program = self._residuals.program("priors", jax.vmap(self._residuals.table.prior_residuals))
        return np.asarray(program(single(padded(z, -(-len(z) // _COPIES) * _COPIES))), np.float64)[: len(z)]

    def _of_prior(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        of_prior = self._residuals.table.prior_residuals
        if all(c.parameter.prior is None for c in self._residuals.table.columns):
            return np.zeros(0), np.zeros((0, z.size))
        program = self._residuals.program("prior", lambda z: (of_prior(z), jax.jacfwd(of_prior)(z)))
        value, slope = (np.asarray(a, np.float64) for a in program(single(z)))
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
