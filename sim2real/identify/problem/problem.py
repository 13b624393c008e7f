"""Recordings cut into segments, with the programs that compute their residuals.

Each segment is simulated with the recorded commands and timing, from its own initial state. Every evaluation solves for
the initial states, so a search is over dynamics and delays alone.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim2real import pytree
from sim2real.errors import NotInstalled, UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.schedule import draw
from sim2real.graph.windows import make_room
from sim2real.identify.config import FitConfig
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.engine import choose
from sim2real.identify.problem.evaluator import CompiledEvaluator, Evaluator
from sim2real.identify.problem.host_evaluator import OutsideEvaluator
from sim2real.identify.problem.programs import OnCompile
from sim2real.identify.problem.residuals import SegmentResiduals
from sim2real.identify.problem.segments import Data, Retimed, Span, cut, data_of
from sim2real.identify.problem.sizes import padded, rounded
from sim2real.installation import has_jax
from sim2real.later import jnp
from sim2real.types import Array, PyTree


@dataclass(frozen=True)
class Evaluation:
    """The residuals of the fitted segments at a point, in numpy.

    Attributes:
        residuals: Shape ``(S, K, F)``, in deviations of the measurement, with the robust loss; 0 without a comparison.
        jacobian: Shape ``(S, K, F, P)``: d residual / d z.
        raw: Shape ``(S, K, F)``: the residuals without the robust loss.
        prior: Shape ``(Q,)``: the residuals of the priors.
        prior_jacobian: Shape ``(Q, P)``: their derivatives.
        loss: Half the mean square of the residuals, plus the priors.
    """

    residuals: np.ndarray
    jacobian: np.ndarray
    raw: np.ndarray
    prior: np.ndarray
    prior_jacobian: np.ndarray
    loss: float


class Problem:
    """Segments of recordings, which can be simulated with any parameters.

    Args:
        length_s: Length of a segment [s].
        moved: Changes the recorded timing of the segments before they are simulated.
        like: Another problem of the same model, table and configuration; both share programs.

    Attributes:
        data: The segments, as an argument of programs.
        spans: The segments, recording by recording.
        train: Numbers of the fitted segments.
        readings: Field -> its measurements ``(E, K, ...)``.

    Raises:
        Sim2RealError: When a log lacks a node or a field, or holds NaN.
        UsageError: When a segment holds too few measurements.
    """

    def __init__(
        self,
        model: IdentifiableModel,
        recordings: Sequence[Episode],
        spans: Sequence[Span],
        length_s: float,
        config: FitConfig = FitConfig(),  # noqa: B008 - frozen
        table: ParameterTable | None = None,
        moved: Retimed = lambda recorded: recorded,
        like: Problem | None = None,
    ) -> None:
        self.model, self.config, self._recordings = model, config, recordings
        self.table = like.table if like else (table or model.parameters).for_recordings(len(recordings))
        self.residuals = like.residuals if like else self._residuals()
        nodes = self.residuals.graph.nodes
        # Commands sent before a segment still act in it, up to the largest delay.
        cuts = cut(model, nodes, recordings, spans, length_s, 2 * config.max_delay_s)
        self.spans, self.segment_s, self.messages = cuts.spans, length_s, cuts.messages
        # Complete the recorded timing: draw the steps of the simulated nodes.
        self.timeline = draw(nodes, length_s + model.ahead_s, recorded=moved(cuts.timeline))
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
        tables = self.residuals.graph.tables(self.timeline, cuts.messages)
        steps = cuts.ts.shape[1]
        tables[model.sensor] = padded(tables[model.sensor], rounded(steps), axis=1)
        self.data: Data = data_of(cuts, tables, from_s, len(self.fields), len(self.table))
        self.readings, self._ts = cuts.measured, np.where(cuts.ts >= from_s, cuts.ts, -1.0)
        # Choose derivatives and evaluator, or share those of the other problem.
        if like is None:
            self.residuals.choose_derivative(self.data)
        on_c = self.engine.name == "c"
        self.evaluator: Evaluator = like.evaluator if like else _evaluator(self.residuals, on_c)

    def _residuals(self) -> SegmentResiduals:
        nodes = self.model.nodes(self.config.max_delay_s)
        engine = choose(self.config.engine, nodes, self.model.given, self.config.jacobian)
        if engine.name != "c" and not has_jax():
            raise NotInstalled(f"this needs JAX, as {engine.why}")
        return SegmentResiduals(self.model, nodes, self.table, self.config, engine)

    @property
    def engine(self) -> PyTree:
        """The engine of rollouts."""
        return self.residuals.engine

    @property
    def channels(self) -> PyTree:
        """The measured channels."""
        return self.model.channels

    @property
    def fields(self) -> PyTree:
        """The columns of the residuals: field, deviation, and a function that takes the channel's entry."""
        return self.residuals.fields

    @property
    def ts(self) -> np.ndarray:
        """Time of each measurement ``(E, K)`` [s from the segment's start]; -1 without a comparison."""
        return self._ts

    def measured(self, column: int) -> np.ndarray:
        """Return the measurements of a column of the residuals, ``(E, K)``."""
        field, _, entry = self.fields[column]
        return np.asarray(entry(self.readings[field]))

    def part(self, without: Sequence[int] | np.ndarray = (), present: np.ndarray | None = None) -> Data:
        """Return the data without some segments, and with some of the parameters.

        Args:
            without: Numbers of the segments that get no weight.
            present: Shape ``(P,)``, bool: which free parameters are part of the model; default: all.
        """
        weight = np.asarray(self.data.weight).copy()
        weight[: len(self.train)][np.isin(self.train, np.asarray(without, int))] = 0.0
        among = self.data.present if present is None else jnp.asarray(np.asarray(present, bool))
        return self.data._replace(weight=jnp.asarray(weight), present=among)

    def at(self, z: Array, data: Data | None = None, on_compile: OnCompile | None = None) -> Evaluation:
        """Return the residuals of the fitted segments at ``z (P,)``, and their derivatives."""
        evaluated = self.evaluator.linearised(np.asarray(z), self.data if data is None else data, on_compile)
        count = len(self.train)
        steps = self._ts.shape[1]
        r, J, raw = (np.asarray(a, np.float64)[:count, :steps] for a in evaluated[:3])
        prior, slope = (np.asarray(a, np.float64) for a in (evaluated.prior, evaluated.prior_jacobian))
        return Evaluation(r, J, raw, prior, slope, float(evaluated.loss))

    def compared(self, data: Data | None = None) -> np.ndarray:
        """Return where measurements of fitted segments are compared, ``(S, K)``, bool; not in those without weight."""
        weight = np.asarray((self.data if data is None else data).weight)[: len(self.train)]
        return (self._ts[self.train] >= 0.0) & (weight[:, None] > 0.0)

    def loss(self, z: Array, data: Data | None = None, on_compile: OnCompile | None = None) -> float:
        """Return the loss at ``z (P,)``."""
        return self.evaluator.loss(np.asarray(z), self.data if data is None else data, on_compile)

    def losses(self, candidates: Array, around: Array, data: Data | None = None) -> np.ndarray:
        """Return the loss of each candidate ``(N,)``, with initial states linearised at one point.

        Args:
            candidates: Shape ``(N, P)``.
            around: Shape ``(P,)``.
        """
        segments = self.data if data is None else data
        return self.evaluator.losses(np.asarray(candidates), np.asarray(around), segments)

    def predict(self, values: Any, segments: np.ndarray, fit_s: np.ndarray) -> np.ndarray:
        """Return the residuals of ``simulated``."""
        return self.simulated(values, segments, fit_s)[0]

    def simulated(self, values: Any, segments: np.ndarray, fit_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of segments whose initial states are fitted to their first parts, and these states.

        Args:
            values: Parameters by name, ``(R, ...)``: each segment with its own.
            segments: Shape ``(R,)``: numbers of the segments.
            fit_s: Shape ``(R,)``: lengths of the first parts [s].

        Returns:
            Residuals ``(R, K, F)``, and initial states ``(R, 2 * channels)``: positions, then velocities.
        """
        # Predict a fixed number at a time: one program serves all, and compiling takes longer than running.
        size = len(self.data.recording)
        residuals, starts = [], []
        for first in range(0, len(segments), size):
            rows = np.minimum(np.arange(first, first + size), len(segments) - 1)
            arrays = {n: np.asarray(v)[rows] for n, v in values.items()}
            errors, states = self.evaluator.predict(arrays, segments[rows], fit_s[rows], self.data)
            residuals.append(errors)
            starts.append(states)
        whole = np.concatenate(residuals)[: len(segments), : self._ts.shape[1]].astype(np.float64)
        return whole, np.concatenate(starts)[: len(segments)]

    def with_values(self, z: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Return the robust residuals of the fitted segments with some parameters set, ``(G, S, K, F)``.

        Args:
            z: Shape ``(P,)``: the parameters; initial states are linearised there.
            rows: Shape ``(G, P)``: values of the parameters that are set; NaN keeps the value at ``z``.
        """
        residuals = self.evaluator.with_values(np.asarray(z), rows, self.data)
        return residuals[:, : len(self.train), : self._ts.shape[1]]

    def with_readings(self, readings: Mapping[str, np.ndarray]) -> Problem:
        """Return the same segments with other measurements, ``(E, K, ...)`` of each field; both share programs."""
        other, measured = copy.copy(self), {f: np.array(rows) for f, rows in self.data.measured.items()}
        for field, rows in readings.items():
            measured[field][: rows.shape[0], : rows.shape[1]] = rows
        other.readings, other.data = readings, self.data._replace(measured=pytree.map(jnp.asarray, measured))
        return other

    def recut(
        self,
        spans: Sequence[Span],
        length_s: float,
        moved: Retimed = lambda recorded: recorded,
        ends_s: Sequence[float] | None = None,
    ) -> Problem:
        """Return the same recordings cut into other segments; both problems share programs.

        Args:
            length_s: Length of a segment [s].
            ends_s: Time in each segment after which measurements are not compared [s]; default: ``length_s``.
        """
        other = Problem(self.model, self._recordings, spans, length_s, self.config, moved=moved, like=self)
        if ends_s is not None:
            ends = dict(zip(spans, ends_s, strict=True))
            until = np.array([ends[span] for span in other.spans])
            other._ts = np.where(other._ts <= until[:, None], other._ts, -1.0)
        return other


def _evaluator(residuals: SegmentResiduals, on_c: bool) -> Evaluator:
    return OutsideEvaluator(residuals, residuals.outside) if on_c else CompiledEvaluator(residuals)
