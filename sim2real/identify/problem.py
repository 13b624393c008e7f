"""The residuals of recordings: what the model predicts minus what was measured, segment by segment.

Each segment is simulated with the recorded commands and timing, from an initial state of its own. Every evaluation
solves for these states (one Gauss-Newton step on the linearised rollout): a search is over dynamics and delays alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.graph.schedule import draw
from sim2real.identify.config import FitConfig
from sim2real.identify.derivative import finite_differences
from sim2real.identify.engine import CRollouts, check_devices, choose
from sim2real.identify.model import IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.programs import program
from sim2real.identify.robust import tamed
from sim2real.identify.segments import Data, Retimed, Span, cut
from sim2real.runtime.bursts import make_room
from sim2real.runtime.compiled import CompiledGraph


class Problem:
    """Segments of recordings, ready to be simulated for any parameters.

    Args:
        model: The pipeline's model.
        recordings: The logs.
        spans: The segments.
        length_s: Their length [s].
        config: How residuals are made.
        table: The parameters; default: the model's.
        moved: Changes the recorded timing of the segments before it is simulated.

    Raises:
        Sim2RealError: When a log lacks a node or a field, or holds values that are no numbers.
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
    ) -> None:
        self.model, self.config, self._recordings = model, config, recordings
        self.table = (table or model.parameters).for_recordings(len(recordings))
        self.channels = model.channels
        nodes = model.nodes(config.max_delay_s)
        self.engine = choose(config.engine, nodes, model.given, config.jacobian)
        # Commands sent before a segment still act in it, up to the largest delay.
        cuts = cut(model, nodes, recordings, spans, length_s, 2 * config.max_delay_s)
        self.spans, self.segment_s = cuts.spans, length_s
        timeline = draw(nodes, length_s + model.ahead_s, recorded=moved(cuts.timeline))
        make_room(nodes, timeline)  # after a hiccup commands leave in a burst
        self.graph = CompiledGraph(nodes, model.sensor, timeline, cuts.given)
        check_devices(config.devices, self.engine)
        self._outside = CRollouts(self.graph, self.engine.model) if self.engine.name == "c" else None
        self.segments = self.graph.episodes
        self.begins_s = np.array([s.begin_s for s in self.spans])
        self.recording = np.array([s.recording for s in self.spans])
        self.train = np.flatnonzero([s.fitted for s in self.spans])
        self.given = cuts.given
        self.data = Data.of(cuts)
        self._recording = jnp.asarray(self.recording)
        self._ts = jnp.asarray(cuts.ts, jnp.float32)
        # Traced once for all programs that it is a part of: tracing a rollout of MuJoCo takes 6 s.
        self._rollout = jax.jit(self._simulate)
        self._first = jax.tree_util.tree_map(lambda rows: jnp.asarray(rows[:, 0]), dict(cuts.given))
        # Before this a measurement shows the world from before the segment's start.
        self._from_s = max(config.max_delay_s + 1.0 / min(n.rate for n in nodes.values()), config.skip_s)
        if not np.any(cuts.ts >= self._from_s):
            raise UsageError(
                f"segments of {length_s:g} s leave nothing to compare after their first {self._from_s:g} s",
                hint="make them longer, or max_delay_s or skip_s smaller",
            )
        # How far an initial state may be from its estimate. Wide: a narrow prior would seem to tell the delays apart,
        # by nothing but the bias of that estimate.
        sigmas = [c.position_sigma for c in self.channels] + [c.velocity_sigma for c in self.channels]
        self.prior = 30.0 * jnp.array(sigmas)
        self.programs: dict[Any, Any] = {}
        """Programs that ``search`` and ``refine`` compiled, kept for their next call."""
        self._late = [p.name for p in self.table if p.side == "measurement"]
        sought = config.jacobian == "auto" and self._outside is None
        self.forward = config.jacobian == "forward" or (sought and self._has_derivative())

    @property
    def fields(self) -> list[tuple[str, float, Callable[[Any], Any]]]:
        """The columns of the residuals: field, deviation, and how to take the channel's entry of it."""
        return [(field, sigma, c.of) for c in self.channels for field, sigma in c.fields]

    def measured(self, column: int) -> np.ndarray:
        """Return the measurements that a column's residuals compare with, ``(E, C)``; see ``places``."""
        field, _, entry = self.fields[column]
        return np.take_along_axis(np.asarray(entry(self.data.measured[field])), np.maximum(self.places, 0), axis=1)

    @property
    def places(self) -> np.ndarray:
        """Number of the measurement that each of the ``C`` predictions is of, ``(E, C)``; -1 where there is none.

        A sensor that ran faster than its node's rate has several slots in a row of the compiled graph.
        """
        wiring = self.graph.wiring
        own = [t.seq for n, t in zip(wiring.slots, wiring.tables, strict=True) if n == self.model.sensor]
        return np.stack(own, axis=-1).reshape(self.segments, -1)

    def simulate(self, values: Mapping[str, Any], eps: Any, shift: Any, data: Data | None = None) -> tuple[Any, Any]:
        """Simulate a segment.

        Args:
            values: Parameters by name.
            eps: Number of the segment.
            shift: Shape ``(2 * channels,)``: added to the initial state that was estimated from the log.
            data: What was measured; default: the logs.

        Returns:
            The sensor's predictions, leaves of shape ``(C, ...)``, and the numbers of their steps, ``(C,)``.
        """
        own = self.table.of_recording(values, self._recording[eps])
        start = self.start(eps, sum(own[n] for n in self._late), data or self.data) + shift
        return self._rollout(own, start, eps)

    def _simulate(self, own: Mapping[str, Any], start: Any, eps: Any) -> tuple[Any, Any]:
        """Simulate a segment for one recording's parameters, from an initial state."""
        params = self.model.params(own, start)
        gs = self.graph.init(jax.random.key(0), params=params, eps=eps)
        # The first recorded command is taken to have held before, too: nothing else is known.
        first = jax.tree_util.tree_map(lambda rows: rows[eps], self._first)
        cast = lambda new, old: jnp.asarray(new, old.dtype)  # noqa: E731
        held = {n: jax.tree_util.tree_map(cast, first[n], gs.buffer[n]) for n in first}
        gs = gs.replace(buffer={**gs.buffer, **held})
        sensor = self.model.sensor
        if self._outside is None:
            record = self.graph.rollout(gs, record=(sensor,))[1][sensor]
        else:
            record = self._outside.rollout(gs, params, sensor)
        return record.output, record.seq

    def residuals(self, values: Mapping[str, Any], eps: Any, shift: Any, data: Data | None = None) -> tuple[Any, Any]:
        """Return how far the predictions of a segment are off.

        Args:
            values: Parameters by name.
            eps: Number of the segment.
            shift: Shape ``(2 * channels,)``: added to the initial state that was estimated from the log.
            data: What was measured; default: the logs.

        Returns:
            Residuals ``(C, fields)`` in deviations of the measurement, and their times ``(C,)`` [s]; 0 and -1 where
            nothing is compared.
        """
        data = data or self.data
        predicted, seq = self.simulate(values, eps, shift, data)
        at = jnp.maximum(seq, 0)
        ts = self._ts[eps, at]
        counts = (seq >= 0) & (ts >= self._from_s)
        columns = []
        for field, sigma, entry in self.fields:
            error = entry(getattr(predicted, field)) - entry(jnp.asarray(data.measured[field]))[eps, at]
            columns.append(jnp.where(counts, error / sigma, 0.0))
        return jnp.stack(columns, axis=1), jnp.where(counts, ts, -1.0)

    def sensitivity(self, values: Mapping[str, Any], eps: Any, shift: Any, data: Data | None = None) -> Any:
        """Return the derivative of a segment's residuals by its initial state, ``(2 * channels, C, fields)``.

        Each row is for a shift of one component by its prior deviation.

        Args:
            values: Parameters by name.
            eps: Number of the segment.
            shift: Shape ``(2 * channels,)``: added to the initial state that was estimated from the log.
            data: What was measured; default: the logs.
        """
        size = len(self.prior)
        of_shift = self.differentiable(lambda u: self.residuals(values, eps, shift + u * self.prior, data)[0], 0.03)
        push = jax.linearize(of_shift, jnp.zeros(size))[1]
        return jax.vmap(push)(jnp.eye(size))

    def projected(
        self, values: Mapping[str, Any], eps: Any, sensitivity: Any, data: Data | None = None
    ) -> tuple[Any, Any]:
        """Return a segment's residuals at the best initial state near its estimate.

        Args:
            values: Parameters.
            eps: The segment.
            sensitivity: What ``sensitivity`` returned at these parameters, or at some close by.
            data: What was measured; default: the logs.

        Returns:
            Residuals ``(C, fields)`` and their times ``(C,)`` [s].
        """
        n = 2 * len(self.channels)
        error, ts = self.residuals(values, eps, jnp.zeros(n), data)
        if sensitivity is None:
            return error, ts
        shift = self._solve(error, ts, sensitivity, jnp.zeros(n), self.segment_s)
        return error + jnp.tensordot(shift, sensitivity, axes=1), ts

    def predict(self, values: Mapping[str, Any], eps: Any, fit_s: Any) -> tuple[Any, Any]:
        """Simulate a segment after fitting its initial state to the measurements of its first part.

        Args:
            values: Parameters by name.
            eps: Number of the segment.
            fit_s: Length of that part [s].

        Returns:
            Residuals ``(C, fields)``, scaled, and their times ``(C,)`` [s]; -1 where there is no measurement.
        """
        shift = jnp.zeros(2 * len(self.channels))
        error, ts = self.residuals(values, eps, shift)
        counts = ((ts >= 0) & (ts <= fit_s))[:, None]

        def step(_: Any, at: tuple[Any, Any]) -> tuple[Any, Any]:
            shift, error = at
            sensitivity = self.sensitivity(values, eps, shift * self.prior)
            moved = shift + self._solve(error, ts, sensitivity, shift, fit_s)
            after, _ = self.residuals(values, eps, moved * self.prior)
            # Near kinks, such as friction that sticks, the linear step may make it worse.
            gain = jnp.sum(jnp.where(counts, error**2 - after**2, 0.0)) + jnp.sum(shift**2 - moved**2)
            return jnp.where(gain > 0, moved, shift), jnp.where(gain > 0, after, error)

        steps = 2 if self.config.initial_state == "free" else 0
        return jax.lax.fori_loop(0, steps, step, (shift, error))[1], ts

    def losses(self, candidates: Any, around: Any, pick: Any = None, data: Data | None = None) -> Any:
        """Return the loss of each candidate, ``(N,)``: half the mean square of its robust residuals, and the priors.

        One linearised rollout, at ``around``, serves to solve for the initial states of all candidates; the closer they
        are to it, the more exact that is.

        Args:
            candidates: Shape ``(N, P)``.
            around: Shape ``(P,)``: the middle of the generation.
            pick: Shape ``(B,)``: the segments to take, the same for all candidates; default: all that are fitted.
            data: What is fitted; default: the logs.
        """
        pick = jnp.asarray(self.train) if pick is None else pick
        columns = self.sensitivities(around, pick, data)
        return jax.vmap(lambda z: self._loss(z, pick, columns, data))(candidates)

    def _loss(self, z: Any, pick: Any, columns: Any, data: Data | None) -> Any:
        values = self._values(z, data)
        r, ts = jax.vmap(lambda e, c: self.projected(values, e, c, data))(pick, columns)
        r, counts = self._tamed(r), ts >= 0
        if data is not None and data.weight is not None:
            own = data.weight[pick]
            r, counts = r * own[:, None, None], counts * own[:, None]
        prior = jnp.sum(self.table.prior_residuals(z) ** 2) / self.measurements
        return 0.5 * (jnp.sum(r**2) / jnp.maximum(jnp.sum(counts) * r.shape[-1], 1) + prior)

    def at(self, z: jax.typing.ArrayLike, data: Data | None = None) -> tuple[Any, float]:
        """Return ``sensitivities`` of the fitted segments at a point, and the loss there; compiled once.

        Args:
            z: Shape ``(P,)``: the parameters.
            data: What is fitted; default: the logs.
        """
        if "at" not in self.programs:
            pick = jnp.asarray(self.train)

            def at(z: Any, data: Data) -> tuple[Any, Any]:
                columns = self.sensitivities(z, pick, data)
                return columns, self._loss(z, pick, columns, data)

            self.programs["at"] = program(at)
        columns, loss = self.programs["at"](jnp.asarray(z, jnp.float32), data or self.part())
        return columns, float(loss)

    def sensitivities(self, z: Any, pick: Any = None, data: Data | None = None) -> Any:
        """Return ``sensitivity`` for several segments, ``(B, 2 * channels, C, fields)``; None if states are not fitted.

        Args:
            z: Shape ``(P,)``: the parameters.
            pick: Shape ``(B,)``: the segments; default: all that are fitted.
            data: What was measured; default: the logs.
        """
        if self.config.initial_state != "free":
            return None
        values, zero = self._values(z, data), jnp.zeros(2 * len(self.channels))
        pick = jnp.asarray(self.train) if pick is None else pick
        return jax.vmap(lambda e: self.sensitivity(values, e, zero, data))(pick)

    def stacked(self, z: Any, columns: Any, data: Data | None = None) -> Any:
        """Return the robust residuals of all fitted segments, ``(segments, C, fields)``.

        Args:
            z: Shape ``(P,)``: the parameters.
            columns: What ``sensitivities`` returned.
            data: What was measured; default: the logs.
        """
        return self._tamed(self._untamed(z, columns, data))

    def linearised(self, z: Any, columns: Any, data: Data | None = None) -> tuple[Any, Any, Any]:
        """Return ``stacked``, its Jacobian ``(segments, C, fields, P)``, and the residuals without a robust loss.

        Args:
            z: Shape ``(P,)``: the parameters.
            columns: What ``sensitivities`` returned.
            data: What was measured; default: the logs.
        """
        f = self.differentiable(lambda y: self._untamed(y, columns, data))
        raw, J = jax.vmap(lambda d: jax.jvp(f, (z,), (d,)), out_axes=(None, -1))(jnp.eye(z.size, dtype=z.dtype))
        r, slope = jax.jvp(self._tamed, (raw,), (jnp.ones_like(raw),))
        return r, slope[..., None] * J, raw

    def _untamed(self, z: Any, columns: Any, data: Data | None) -> Any:
        values, pick = self._values(z, data), jnp.asarray(self.train)
        residuals = jax.vmap(lambda e, c: self.projected(values, e, c, data)[0])(pick, columns)
        if data is None or data.weight is None:
            return residuals
        return residuals * data.weight[pick][:, None, None]

    def _values(self, z: Any, data: Data | None) -> dict[str, Any]:
        """Return the parameters' values, those of terms that are left out at what they are without."""
        return self.table.decode(z, None if data is None else data.kept)

    def _tamed(self, residuals: Any) -> Any:
        return tamed(residuals, self.config.loss, self.config.reach)

    @property
    def measurements(self) -> int:
        """Measured numbers in the fitted segments."""
        return int((np.asarray(self._ts)[self.train] >= self._from_s).sum()) * len(self.fields)

    def differentiable(self, f: Callable[[Any], Any], step: float | None = None) -> Callable[[Any], Any]:
        """Return a function of one array with a derivative: its own, or finite differences; default: as configured."""
        return f if self.forward else finite_differences(f, step or self.config.difference)

    def _has_derivative(self) -> bool:
        """Return whether every node can be differentiated: a callback to Python, say, cannot."""
        point, still = jnp.zeros(len(self.table)), jnp.zeros(2 * len(self.channels))
        errors = lambda z: self.residuals(self.table.decode(z), 0, still)[0]  # noqa: E731
        try:
            jax.eval_shape(lambda z: jax.jvp(errors, (z,), (z,)), point)
        except (ValueError, TypeError, NotImplementedError):
            return False
        return True

    def part(self, left_out: Any = (), kept: Any = None) -> Data:
        """Return what is fitted without some segments, and with some of the parameters.

        Args:
            left_out: Numbers of the segments that do not count.
            kept: Shape ``(P,)``, bool: which free parameters are part of the model; default: all.
        """
        weight = np.ones(self.segments, np.float32)
        weight[np.asarray(left_out, int)] = 0.0
        kept = np.ones(len(self.table), bool) if kept is None else np.asarray(kept)
        return self.data._replace(weight=jnp.asarray(weight), kept=jnp.asarray(kept))

    def cut_anew(self, spans: Sequence[Span], length_s: float, moved: Retimed = lambda recorded: recorded) -> Problem:
        """Return the same recordings, cut anew.

        Args:
            spans: The segments.
            length_s: Their length [s].
            moved: Changes their recorded timing.
        """
        config = replace(self.config, jacobian="forward" if self.forward else "finite")  # to find out takes a second
        return Problem(self.model, self._recordings, spans, length_s, config, self.table, moved)

    def start(self, eps: Any, delay_s: Any, data: Data) -> Any:
        """Return the initial state ``(2 * channels,)`` as measured around the start.

        Args:
            eps: Number of the segment.
            delay_s: How late samples come [s].
            data: What was measured.
        """
        c = jnp.asarray(data.starts)[eps]  # (channels, 4): a cubic in time
        if self.config.initial_state == "rest":
            return jnp.concatenate([c[:, 0], jnp.zeros(len(self.channels))])
        t = jnp.asarray(delay_s, jnp.float32)
        position = c[:, 0] + t * (c[:, 1] + t * (c[:, 2] + t * c[:, 3]))
        velocity = c[:, 1] + t * (2 * c[:, 2] + t * 3 * c[:, 3])
        return jnp.concatenate([position, velocity])

    def _solve(self, error: Any, ts: Any, sensitivity: Any, shift: Any, fit_s: Any) -> Any:
        """Return the Gauss-Newton step of the initial state, in units of the prior deviation."""
        n = 2 * len(self.channels)
        fitted = (ts >= 0) & (ts <= fit_s)
        J = jnp.where(fitted[None, :, None], sensitivity, 0.0).reshape(n, -1)
        r = jnp.where(fitted[:, None], error, 0.0).reshape(-1)
        return jnp.linalg.solve(J @ J.T + jnp.eye(n), -J @ r - shift)
