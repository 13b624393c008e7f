"""The residuals of a segment, prediction minus measurement, as a function of parameters and data.

``Data`` is an argument and holds everything that differs between logs, so compiled programs depend on shapes alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import GraphState
from sim2real.graph.node import BaseNode
from sim2real.identify.config import FitConfig
from sim2real.identify.model import CarriesPayload, IdentifiableModel
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.derivative import finite_differences
from sim2real.identify.problem.engine import Choice, CRollouts, Outside
from sim2real.identify.problem.programs import Program
from sim2real.identify.problem.robust import tamed
from sim2real.identify.problem.segments import Data
from sim2real.installation import has_jax
from sim2real.later import jax, jnp
from sim2real.runtime.compiled.open_loop import OpenLoopGraph
from sim2real.types import Array, PyTree, Scalar

_STATE_STEPS = 2
"""Points at which a segment's initial state is linearised. With one point the loss of a pendulum's
log jumped by 3 % where the delays changed by 0.3 ms, with two by 0.2 %."""
STATE_DIFFERENCE = 0.03
"""Step of finite differences by an initial state, in its prior deviation."""


class InitialState(NamedTuple):
    """A point at which the residuals of a segment are linearised by its initial state.

    Attributes:
        shift: Shape ``(2 * channels,)``: distance from the estimate from the log, in deviations of the prior.
        slope: Shape ``(2 * channels, K, F)``: d residual / d shift.
        residuals: Shape ``(K, F)``: the residuals at the point.
    """

    shift: Array
    slope: Array
    residuals: Array


_Function = Callable[..., PyTree]
_StateSearch = tuple[Array, InitialState, Array]
"""The next candidate, the best point so far, and its cost."""


class LinearisedSegments(NamedTuple):
    """The residuals of all fitted segments and their derivatives; leaves as in ``Evaluation``."""

    residuals: Array
    jacobian: Array
    raw: Array
    prior: Array
    prior_jacobian: Array
    loss: Array | float


class SegmentResiduals:
    """The residuals of a model, for any data of one robot.

    Attributes:
        prior: Shape ``(2 * channels,)``: deviation of an initial state from its estimate. It is wide: with a narrow
            prior the bias of that estimate would seem to separate the delays.
        forward: Whether derivatives are taken in forward mode; else by finite differences.
        programs: The compiled programs by name.
    """

    def __init__(
        self,
        model: IdentifiableModel,
        nodes: Mapping[str, BaseNode],
        table: ParameterTable,
        config: FitConfig,
        engine: Choice,
    ) -> None:
        self.model, self.table, self.config, self.engine = model, table, config, engine
        self.graph = OpenLoopGraph(nodes, model.sensor, model.given)
        self._outside = CRollouts(self.graph, engine.model) if engine.name == "c" else None
        self.channels = model.channels
        sigmas = [c.position_sigma for c in self.channels] + [c.velocity_sigma for c in self.channels]
        self.prior = 30.0 * np.array(sigmas, np.float32)
        self.forward = config.jacobian == "forward"
        self.programs: dict[str, Program] = {}
        self._late = [p.name for p in table if p.side == "measurement"]

    @functools.cached_property
    def _rollout(self) -> Callable[..., PyTree]:
        """``_simulate``, traced once for all programs that contain it: tracing MuJoCo takes 6 s."""
        return jax.jit(self._simulate)

    @property
    def outside(self) -> CRollouts:
        """C MuJoCo, if it is the engine."""
        if self._outside is None:
            raise UsageError(f"the engine is not C MuJoCo: {self.engine}")
        return self._outside

    @property
    def fields(self) -> list[tuple[str, float, Callable[[PyTree], PyTree]]]:
        """The columns of the residuals: field, deviation, and a function that takes the channel's entry."""
        return [(field, sigma, c.of) for c in self.channels for field, sigma in c.fields]

    def program(self, name: str, function: Callable[..., PyTree]) -> Program:
        """Return the compiled program of a name; all problems of a model share it."""
        if name not in self.programs:
            self.programs[name] = Program(function)
        return self.programs[name]

    def of_copies(self, name: str, function: _Function, axes: tuple[int | None, ...]) -> _Function:
        """Return a function of many copies: compiled, or, without JAX, the function itself on arrays of copies."""
        return self.program(name, jax.vmap(function, axes)) if has_jax() else function

    def simulate(self, values: Mapping[str, Array], eps: Array | int, shift: Array, data: Data) -> PyTree:
        """Return the sensor's predictions of a segment, leaves ``(K, ...)``.

        Args:
            shift: Shape ``(2 * channels,)``: added to the initial state that was estimated from the log.
        """
        values_, start = self._started(values, eps, shift, data)
        tables, messages = jax.tree_util.tree_map(lambda rows: rows[eps], (data.tables, data.messages))
        return self._rollout(values_, start, tables, messages, eps)

    def _simulate(
        self, values: Mapping[str, PyTree], start: PyTree, tables: PyTree, messages: PyTree, eps: Array | int
    ) -> PyTree:
        """Simulate a segment for one recording's parameters, from an initial state."""
        params = self._params(values, start, messages)
        gs = self._first(params, messages, eps)
        if self.engine.name == "c":
            return self.outside.rollout(gs, params, tables, messages, self.model.sensor)
        return self.graph.run(gs, tables, messages, self.model.sensor)

    def _started(
        self, values: Mapping[str, Array], eps: Array | int, shift: Array, data: Data
    ) -> tuple[dict[str, PyTree], jax.Array]:
        """Return the parameters of a segment's recording, and its initial state."""
        values_ = self.table.of_recording(values, data.recording[eps])
        return values_, self.start(eps, sum(values_[n] for n in self._late), data) + shift

    def _params(self, values: Mapping[str, PyTree], start: PyTree, messages: PyTree) -> dict[str, PyTree]:
        """Return the parameters of the nodes for a segment, with the payload of its log."""
        params = self.model.params(values, start)
        if not isinstance(self.model, CarriesPayload):
            return params
        return self.model.loaded(params, pytree.map(lambda rows: rows[0], messages))

    def _first(self, params: Mapping[str, PyTree], messages: PyTree, eps: Array | int) -> GraphState:
        # Assume that the first recorded command held before, too.
        first = pytree.map(lambda rows: rows[0], messages)
        return self.graph.begin(params, first, jnp.asarray(eps, jnp.int32))

    def _begun(
        self, values: Mapping[str, Array], eps: Array | int, shift: Array, data: Data
    ) -> tuple[dict[str, PyTree], GraphState, PyTree, PyTree]:
        """Return parameters of the nodes, first state, timing and commands of a segment."""
        started = self._started(values, eps, shift, data)
        tables, messages = pytree.map(lambda rows: rows[eps], (data.tables, data.messages))
        if np.ndim(eps):  # in numpy, copies come behind time and window
            tables = pytree.map(lambda rows: np.moveaxis(rows, 0, -1), tables)
            messages = pytree.map(lambda rows: np.swapaxes(rows, 0, 1), messages)
        params = self._params(*started, messages)
        return params, self._first(params, messages, eps), tables, messages

    def inputs(self, values: Mapping[str, Array], eps: Array | int, shift: Array, data: Data) -> Outside:
        """Return the inputs with which C simulates a segment; ``shift`` as in ``simulate``."""
        params, gs, tables, messages = self._begun(values, eps, shift, data)
        return self.outside.inputs(gs, params, tables, messages)

    def errors(
        self, values: Mapping[str, Array], eps: Array | int, shift: Array, moved: PyTree, data: Data
    ) -> jax.Array:
        """Return ``residuals`` of a segment that C simulated."""
        _, gs, tables, messages = self._begun(values, eps, shift, data)
        return self._compared(self.outside.outputs(gs, moved, tables, messages, self.model.sensor), eps, data)

    def residuals(self, values: Mapping[str, Array], eps: Array | int, shift: Array, data: Data) -> jax.Array:
        """Return prediction minus measurement of a segment, ``(K, F)``, in deviations of the measurement.

        It is 0 where ``data.ts`` is -1; ``shift`` as in ``simulate``.
        """
        return self._compared(self.simulate(values, eps, shift, data), eps, data)

    def _compared(self, predicted: Array, eps: Array | int, data: Data) -> jax.Array:
        counts, columns = data.ts[eps] >= 0.0, []
        for field, sigma, entry in self.fields:
            error = entry(getattr(predicted, field)) - entry(data.measured[field][eps])
            columns.append(jnp.where(counts, error / sigma, 0.0))
        return jnp.stack(columns, axis=-1)

    def initial_state(
        self,
        values: Mapping[str, Array],
        eps: Array | int,
        data: Data,
        fit_s: Array | None = None,
        points: int = _STATE_STEPS,
    ) -> InitialState:
        """Fit a segment's initial state by Gauss-Newton steps; return the best point.

        Args:
            fit_s: Length of the segment's first part, to which the state is fitted [s]; default: the whole segment.
        """
        zero = jnp.zeros(len(self.prior))
        like = jax.eval_shape(lambda: self.residuals(values, eps, zero, data))
        counts = self._fitted(eps, data, fit_s)

        def step(i: jax.Array, at: _StateSearch) -> _StateSearch:
            candidate, best, least = at
            of_shift = self.differentiable(
                lambda u: self.residuals(values, eps, (candidate + u) * self.prior, data), STATE_DIFFERENCE
            )
            error, push = jax.linearize(of_shift, zero)
            here = InitialState(candidate, jax.vmap(push)(jnp.eye(len(zero))), error)
            cost = jnp.sum(jnp.where(counts, error, 0.0) ** 2) + jnp.sum(candidate**2)
            # Near kinks, such as sticking friction, the linear step may increase the cost: go half way back.
            better = (i == 0) | (cost < least)
            best = jax.tree_util.tree_map(lambda new, old: jnp.where(better, new, old), here, best)
            after = jnp.where(better, candidate + self._solve(here, counts), (candidate + best.shift) / 2.0)
            return after, best, jnp.where(better, cost, least)

        blank = InitialState(zero, jnp.zeros((len(zero), *like.shape)), jnp.zeros(like.shape))
        return jax.lax.fori_loop(0, points, step, (zero, blank, jnp.float32(0.0)))[1]

    def projected(
        self, values: Mapping[str, Array], eps: Array | int, state: InitialState | None, data: Data
    ) -> jax.Array:
        """Return a segment's residuals ``(K, F)`` at the best initial state near its estimate.

        Args:
            state: Result of ``initial_state`` at these parameters, or at near ones; None if states are not fitted.
        """
        if state is None:
            return self.residuals(values, eps, jnp.zeros(len(self.prior)), data)
        error = self.residuals(values, eps, state.shift * self.prior, data)
        step = self._solve(state._replace(residuals=error), self._fitted(eps, data, None))
        return error + jnp.tensordot(step, state.slope, axes=1)

    def predict(self, values: Mapping[str, Array], eps: Array | int, fit_s: Array, data: Data) -> tuple[Array, Array]:
        """Return the residuals ``(K, F)`` of a segment whose initial state is fitted to its first part, and that state.

        Args:
            fit_s: Length of that part [s].
        """
        shift = jnp.zeros(len(self.prior))
        if self.config.initial_state != "free":
            return self.residuals(values, eps, shift, data), self.started(values, eps, shift, data)
        fitted = self.initial_state(values, eps, data, fit_s, _STATE_STEPS + 1)
        return fitted.residuals, self.started(values, eps, fitted.shift, data)

    def started(self, values: Mapping[str, Array], eps: Array | int, shift: Array, data: Data) -> Array:
        """Return a segment's initial state ``(2 * channels,)``: positions, then velocities.

        Args:
            shift: Shape ``(2 * channels,)``: distance from the estimate from the log, in deviations of the prior.
        """
        return self._started(values, eps, shift * self.prior, data)[1]

    def initial_states(self, z: Array, data: Data, pick: Array) -> InitialState | None:
        """Return ``initial_state`` of several segments, leaves ``(B, ...)``; None if states are not fitted.

        Args:
            z: Shape ``(P,)``: the parameters.
            pick: Shape ``(B,)``: numbers of the segments.
        """
        if self.config.initial_state != "free":
            return None
        values = self.table.decode(z, data.present)
        return jax.vmap(lambda e: self.initial_state(values, e, data))(pick)

    def losses(self, candidates: Array, around: Array, data: Data, pick: Array | None = None) -> jax.Array:
        """Return the loss of each candidate, ``(N,)``: half the mean square of its robust residuals, plus the priors.

        The initial states of all candidates are linearised at ``around``; the result is exact for a candidate at that
        point.

        Args:
            candidates: Shape ``(N, P)``.
            around: Shape ``(P,)``: the middle of the generation.
            pick: Shape ``(B,)``: places in ``data.fitted`` of the segments to take; default: all.
        """
        pick = jnp.arange(len(data.fitted)) if pick is None else pick
        states = self.initial_states(around, data, data.fitted[pick])

        def loss(z: Array) -> PyTree:
            raw = self._weighed(z, states, data, pick)
            return self._loss(self._tamed(raw), z, data, pick)

        return jax.vmap(loss)(candidates)

    def linearised(self, z: Array, data: Data) -> LinearisedSegments:
        """Return the residuals of all fitted segments and their derivatives at ``z (P,)``.

        Initial states are linearised at ``z``; the derivative neglects the change of their slopes (Kaufman, BIT 15,
        1975).
        """
        pick = jnp.arange(len(data.fitted))
        # Solve for the initial states, then differentiate the residuals with these states' slopes held.
        states = self.initial_states(z, data, data.fitted)
        f = self.differentiable(lambda y: self._weighed(y, states, data, pick))
        raw, J = jax.vmap(lambda d: jax.jvp(f, (z,), (d,)), out_axes=(None, -1))(jnp.eye(z.size, dtype=z.dtype))
        # Apply the robust loss to residuals and derivatives.
        r, slope = jax.jvp(self._tamed, (raw,), (jnp.ones_like(raw),))
        of_prior = self.table.prior_residuals
        prior = of_prior(z), jax.jacfwd(of_prior)(z)
        return LinearisedSegments(r, slope[..., None] * J, raw, *prior, self._loss(r, z, data, pick))

    def start(self, eps: Array | int, delay_s: Scalar, data: Data) -> jax.Array:
        """Return the initial state ``(2 * channels,)`` as measured around the start.

        Args:
            delay_s: Delay of the samples [s].
        """
        cubic = jnp.moveaxis(data.starts[eps], -1, 0)
        if self.config.initial_state == "rest":
            return jnp.concatenate([cubic[0], jnp.zeros_like(cubic[0])], axis=-1)
        t = jnp.asarray(delay_s, jnp.float32)[..., None]
        position = cubic[0] + t * (cubic[1] + t * (cubic[2] + t * cubic[3]))
        velocity = cubic[1] + t * (2 * cubic[2] + t * 3 * cubic[3])
        return jnp.concatenate([position, velocity], axis=-1)

    def differentiable(self, f: Callable[[PyTree], PyTree], step: float | None = None) -> Callable[[PyTree], PyTree]:
        """Return a function of one array with a derivative: its own, or finite differences; default: as configured."""
        return f if self.forward else finite_differences(f, step or self.config.difference)

    def choose_derivative(self, data: Data) -> None:
        """Take forward mode if every node can be differentiated and the configuration is ``auto``."""
        if self.config.jacobian != "auto" or self._outside is not None:
            return
        point, still = jnp.zeros(len(self.table)), jnp.zeros(len(self.prior))
        try:
            errors = lambda z, data: self.residuals(self.table.decode(z), 0, still, data)  # noqa: E731
            jax.eval_shape(lambda z, data: jax.jvp(lambda y: errors(y, data), (z,), (z,)), point, data)
        except (ValueError, TypeError, NotImplementedError):  # a callback to Python, say
            return
        self.forward = True

    def _weighed(self, z: Array, states: InitialState | None, data: Data, pick: Array | None) -> jax.Array:
        """Return the residuals of some fitted segments without the robust loss; 0 in segments without weight."""
        values = self.table.decode(z, data.present)
        raw = jax.vmap(lambda e, s: self.projected(values, e, s, data))(data.fitted[pick], states)
        return jnp.where(data.weight[pick, None, None] > 0.0, raw, 0.0)

    def _loss(self, r: jax.Array, z: Array, data: Data, pick: Array | None) -> jax.Array:
        compared = (data.ts[data.fitted[pick]] >= 0.0) & (data.weight[pick, None] > 0.0)
        prior = jnp.sum(self.table.prior_residuals(z) ** 2) / data.count
        return 0.5 * (jnp.sum(r**2) / jnp.maximum(jnp.sum(compared) * r.shape[-1], 1) + prior)

    def _tamed(self, residuals: jax.Array) -> jax.Array:
        return tamed(residuals, self.config.loss, self.config.reach)

    def _fitted(self, eps: Array | int, data: Data, fit_s: Array | None) -> jax.Array:
        """Return which measurements a segment's initial state is fitted to, ``(K, 1)``, bool."""
        ts = data.ts[eps]
        return ((ts >= 0.0) & (ts <= (data.length_s if fit_s is None else fit_s)))[:, None]

    def _solve(self, at: InitialState, counts: jax.Array) -> jax.Array:
        """Return the Gauss-Newton step of an initial state ``(2 * channels,)``, in deviations of the prior."""
        n = len(self.prior)
        J = jnp.where(counts[None], at.slope, 0.0).reshape(n, -1)
        r = jnp.where(counts, at.residuals, 0.0).reshape(-1)
        return jnp.linalg.solve(J @ J.T + jnp.eye(n), -J @ r - at.shift)
