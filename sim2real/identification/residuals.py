"""Segments of recordings, simulated with any parameters: residuals, losses and derivatives, by numpy on the host.

Each segment is simulated with the recorded commands and timing. Each evaluation solves for the initial states of the
segments, so that a fit is over dynamics and delays alone (variable projection; the derivative neglects the change of
the states' slopes: Kaufman, BIT 15, 1975). Rollouts take most of the time: the slopes of initial states are reused
while parameters change little, and one rollout serves several parameters or states if no residual depends on two of
them.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.schedule import draw
from sim2real.graph.windows import make_room
from sim2real.identification.config import FitConfig
from sim2real.identification.derivatives import Groups, Nearby, trees_are_apart
from sim2real.identification.model import Channel, IdentifiableModel
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.rollouts import Engine, Rollouts, choose_engine
from sim2real.identification.segments import Data, Span, cut, data_of, padded, rounded

_STATE_STEPS = 2
"""Gauss-Newton steps of an initial state. When delays changed by 0.3 ms, the loss of a pendulum's log jumped by 3 %
with one step, and by 0.2 % with two.
"""
_STATE_DIFFERENCE = 0.03
"""Step of finite differences by an initial state, in standard deviations of its prior."""
_CACHED = 3
"""Number of cached points: a descent evaluates its end, and its next round begins there."""
_SEARCHED = 8
"""Fewest segments that a search simulates; it also takes at least two for each channel."""
MOST_OF_FIT = 4e7
"""If a Jacobian takes more steps of single joints, a fit uses fewer segments: about 30 s on two cores."""
MOST_OF_SETS = 8e6
"""Most steps of single joints in a Jacobian of a first descent, of baselines or of a comparison of terms: about 4 s."""
_BESIDE = 4
"""The time of a model's step that does not depend on the number of joints, as a number of joints."""
_FEWEST = 2
"""Fewest simulated segments of each channel."""


@dataclass(frozen=True)
class Part:
    """The segments that are fitted, and the parameters.

    Attributes:
        live: Shape ``(S,)``, bool: which of the problem's fitted segments are simulated and compared.
        present: Shape ``(P,)``, bool: which parameters are fitted; others have their values without effect.
    """

    live: np.ndarray
    present: np.ndarray

    @property
    def key(self) -> bytes:
        """Bytes that identify this part in a cache."""
        return self.live.tobytes() + self.present.tobytes()


@dataclass(frozen=True)
class Linearised:
    """Residuals and their Jacobian at a point.

    Attributes:
        residuals: Shape ``(S, K, F)``: half their square is the robust loss.
        jacobian: Shape ``(S, K, F, P)``: d residual / d x.
        prior: Shape ``(P, P)``: precision that priors and bounds add; bounds count as a uniform distribution.
        x: Shape ``(P,)``: the point, on the parameters' scales.
        raw: Shape ``(S, K, F)``: the residuals without the robust loss.
        compared: Shape ``(S, K)``, bool: where a measurement was compared; a residual of 0 may also be exact. Default:
            everywhere.
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
        shift: Shape ``(R, n)``: distance from the state that the log shows, in standard deviations of the prior.
        slope: Shape ``(R, n, K, F)``: d residual / d shift.
        residuals: Shape ``(R, K, F)``: the residuals at these states.
    """

    shift: np.ndarray
    slope: np.ndarray
    residuals: np.ndarray


