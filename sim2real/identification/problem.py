"""Recordings cut into segments, which can be simulated with any parameters.

Each segment is simulated with the recorded commands and timing, from its own initial state.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.schedule import draw
from sim2real.graph.windows import make_room
from sim2real.identification.config import FitConfig
from sim2real.identification.model import Channel, IdentifiableModel
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.residuals import Linearised, Part, Residuals
from sim2real.identification.rollouts import Engine, Rollouts, choose_engine
from sim2real.identification.segments import Data, Span, cut, data_of, padded, rounded

MOST_OF_FIT = 4e7
"""Steps of single joints in a Jacobian from which a fit takes fewer segments: about 30 s on two cores."""
MOST_OF_SETS = 8e6
"""The same for the first of two descents, for baselines and for sets of terms that are compared: about 4 s."""
_BESIDE = 4
"""Joints whose steps take as long as what a step of a model takes beside its joints."""
_FEWEST = 2
"""Fewest segments of a channel that are live."""


class Problem:
    """Segments of recordings, which can be simulated with any parameters.

    Args:
        length_s: Length of a segment [s].
        like: Another problem of the same model, table and configuration; both share programs.

    Attributes:
        data: The segments, as an argument of programs.
        spans: The segments, recording by recording.
        train: Numbers of the fitted segments.
        residuals: The residuals of the fitted segments, and their derivatives.
        readings: Field -> its measurements ``(E, K, ...)``.
        ts: Shape ``(E, K)``: time of each measurement [s from the segment's start]; -1 without a comparison.

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
        like: Problem | None = None,
    ) -> None:
        self.model, self.config, self._recordings = model, config, recordings
        self.table = like.table if like else (table or model.parameters)
        self.rollouts = like.rollouts if like else self._rollouts()
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
        self._begin_residuals(like.residuals if like else None)

    def _rollouts(self) -> Rollouts:
        nodes = self.model.nodes(self.config.max_delay_s)
        engine = choose_engine(self.config.engine, nodes, self.model.given)
        return Rollouts(self.model, nodes, self.table, self.config, engine)

    def _begin_residuals(self, like: Residuals | None) -> None:
        self.residuals = Residuals(self.rollouts, self.data, self.train, self.ts, like)

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
        """Return the fitted segments but for some, and some of the parameters.

        Args:
            without: Numbers of the segments that are left out.
            present: Shape ``(P,)``, bool: which free parameters are part of the model; default: all.
        """
        columns = np.ones(len(self.table), bool) if present is None else np.asarray(present, bool)
        return Part(~np.isin(self.train, np.asarray(without, int)), columns)

    def linearise(self, x: np.ndarray, part: Part | None = None) -> Linearised:
        """Return the residuals of the fitted segments at ``x (P,)``, and their derivatives."""
        return self.residuals.linearise(np.asarray(x, np.float64), part or self.part())

    def loss(self, x: np.ndarray, part: Part | None = None) -> float:
        """Return the loss at ``x (P,)``."""
        return self.residuals.loss(np.asarray(x, np.float64), part or self.part())

    def losses(self, candidates: np.ndarray, middle: np.ndarray, part: Part | None = None) -> np.ndarray:
        """Return the loss of each candidate ``(N, P)``, with initial states linearised at ``middle (P,)``."""
        return self.residuals.losses(np.asarray(candidates), np.asarray(middle), part or self.part())

    def predict(self, values: Mapping[str, Any], segments: np.ndarray, fit_s: np.ndarray) -> np.ndarray:
        """Return the residuals of ``simulated``."""
        return self.simulated(values, segments, fit_s)[0]

    def simulated(
        self, values: Mapping[str, Any], segments: np.ndarray, fit_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals of segments whose initial states are fitted to their first parts, and these states.

        Args:
            values: Parameters by name, ``(R, ...)``: each segment with its own.
            segments: Shape ``(R,)``: numbers of the segments.
            fit_s: Shape ``(R,)``: lengths of the first parts [s].

        Returns:
            Residuals ``(R, K, F)``, and initial states ``(R, 2 * channels)``: positions, then velocities.
        """
        return self.residuals.predict(values, np.asarray(segments), np.asarray(fit_s))

    def with_readings(self, readings: Mapping[str, np.ndarray]) -> Problem:
        """Return the same segments with other measurements, ``(E, K, ...)`` of each field; both share programs."""
        other, measured = copy.copy(self), {f: np.array(rows) for f, rows in self.data.measured.items()}
        for field, rows in readings.items():
            measured[field][: rows.shape[0], : rows.shape[1]] = rows
        other.readings, other.data = (
            readings,
            self.data._replace(measured=jax.tree_util.tree_map(jnp.asarray, measured)),
        )
        other._begin_residuals(self.residuals)
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
            other._begin_residuals(self.residuals)
        return other


def thinned(problem: Problem, parts: np.ndarray, most: float) -> Problem:
    """Return a problem with the segments with most motion of each part, if a Jacobian of all would take long.

    Args:
        parts: Shape ``(K, S)``, bool: which fitted segments are in each part, which keeps one at least.
        most: Steps of single joints in a Jacobian.
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
        live |= problem.residuals.liveliest(problem.part(problem.train[~touched]), each + (k < more)).live
    return problem.recut([problem.spans[i] for i in problem.train[live]], problem.segment_s)


def of_recordings(problem: Problem) -> np.ndarray:
    """Return which fitted segments are in each recording, ``(K, S)``, bool."""
    recording = problem.recording[problem.train]
    return recording == np.unique(recording)[:, None]


def few_of(problem: Problem) -> Problem:
    """Return a problem with the segments with most motion, of whichever recording, if all would take long."""
    return thinned(problem, np.ones((1, len(problem.train)), bool), MOST_OF_SETS)
