"""The residuals of a log: what the model predicts minus what was measured, segment by segment.

The log is cut into segments. Each is simulated with the recorded commands and the recorded timing from an initial
state of its own, which is solved for inside every evaluation (one Gauss-Newton step on the linearised rollout), so the
search sees dynamics and delays alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S, BaseNode, to_ticks
from sim2real.graph.schedule import draw
from sim2real.graph.timeline import Timeline
from sim2real.identify.parameters import ParameterTable
from sim2real.runtime.compiled import CompiledGraph


@dataclass(frozen=True)
class Channel:
    """A measured joint: fields of the sensor's output, and how far a measurement may be off.

    Attributes:
        position: Field of the angle or position.
        velocity: Field of its rate.
        position_sigma: [position's unit].
        velocity_sigma: [velocity's unit].
    """

    position: str
    velocity: str
    position_sigma: float
    velocity_sigma: float

    @property
    def fields(self) -> tuple[tuple[str, float], tuple[str, float]]:
        """Field and deviation of position and of velocity, in the order of residuals."""
        return (self.position, self.position_sigma), (self.velocity, self.velocity_sigma)


class IdentifiableModel(Protocol):
    """What a pipeline provides for identification."""

    parameters: ParameterTable
    sensor: str
    given: Mapping[str, Any]
    channels: tuple[Channel, ...]

    def nodes(self, max_delay_s: float) -> dict[str, BaseNode]:
        """Return sensor, given nodes and world, connected with trainable delays up to ``max_delay_s``."""
        ...

    def params(self, values: Mapping[str, Any], start: Any) -> dict[str, Any]:
        """Return node parameters for values and an initial state ``(2 * channels,)``: positions, then velocities."""
        ...


class Problem:
    """Segments of one log, ready to be simulated for any parameters.

    Args:
        model: The pipeline's model.
        episode: The log.
        begins_s: Shape ``(E,)``: where the segments start [s].
        segment_s: Their length [s].
        max_delay_s: Upper bound of each delay [s].
        train: Shape ``(E,)``, bool: the segments that the loss is made of; default: all.

    Raises:
        Sim2RealError: When the log lacks a node or a field, or holds values that are no numbers.
        UsageError: When a segment holds too few measurements.
    """

    def __init__(
        self,
        model: IdentifiableModel,
        episode: Episode,
        begins_s: np.ndarray,
        segment_s: float,
        max_delay_s: float,
        train: np.ndarray | None = None,
    ) -> None:
        self.model = model
        self.table = model.parameters
        self.channels = model.channels
        nodes = model.nodes(max_delay_s)
        _check_log(episode, model)
        recorded = Timeline.from_episode(episode, {n: nodes[n] for n in (model.sensor, *model.given)})
        begins = [to_ticks(b) for b in begins_s]
        # Commands sent before a segment still act in it, up to the largest delay.
        lead = {n: 2 * to_ticks(max_delay_s) for n in model.given}
        segments, firsts = recorded.cut(begins, to_ticks(segment_s), lead)
        given = {
            n: jax.tree_util.tree_map(lambda f, n=n: _slices(episode.outputs[n][f], firsts[n], segments, n), tree)
            for n, tree in model.given.items()
        }
        timeline = draw(nodes, segment_s, recorded=segments)
        self.graph = CompiledGraph(nodes, model.sensor, timeline, given)
        fields = [f for c in self.channels for f in (c.position, c.velocity)]
        self._measured = {
            f: jnp.asarray(_slices(episode.outputs[model.sensor][f], firsts[model.sensor], segments, model.sensor))
            for f in fields
        }
        start = segments.vertices[model.sensor].start / TICKS_PER_S
        self.ts = jnp.asarray(np.where(start < segment_s, start, 0.0), jnp.float32)
        # Before this a measurement shows the world from before the segment's start.
        self._from_s = max_delay_s + 1.0 / min(n.rate for n in nodes.values())
        self.segment_s = segment_s
        self.begins_s = np.asarray(begins_s)
        self.train = np.flatnonzero(np.ones(len(begins_s), bool) if train is None else train)
        self._starts = jnp.asarray(_local_fits(episode, model, begins_s), jnp.float32)
        self.segments = self.graph.episodes
        # How far an initial state may be from its estimate. Wide: a narrow one would tell the delays apart by the
        # estimate's own bias, though shifting time between them changes nothing else.
        sigmas = [c.position_sigma for c in self.channels] + [c.velocity_sigma for c in self.channels]
        self.prior = 30.0 * jnp.array(sigmas)

    def _start(self, eps: Any, delay_s: Any) -> Any:
        """Return the initial state ``(2 * channels,)``: what was measured around the start, read ``delay_s`` later."""
        c = self._starts[eps]  # (channels, 4): a cubic in time
        t = jnp.asarray(delay_s, jnp.float32)
        position = c[:, 0] + t * (c[:, 1] + t * (c[:, 2] + t * c[:, 3]))
        velocity = c[:, 1] + t * (2 * c[:, 2] + t * 3 * c[:, 3])
        return jnp.concatenate([position, velocity])

    def measured(self, field: str) -> np.ndarray:
        """Return a field's measurements in the places of the residuals, ``(E, C)``."""
        table = self.graph.wiring.tables[-1].seq
        return np.take_along_axis(np.asarray(self._measured[field]), np.maximum(table, 0), axis=1)

    def simulate(self, values: Mapping[str, Any], eps: Any, shift: Any) -> tuple[Any, Any]:
        """Simulate a segment from its estimated initial state plus ``shift``.

        Returns:
            Predictions by field, and their weights: leaves of shape ``(C,)``; seq of the sensor, ``(C,)``.
        """
        start = self._start(eps, values.get("sensor_delay", 0.0)) + shift
        params = self.model.params(values, start)
        gs = self.graph.init(jax.random.key(0), params=params, eps=eps)
        _, records = self.graph.rollout(gs, record=(self.model.sensor,))
        record = records[self.model.sensor]
        return record.output, record.seq

    def residuals(self, values: Mapping[str, Any], eps: Any, shift: Any) -> tuple[Any, Any]:
        """Return scaled residuals ``(C, 2 * channels)`` of a segment, 0 where masked, and their times ``(C,)`` [s]."""
        predicted, seq = self.simulate(values, eps, shift)
        at = jnp.maximum(seq, 0)
        ts = self.ts[eps, at]
        counts = (seq >= 0) & (ts >= self._from_s)
        columns = []
        for c in self.channels:
            for field, sigma in c.fields:
                error = getattr(predicted, field) - self._measured[field][eps, at]
                columns.append(jnp.where(counts, error / sigma, 0.0))
        return jnp.stack(columns, axis=1), jnp.where(counts, ts, -1.0)

    def sensitivity(self, values: Mapping[str, Any], eps: Any, shift: Any) -> Any:
        """Return how a segment's residuals move with its initial state, ``(2 * channels, C, 2 * channels)``.

        Each row is for a shift of one component by its prior deviation.
        """
        push = jax.linearize(lambda s: self.residuals(values, eps, s)[0], shift)[1]
        return jax.vmap(push)(jnp.diag(self.prior))

    def projected(self, values: Mapping[str, Any], eps: Any, sensitivity: Any) -> tuple[Any, Any]:
        """Return a segment's residuals at the best initial state near its estimate.

        Args:
            values: Parameters.
            eps: The segment.
            sensitivity: What ``sensitivity`` returned at these parameters, or at some close by.

        Returns:
            Residuals ``(C, 2 * channels)`` and their times ``(C,)`` [s].
        """
        n = 2 * len(self.channels)
        error, ts = self.residuals(values, eps, jnp.zeros(n))
        shift = self._solve(error, ts, sensitivity, jnp.zeros(n), self.segment_s)
        return error + jnp.tensordot(shift, sensitivity, axes=1), ts

    def predict(self, values: Mapping[str, Any], eps: Any, fit_s: Any) -> tuple[Any, Any]:
        """Simulate a segment after fitting its initial state to the measurements of its first ``fit_s`` [s].

        Returns:
            Residuals ``(C, 2 * channels)``, scaled, and their times ``(C,)`` [s]; -1 where there is no measurement.
        """
        n = 2 * len(self.channels)

        def improve(shift: Any, _: None) -> tuple[Any, None]:
            error, ts = self.residuals(values, eps, shift)
            step = self._solve(error, ts, self.sensitivity(values, eps, shift), shift / self.prior, fit_s)
            return shift + step * self.prior, None

        shift, _ = jax.lax.scan(improve, jnp.zeros(n), length=3)
        return self.residuals(values, eps, shift)

    def losses(self, candidates: Any, around: Any) -> Any:
        """Return the mean robust loss of each candidate, ``(N,)``; about 0.5 per unit of squared scaled residual.

        The initial states of all candidates are solved for with the sensitivity at ``around``, the middle of the
        generation: one linearised rollout for all of them, which is exact once the search has closed in.

        Args:
            candidates: Shape ``(N, P)``.
            around: Shape ``(P,)``.
        """
        columns = self.sensitivities(around)

        def candidate(z: Any) -> Any:
            values = self.table.decode(z)

            def segment(eps: Any, sensitivity: Any) -> Any:
                r, ts = self.projected(values, eps, sensitivity)
                # Pseudo-Huber at 5 sigma: a swing that falls to the other side must not decide the fit.
                robust = 25.0 * (jnp.sqrt(1.0 + (r / 5.0) ** 2) - 1.0)
                return jnp.sum(robust) / jnp.maximum(jnp.sum(ts >= 0) * r.shape[1], 1)

            return jnp.mean(jax.vmap(segment)(jnp.asarray(self.train), columns))

        return jax.vmap(candidate)(candidates)

    def sensitivities(self, z: Any) -> Any:
        """Return the sensitivity of every segment of the loss at ``z``."""
        values, zero = self.table.decode(z), jnp.zeros(2 * len(self.channels))
        return jax.vmap(lambda e: self.sensitivity(values, e, zero))(jnp.asarray(self.train))

    def stacked(self, z: Any, columns: Any) -> Any:
        """Return all projected residuals at ``z``, ``(segments, C, 2 * channels)``, for given sensitivities."""
        values = self.table.decode(z)
        return jax.vmap(lambda e, c: self.projected(values, e, c)[0])(jnp.asarray(self.train), columns)

    def _solve(self, error: Any, ts: Any, sensitivity: Any, shift: Any, fit_s: Any) -> Any:
        """Return the Gauss-Newton step of the initial state, in units of the prior deviation."""
        n = 2 * len(self.channels)
        fitted = (ts >= 0) & (ts <= fit_s)
        J = jnp.where(fitted[None, :, None], sensitivity, 0.0).reshape(n, -1)
        r = jnp.where(fitted[:, None], error, 0.0).reshape(-1)
        return jnp.linalg.solve(J @ J.T + jnp.eye(n), -J @ r - shift)


def _check_log(episode: Episode, model: IdentifiableModel) -> None:
    """Raise unless the log holds the sensor's channels and the commands, as numbers."""
    for name in (model.sensor, *model.given):
        if name not in episode.steps or not len(episode.steps[name]):
            raise Sim2RealError(
                f"the log has no steps of node {name!r}. Available: {', '.join(episode.steps) or 'none'}",
                hint="identify from a log that this pipeline's record stage wrote",
            )
    wanted = [(model.sensor, f) for c in model.channels for f in (c.position, c.velocity)]
    wanted += [(node, f) for node, tree in model.given.items() for f in jax.tree_util.tree_leaves(tree)]
    for node, field in wanted:
        data = episode.outputs[node].get(field)
        if data is None:
            raise Sim2RealError(
                f"node {node!r} has no field {field!r} in this log. Available: {', '.join(episode.outputs[node])}",
                hint="identify from a log that this pipeline's record stage wrote",
            )
        finite = np.isfinite(data.reshape(len(data), -1)).all(axis=1)
        if not finite.all():
            raise Sim2RealError(
                f"field {field!r} of node {node!r} holds values that are no numbers, the first in step "
                f"{int(np.argmin(finite))}",
                hint="record again: a NaN cannot be identified from",
            )


def _slices(rows: np.ndarray, firsts: np.ndarray, segments: Timeline, name: str) -> np.ndarray:
    """Cut a node's recorded rows ``(N, ...)`` into segments ``(E, n, ...)``; what a segment lacks repeats its last."""
    width = segments.vertices[name].start.shape[1]
    index = np.minimum(firsts[:, None] + np.arange(width), len(rows) - 1)
    return rows[index]


def _local_fits(episode: Episode, model: IdentifiableModel, begins_s: np.ndarray) -> np.ndarray:
    """Fit a cubic in time to each channel's samples around each start; shape ``(E, channels, 4)``."""
    steps = episode.steps[model.sensor]
    t = np.where(steps.ts_overwrite >= 0, steps.ts_overwrite, steps.start) / TICKS_PER_S
    period = float(np.median(np.diff(t)))
    fits = np.zeros((len(begins_s), len(model.channels), 4))
    for e, begin in enumerate(begins_s):
        near = np.flatnonzero((t >= begin - 2.5 * period) & (t <= begin + 4.5 * period))
        if near.size < 4:
            raise UsageError(f"the log has {near.size} measurements around {begin:.3f} s, too few to start a segment")
        x = (t[near] - begin)[:, None]
        for i, c in enumerate(model.channels):
            q, v = (episode.outputs[model.sensor][f][near] for f in (c.position, c.velocity))
            rows = np.concatenate([x ** np.arange(4) / c.position_sigma, _slope_rows(x) / c.velocity_sigma])
            values = np.concatenate([q / c.position_sigma, v / c.velocity_sigma])
            fits[e, i] = np.linalg.lstsq(rows, values, rcond=None)[0]
    return fits


def _slope_rows(x: np.ndarray) -> np.ndarray:
    return np.concatenate([np.zeros_like(x), np.ones_like(x), 2 * x, 3 * x**2], axis=1)