class Problem:
    """Segments of recordings, which can be simulated with any parameters.

    Args:
        length_s: Length of a segment [s].
        like: Another problem of the same model, table and configuration; both share programs.

    Attributes:
        data: The segments, as an argument of programs.
        spans: The segments, recording by recording.
        train: Numbers of the fitted segments.
        readings: Field -> its measurements ``(E, K, ...)``.
        ts: Shape ``(E, K)``: time of each measurement [s from the segment's start]; -1 without a comparison.
        precision: Relative change of the loss below which finite differences are noise: a round keeps the derivatives
            by initial states, so near the minimum its gradient differs from that of the loss.

    Raises:
        Sim2RealError: A log lacks a node or a field, or holds NaN.
        UsageError: A segment has no measurement to compare with.
    """

    def __init__(
        self,
        model: IdentifiableModel,
        recordings: Sequence[Episode],
        spans: Sequence[Span],
        length_s: float,
        config: FitConfig = FitConfig(),  # noqa: B008 - frozen
        table: ParameterTable | None = None,
        like: Problem | None = None,
    ) -> None:
        self.model, self.config, self._recordings = model, config, recordings
        self.table = like.table if like else (table or model.parameters)
        if like:
            self.rollouts = like.rollouts
        else:
            nodes = model.nodes(config.max_delay_s)
            engine = choose_engine(config.engine, nodes, model.given)
            self.rollouts = Rollouts(model, nodes, self.table, config, engine)
        nodes = self.rollouts.graph.nodes
        # Commands sent before a segment still act in it, up to the largest delay.
        cuts = cut(model, nodes, recordings, spans, length_s, 2 * config.max_delay_s)
        self.spans, self.segment_s, self.messages = cuts.spans, length_s, cuts.messages
        # Complete the recorded timing: draw the steps of the simulated nodes.
        self.timeline = draw(nodes, length_s + model.ahead_s, recorded=cuts.timeline)
        make_room(nodes, self.timeline)  # after a hiccup commands leave in a burst
        # Number the segments.
        self.segments = len(cuts.spans)
        self.begins_s = np.array([s.begin_s for s in cuts.spans])
        self.recording = np.array([s.recording for s in cuts.spans])
        self.train = np.flatnonzero([s.fitted for s in cuts.spans])
        # Earlier measurements show the world before the start of the segment.
        from_s = max(config.max_delay_s + 1.0 / min(n.rate for n in nodes.values()), config.skip_s)
        if not np.any(cuts.ts >= from_s):
            raise UsageError(
                f"segments of {length_s:g} s have no measurement after their first {from_s:g} s to compare with",
                hint="make them longer, or max_delay_s or skip_s smaller",
            )
        # Make the arguments of the programs.
        tables = self.rollouts.graph.tables(self.timeline, cuts.messages)
        tables[model.sensor] = padded(tables[model.sensor], rounded(cuts.ts.shape[1]), axis=1)
        self.data: Data = data_of(cuts, tables, from_s)
        self.readings, self.ts = cuts.measured, np.where(cuts.ts >= from_s, cuts.ts, -1.0)
        self._n, self._free = len(self.rollouts.prior), config.initial_state == "free"
        self.precision = 1e-4 if self._free else 1e-5
        # Problems of one model share the groups of columns that move together. In a compiled world any joints may
        # # act on each other.
        apart, compiled = trees_are_apart(self.engine.model), self.engine.model is None
        self._groups: Groups = like._groups if like else Groups(apart)
        self._step_groups: Groups = like._step_groups if like else Groups(True) if compiled else self._groups
        self._state_groups: Groups = like._state_groups if like else Groups(apart, by_tree=True)
        self._forget()

    def _forget(self) -> None:
        """Empty the caches of points."""
        self._last_states: list[tuple[bytes, bool, _States]] = []
        self._last: list[tuple[np.ndarray, Part, Linearised, np.ndarray]] = []

    @property
    def engine(self) -> Engine:
        """The engine of rollouts."""
        return self.rollouts.engine

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The measured channels."""
        return self.model.channels

    @property
    def fields(self) -> list[Any]:
        """The columns of the residuals: field, deviation, and a function that takes the channel's entry."""
        return self.rollouts.fields

    def measured(self, column: int) -> np.ndarray:
        """Return the measurements of a column of the residuals, ``(E, K)``."""
        field, _, entry = self.fields[column]
        return np.asarray(entry(self.readings[field]))

    def part(self, without: Sequence[int] | np.ndarray = (), present: np.ndarray | None = None) -> Part:
        """Return the part with all fitted segments except some, and with the present parameters.

        Args:
            without: Numbers of the segments that are left out.
            present: Shape ``(P,)``, bool: which free parameters are part of the model; default: all.
        """
        columns = np.ones(len(self.table), bool) if present is None else np.asarray(present, bool)
        return Part(~np.isin(self.train, np.asarray(without, int)), columns)

    def linearise(self, x: np.ndarray, part: Part | None = None) -> Linearised:
        """Return the residuals of the fitted segments and their derivatives at ``x (P,)``; the last points are cached.

        Segments outside of the part have residuals and derivatives 0, and are not compared.
        """
        x, part = np.asarray(x, np.float64), part or self.part()
        for point, known, there, _ in self._last:
            if np.array_equal(point, x) and known.key == part.key:
                return there
        states = self._fitted_states(x, part, fresh=True)
        raw = self._raw(x[None], states, part)[0]
        groups = self._groups.members(np.flatnonzero(part.present).tolist())
        low, high = (self._moved(x, groups, sign) for sign in (-1.0, 1.0))
        both = self._raw(np.concatenate([high, low]), states, part)
        width = np.clip(x + self._step, None, self.table.high) - np.clip(x - self._step, self.table.low, None)
        J = self._groups.spread(both[: len(groups)] - both[len(groups) :], groups, width)
        r, slope = robust(raw, self.config.reach)
        prior, of_prior = self._prior(x), self._prior_slope(x)
        precision = of_prior.T @ of_prior + np.diag(12.0 / self.table.span**2)
        loss = self._loss(r, prior, part)
        there = Linearised(r, np.moveaxis(slope * J, 0, -1), precision, x, raw, self.compared(part), loss)
        self._last = [*self._last, (x.copy(), part, there, J)][-_CACHED:]
        return there

    def loss(self, x: np.ndarray, part: Part | None = None) -> float:
        """Return the loss at ``x (P,)``, with initial states fitted there."""
        return float(self.losses(np.asarray(x, np.float64)[None], x, part)[0])

    def losses(self, candidates: np.ndarray, middle: np.ndarray, part: Part | None = None) -> np.ndarray:
        """Return the loss of each candidate ``(N, P)``, with initial states linearised at ``middle (P,)``."""
        candidates, middle, part = np.asarray(candidates), np.asarray(middle, np.float64), part or self.part()
        raw = self._raw(candidates, self._fitted_states(middle, part), part)
        rows = zip(robust(raw, self.config.reach)[0], candidates, strict=True)
        return np.array([self._loss(r, self._prior(x), part) for r, x in rows])

    def near(self, x: np.ndarray, part: Part, slopes: int | None = None) -> Nearby:
        """Return the residuals near ``x`` for a descent, without the robust loss, then the residuals of the priors.

        Initial states keep their derivatives at ``x``. The Jacobian is by one-sided differences.

        Args:
            slopes: Most Jacobians that are computed; default: as many as the steps need.
        """
        states = self._fitted_states(x, part)

        def value(y: np.ndarray) -> np.ndarray:
            return np.concatenate([self._raw(y[None], states, part)[0].reshape(-1), self._prior(y)])

        def slope(y: np.ndarray) -> np.ndarray:
            sign = np.where(y + self._step > self.table.high, -1.0, 1.0)
            groups = self._step_groups.members(np.flatnonzero(part.present).tolist())
            moved = self._moved(y, groups, sign)
            raw = self._raw(np.concatenate([y[None], moved]), states, part)
            raw[1:] -= raw[0]
            return self._with_prior_slope(self._step_groups.spread(raw[1:], groups, sign * self._step), y)

        return Nearby(value, slope, self.table.span, self._known_nearby(x, part), slopes)

    def predict(self, values: Mapping[str, Any], segments: np.ndarray, fit_s: np.ndarray) -> np.ndarray:
        """Return the residuals of ``simulated``."""
        return self.simulated(values, segments, fit_s)[0]

    def simulated(
        self, values: Mapping[str, Any], segments: np.ndarray, fit_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of segments, and their initial states, which are fitted to the first ``fit_s`` of each.

        Args:
            values: Parameters by name, ``(R, ...)``: each segment has its own values.
            segments: Shape ``(R,)``: numbers of the segments.
            fit_s: Shape ``(R,)``: lengths of the first parts [s].

        Returns:
            Residuals ``(R, K, F)``, and initial states ``(R, 2 * channels)``: positions, then velocities.
        """
        segments, fit_s = np.asarray(segments), np.asarray(fit_s)
        arrays, still = {n: np.asarray(v, np.float64) for n, v in values.items()}, np.zeros((len(segments), self._n))
        if self._free:
            fitted = self._best_states(arrays, segments, fit_s, _STATE_STEPS + 1)
            still, errors = fitted.shift, fitted.residuals
        else:
            errors = self.errors(arrays, segments, still)
        return errors, self.rollouts.starts(arrays, segments, still, self.data)

    def robustly(self, points: np.ndarray, x: np.ndarray, part: Part) -> np.ndarray:
        """Return the robust residuals ``(N, S, K, F)`` at points ``(N, P)``; initial states are linearised at ``x``."""
        raw = self._raw(points, self._fitted_states(x, part, fresh=True), part)
        return robust(raw, self.config.reach)[0]

    def segments_with_most_motion(self, part: Part, most: int | None = None) -> Part:
        """Return the segments with most motion: the best of each channel, then the second best of each, and so on.

        If recordings are few, each has a segment among them.

        Args:
            most: Number of segments; default: as many as suffice for a start.
        """
        live = np.flatnonzero(part.live)
        segments, reaches = self.train[live], []
        counts = self.ts[segments] >= 0.0
        for channel in self.channels:
            measured = channel.of(np.asarray(self.data.measured[channel.position])[segments])[:, : counts.shape[1]]
            reaches.append(np.ptp(np.where(counts, measured, measured[:, :1]), axis=1))
        order = np.argsort(-np.array(reaches), axis=1).T.reshape(-1)  # the best of each channel, the second best, ...
        recordings = np.asarray(self.data.recording)[segments]
        firsts = order[np.unique(recordings[order], return_index=True)[1]]
        count = most or max(_SEARCHED, 2 * len(reaches))
        turns = dict.fromkeys([*(firsts if len(firsts) <= count else ()), *order.tolist()])
        chosen = np.zeros(len(part.live), bool)
        chosen[live[list(turns)[:count]]] = True
        return Part(chosen, part.present)

    def compared(self, part: Part) -> np.ndarray:
        """Return where measurements of live segments are compared, ``(S, K)``, bool."""
        return (self.ts[self.train] >= 0.0) & part.live[:, None]

    def errors(self, values: Mapping[str, np.ndarray], segments: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return ``Rollouts.errors`` without the padding of the programs."""
        found = self.rollouts.errors(values, segments, shift, self.data)[:, : self.ts.shape[1]]
        found[self.ts[segments] < 0.0] = 0.0
        return found

    # -- finite differences by parameters

    @property
    def _step(self) -> np.ndarray:
        return self.config.difference * self.table.span

    def _moved(self, x: np.ndarray, groups: Sequence[Sequence[int]], sign: float | np.ndarray) -> np.ndarray:
        """Return points ``(G, P)``: in each, one group of parameters is moved by a step, within the bounds."""
        moved = np.repeat(x[None], len(groups), axis=0)
        to = np.clip(x + sign * self._step, self.table.low, self.table.high)
        for row, group in zip(moved, groups, strict=True):
            row[group] = to[group]
        return moved

    def _known_nearby(self, x: np.ndarray, part: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return point, residuals and Jacobian of the nearest cached point that covers the part; None without one."""

        def covers(known: Part) -> bool:
            return not ((part.live & ~known.live).any() or (part.present & ~known.present).any())

        found = [(point, there, J) for point, known, there, J in self._last if covers(known)]
        if not found:
            return None
        span = self.table.span
        point, there, J = min(found, key=lambda row: float(np.linalg.norm(((row[0] - x) / span)[part.present])))
        r = np.where(part.live[:, None, None], there.raw, 0.0).reshape(-1)
        rows = np.where(part.live[:, None, None] & part.present[:, None, None, None], J, 0.0)
        start = np.where(part.present, point, x)
        return start, np.concatenate([r, self._prior(start)]), self._with_prior_slope(rows, start)

    def _with_prior_slope(self, rows: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the Jacobian ``(P, N)`` of residuals and priors from that of the residuals ``(P, S, K, F)``."""
        rows, of_prior = rows.reshape(len(x), -1), self._prior_slope(x).T
        return np.concatenate([rows, of_prior], axis=1) if of_prior.size else rows

    def _prior(self, x: np.ndarray) -> np.ndarray:
        return self.table.prior_residuals(x)

    def _prior_slope(self, x: np.ndarray) -> np.ndarray:
        moves, h = np.eye(len(x)), 1e-3 * self.table.span
        rows = [(self._prior(x + h[i] * m) - self._prior(x - h[i] * m)) / (2.0 * h[i]) for i, m in enumerate(moves)]
        return np.stack(rows, axis=-1) if rows else np.zeros((0, 0))

    def _loss(self, r: np.ndarray, prior: np.ndarray, part: Part) -> float:
        count = max(int(self.compared(part).sum()) * r.shape[-1], 1)
        every = max(int((self.ts[self.train] >= 0.0).sum()) * r.shape[-1], 1)
        return 0.5 * (float(np.sum(r**2)) / count + float(np.sum(prior**2)) / every)

    # -- residuals at the best initial states

    def _raw(self, x: np.ndarray, states: _States | None, part: Part) -> np.ndarray:
        """Return the residuals without the robust loss at points ``(N, P)``, ``(N, S, K, F)``."""
        return self._projected(self.table.decode(x, part.present), states, part)

    def _projected(self, values: Mapping[str, np.ndarray], states: _States | None, part: Part) -> np.ndarray:
        """Return residuals ``(N, S, K, F)`` at the best initial states near ``states``; 0 in other segments."""
        # Simulate the segments of the part for all copies.
        live = np.flatnonzero(part.live)
        segments, copies = self.train[live], len(next(iter(values.values())))
        spread = {n: np.repeat(v, len(live), axis=0) for n, v in values.items()}
        shift = np.zeros((len(live), self._n)) if states is None else states.shift
        error = self.errors(spread, np.tile(segments, copies), np.tile(shift, (copies, 1)))
        error = error.reshape(copies, len(live), *error.shape[1:])
        # Move each initial state to its optimum along the linearisation.
        if states is not None:
            counts = (self.ts[segments] >= 0.0)[..., None]
            for row in error:
                step = _next_shift(states._replace(residuals=row.copy()), counts) - shift
                row += np.einsum("sn,snkf->skf", step, states.slope)
        if len(live) == len(part.live):
            return error
        whole = np.zeros((copies, len(part.live), *error.shape[2:]))
        whole[:, live] = error
        return whole

    # -- initial states

    def _fitted_states(self, x: np.ndarray, part: Part, fresh: bool = False) -> _States | None:
        """Return the initial states of the part's segments; None if initial states are not fitted.

        Args:
            fresh: Whether to compute the derivatives again at the fitted states.
        """
        if not self._free:
            return None
        key = x.tobytes() + part.key
        for point, is_fresh, states in self._last_states:
            if point == key and is_fresh >= fresh:
                return states
        segments = self.train[part.live]
        values = {n: np.repeat(v, len(segments), axis=0) for n, v in self.table.decode(x[None], part.present).items()}
        if fresh and (states := self._fitted_states(x, part)):
            states = states._replace(slope=self._slopes(values, segments, states.shift)[0])
        else:
            states = self._best_states(values, segments, np.full(len(segments), np.inf), _STATE_STEPS - 1)
        self._last_states = [(key, fresh, states), *self._last_states[: _CACHED - 1]]
        return states

    def _best_states(
        self, values: Mapping[str, np.ndarray], segments: np.ndarray, fit_s: np.ndarray, steps: int
    ) -> _States:
        """Fit initial states by Gauss-Newton steps that share the derivatives at the start; return the best states.

        Args:
            fit_s: Shape ``(R,)``: length of the first part of each segment, to which its state is fitted [s].
        """
        # Linearise at the state that the log shows.
        still = np.zeros((len(segments), self._n))
        slope, errors = self._slopes(values, segments, still)
        ts = self.ts[segments]
        counts = ((ts >= 0.0) & (ts <= fit_s[:, None]))[..., None]
        best = _States(still, slope, errors)
        least, candidate = _state_cost(best, counts), _next_shift(best, counts)
        # Step with these derivatives, and keep the best point.
        for _ in range(steps):
            here = _States(candidate, slope, self.errors(values, segments, candidate))
            cost = _state_cost(here, counts)
            better = cost < least
            shift = np.where(better[:, None], here.shift, best.shift)
            residuals = np.where(better[:, None, None], here.residuals, best.residuals)
            best, least = _States(shift, slope, residuals), np.where(better, cost, least)
            # Near kinks, such as sticking friction, a full step may raise the cost: go half way back.
            candidate = np.where(better[:, None], _next_shift(best, counts), (candidate + shift) / 2.0)
        return best

    def _slopes(
        self, values: Mapping[str, np.ndarray], segments: np.ndarray, shift: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives ``(R, n, K, F)`` by initial states at shifts ``(R, n)``, and residuals ``(R, K, F)``."""
        groups = self._state_groups.members(range(self._n))
        member = np.array([[i in group for i in range(self._n)] for group in groups], float)
        moves = _STATE_DIFFERENCE * np.concatenate([np.zeros((1, self._n)), member, -member])
        spread = {k: np.repeat(v, len(moves), axis=0) for k, v in values.items()}
        shifts = (shift[:, None] + moves).reshape(-1, self._n)
        errors = self.errors(spread, np.repeat(segments, len(moves)), shifts)
        errors = np.moveaxis(errors.reshape(len(segments), len(moves), *errors.shape[1:]), 1, 0)
        changes = errors[1 : len(groups) + 1] - errors[len(groups) + 1 :]
        width = np.full(self._n, 2 * _STATE_DIFFERENCE)
        return np.moveaxis(self._state_groups.spread(changes, groups, width), 0, 1), errors[0]

    def with_readings(self, readings: Mapping[str, np.ndarray]) -> Problem:
        """Return the problem with other measurements: field -> ``(E, K, ...)``; both share programs."""
        other, measured = copy.copy(self), {f: np.array(rows) for f, rows in self.data.measured.items()}
        for name, rows in readings.items():
            measured[name][: rows.shape[0], : rows.shape[1]] = rows
        measured = {name: jnp.asarray(rows) for name, rows in measured.items()}
        other.readings, other.data = readings, self.data._replace(measured=measured)
        other._forget()
        return other

    def recut(self, spans: Sequence[Span], length_s: float, ends_s: Sequence[float] | None = None) -> Problem:
        """Return the same recordings cut into other segments; both problems share programs.

        Args:
            length_s: Length of a segment [s].
            ends_s: Time in each segment after which measurements are not compared [s]; default: ``length_s``.
        """
        other = Problem(self.model, self._recordings, spans, length_s, self.config, like=self)
        if ends_s is not None:
            ends = dict(zip(spans, ends_s, strict=True))
            until = np.array([ends[span] for span in other.spans])
            other.ts = np.where(other.ts <= until[:, None], other.ts, -1.0)
            other._forget()
        return other


def _next_shift(at: _States, counts: np.ndarray) -> np.ndarray:
    """Return the shifts ``(R, n)`` after a Gauss-Newton step.

    Args:
        counts: Shape ``(R, K, 1)``, bool: which measurements count.
    """
    J = np.where(counts[:, None], at.slope, 0.0).reshape(*at.slope.shape[:2], -1)
    r = np.where(counts, at.residuals, 0.0).reshape(len(J), -1)
    H = J @ J.transpose(0, 2, 1) + np.eye(J.shape[1])
    pull = np.einsum("rnk,rk->rn", J, r) + at.shift
    # Keep the state where the step is not finite.
    lost = ~(np.isfinite(H).all(axis=(1, 2)) & np.isfinite(pull).all(axis=1))
    H[lost], pull[lost] = np.eye(J.shape[1]), 0.0
    return at.shift - np.linalg.solve(H, pull[..., None])[..., 0]


def _state_cost(at: _States, counts: np.ndarray) -> np.ndarray:
    return np.sum(np.where(counts, at.residuals, 0.0) ** 2, axis=(1, 2)) + np.sum(at.shift**2, axis=1)


def robust(raw: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals ``r`` for which ``r ** 2 / 2`` is the robust loss of ``raw``, and d r / d raw.

    The loss is scipy's ``soft_l1``: quadratic below ``reach``, linear far above it.
    """
    root = np.hypot(1.0, raw / reach)  # a square may overflow to infinity, which would make the residual 0
    share = np.sqrt(2.0 / (root + 1.0))
    return raw * share, 1.0 / (root * share)


def thinned(problem: Problem, parts: np.ndarray, most: float) -> Problem:
    """Return a problem with the segments of most motion in each part, if a Jacobian of all would take long.

    Args:
        parts: Shape ``(K, S)``, bool: which fitted segments are in each part; each keeps at least one.
        most: Largest number of steps of single joints in a Jacobian.
    """
    model, channels = problem.engine.model, len(problem.channels)
    if model is None:
        return problem
    steps = problem.segment_s / float(model.opt.timestep) * (_BESIDE + int(model.nv)) * len(problem.table)
    keep = max(int(most / steps), _FEWEST * channels, len(parts))
    if keep >= len(problem.train):
        return problem
    live, (each, more) = np.zeros(len(problem.train), bool), divmod(keep, len(parts))
    for k, touched in enumerate(parts):
        live |= problem.segments_with_most_motion(problem.part(problem.train[~touched]), each + (k < more)).live
    return problem.recut([problem.spans[i] for i in problem.train[live]], problem.segment_s)


def of_recordings(problem: Problem) -> np.ndarray:
    """Return which fitted segments are in each recording, ``(K, S)``, bool."""
    recording = problem.recording[problem.train]
    return recording == np.unique(recording)[:, None]


def few_of(problem: Problem) -> Problem:
    """Return a problem with the segments of most motion, if a Jacobian of all would take long."""
    return thinned(problem, np.ones((1, len(problem.train)), bool), MOST_OF_SETS)
