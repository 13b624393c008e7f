"""Distributions of computation and transport times: fixed, random, recorded or to be identified.

Timelines are drawn in numpy, all episodes at once. Wherever a distribution is expected, a number of seconds or a
distrax distribution is accepted too.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import partial
from numbers import Real
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import Base, InputState
from sim2real.graph.interpolation import between, mean_of, taken
from sim2real.later import jax, jnp
from sim2real.types import PyTree

if TYPE_CHECKING:
    from jax.typing import ArrayLike

    from sim2real.graph.base import Array, Number


class DelayDistribution(ABC):
    """A distribution over non-negative delays [s]."""

    @abstractmethod
    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Draw delays [s] of the given shape; the last axis holds successive messages or steps."""

    @abstractmethod
    def quantile(self, q: float) -> float:
        """Return the delay [s] that a fraction ``q`` of the samples does not exceed."""

    def window(self, rate_out: float) -> int:
        """Return the number of extra messages in the reader's window, for a sender at ``rate_out`` [Hz]."""
        del rate_out
        return 0


class StaticDist(DelayDistribution):
    """A constant delay, or a distrax distribution clipped at 0."""

    def __init__(self, dist: PyTree) -> None:
        self.dist = dist
        self._constant: float | None = None
        # Numbers and distributions without spread are constants.
        if isinstance(dist, Real):
            self._constant = float(dist)
        elif type(dist).__name__ == "Deterministic" or (type(dist).__name__ == "Normal" and float(dist.scale) == 0.0):
            self._constant = float(dist.loc)
        elif not callable(getattr(dist, "sample", None)):
            raise UsageError(
                f"a delay distribution was expected, got {dist!r}",
                hint="pass seconds, a distrax distribution or a DelayDistribution",
            )
        elif type(dist).__name__ == "Normal" and not (
            math.isfinite(float(dist.loc)) and math.isfinite(float(dist.scale))
        ):
            raise UsageError(f"a delay must be finite, got a Normal({float(dist.loc)}, {float(dist.scale)})")
        if self._constant is not None and (not math.isfinite(self._constant) or self._constant < 0):
            raise UsageError(f"a delay must be finite and at least 0 s, got {self._constant}")

    def __repr__(self) -> str:
        return f"StaticDist({self.dist!r})"

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Draw delays [s]; samples below 0 become 0."""
        if self._constant is not None:
            return np.full(shape, self._constant)
        if type(self.dist).__name__ == "Normal":  # numpy draws 1e6 in 10 ms; distrax would first compile for 300 ms
            raw = rng.normal(float(self.dist.loc), float(self.dist.scale), shape)
        else:
            key = jax.random.key(int(rng.integers(2**31)))
            raw = np.asarray(self.dist.sample(seed=key, sample_shape=shape), np.float64)
        return np.maximum(raw, 0.0)

    def quantile(self, q: float) -> float:
        """Return a quantile of the clipped distribution [s].

        Exact for a constant, a Normal and a mixture of Normals; of other distributions estimated from 1e5 samples.
        """
        if not 0.0 < q < 1.0:
            raise UsageError(f"a quantile lies between 0 and 1, got {q}")
        if self._constant is not None:
            return self._constant
        if type(self.dist).__name__ == "Normal":
            return max(0.0, NormalDist(float(self.dist.loc), float(self.dist.scale)).inv_cdf(q))
        components = getattr(self.dist, "components_distribution", None)
        if components is not None and type(components).__name__ == "Normal":
            weights = np.ravel(self.dist.mixture_distribution.probs)
            return _quantile_of_mixture(q, weights, np.ravel(components.loc), np.ravel(components.scale))
        samples = self.sample(np.random.default_rng(0), (100_000,))
        return float(np.quantile(samples, q))


def _quantile_of_mixture(q: float, weights: np.ndarray, loc: np.ndarray, scale: np.ndarray) -> float:
    """Return a quantile of a mixture of Normal distributions, clipped at 0, by bisection of its CDF."""
    parts = [NormalDist(float(m), max(float(s), 1e-12)) for m, s in zip(loc, scale, strict=True)]
    low = min(p.inv_cdf(q) for p in parts)
    high = max(p.inv_cdf(q) for p in parts)
    for _ in range(60):
        middle = (low + high) / 2
        below = sum(float(w) * p.cdf(middle) for w, p in zip(weights, parts, strict=True)) / float(weights.sum())
        low, high = (middle, high) if below < q else (low, middle)
    return max(0.0, high)


class EmpiricalDist(DelayDistribution):
    """Recorded delays, resampled in blocks of successive ones (block bootstrap): runs of slow steps stay together.

    Args:
        samples: Shape ``(n,)``: recorded delays [s] in the order in which they occurred.
        block: Length of a block; 1 draws every delay independently.
    """

    def __init__(self, samples: np.ndarray, block: int = 10) -> None:
        samples = np.asarray(samples, np.float64)
        if samples.ndim != 1 or samples.size == 0 or not np.isfinite(samples).all() or (samples < 0).any():
            raise UsageError("recorded delays must be a non-empty list of finite times of at least 0 s")
        self.samples = samples
        self.block = max(1, min(block, samples.size))

    def __repr__(self) -> str:
        return f"EmpiricalDist({self.samples.size} samples, block={self.block})"

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Draw blocks of recorded delays along the last axis [s]."""
        length = shape[-1]
        blocks = -(-length // self.block)
        starts = rng.integers(0, self.samples.size - self.block + 1, (*shape[:-1], blocks))
        index = starts[..., None] + np.arange(self.block)
        return self.samples[index].reshape(*shape[:-1], -1)[..., :length]

    def quantile(self, q: float) -> float:
        """Return a quantile of the record [s]."""
        return float(np.quantile(self.samples, q))


HALF_TICK_S = 0.5e-6
"""Half a tick of the schedule [s]."""
_INTERPOLATIONS = ("zoh", "linear", "linear_real_only", "zoh_mean")
_INTEGERS = ("hold", "round")


@pytree.dataclass
class TrainableDist(Base, DelayDistribution):
    """A delay that may change while the graph runs, between two bounds: ``min + alpha * (max - min)``.

    It is traced by JAX, so it can be identified or randomised without compiling again. Timelines are drawn with the
    smallest delay, and the reader's window is lengthened so that it holds the messages for every delay in the bounds.

    Attributes:
        alpha: Position between the bounds, in [0, 1]; traced.
        min: Smallest delay [s].
        max: Largest delay [s].
        interp: Interpolation in the window: ``zoh``, ``linear``, ``linear_real_only``, or ``zoh_mean`` (inputs of a
            world only); see ``apply``.
        burst: Extra messages in the window, for a sender that at times sends faster than its rate.
        integers: Interpolation of integers in messages: ``hold`` (the message that has arrived), or ``round``, for
            integers that are numbers on a line. Booleans always hold.
    """

    alpha: jax.Array
    min: float = pytree.field(pytree_node=False)
    max: float = pytree.field(pytree_node=False)
    interp: str = pytree.field(pytree_node=False, default="zoh")
    burst: int = pytree.field(pytree_node=False, default=0)
    integers: str = pytree.field(pytree_node=False, default="hold")

    @classmethod
    def create(
        cls, delay: float, min: float, max: float, interp: str = "zoh", burst: int = 0, integers: str = "hold"
    ) -> TrainableDist:
        """Return the distribution at a delay [s] between the bounds ``min`` and ``max`` [s].

        Args:
            burst: Recorded timing usually needs 1 or 2; the other arguments are those of the class.

        Raises:
            UsageError: Unless ``0 <= min < max``, ``min <= delay <= max``, and ``interp`` and ``integers`` are names
                above.
        """
        if interp not in _INTERPOLATIONS:
            raise UsageError(f"unknown interpolation {interp!r}. Available: {', '.join(_INTERPOLATIONS)}")
        if integers not in _INTEGERS:
            raise UsageError(f"integers cannot {integers!r}. Available: {', '.join(_INTEGERS)}")
        if not 0.0 <= min < max:
            raise UsageError(f"a trainable delay needs 0 <= min < max, got min={min} s and max={max} s")
        if not min <= delay <= max:
            raise UsageError(f"the delay {delay} s lies outside its bounds [{min}, {max}] s")
        alpha = jnp.float32((delay - min) / (max - min))
        return cls(alpha=alpha, min=min, max=max, interp=interp, burst=burst, integers=integers)

    @property
    def delay(self) -> jax.Array:
        """The delay [s], traced."""
        return self.min + self.alpha * (self.max - self.min)

    def with_delay(self, delay: ArrayLike) -> TrainableDist:
        """Return the distribution at another delay [s], clipped to its bounds."""
        alpha = jnp.clip((jnp.asarray(delay, jnp.float32) - self.min) / (self.max - self.min), 0.0, 1.0)
        return self.replace(alpha=alpha)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
        """Return the smallest delay [s] in the given shape: timelines are drawn with it."""
        del rng
        return np.full(shape, self.min)

    def quantile(self, q: float) -> float:
        """Return the delay [s] for every ``q``: a new connection takes it as its expected delay."""
        del q
        return float(self.delay)

    def window(self, rate_out: float) -> int:
        """Return the number of extra messages in the reader's window: ``ceil(rate_out * (max - min)) + burst``."""
        return math.ceil(round(rate_out * (self.max - self.min), 9)) + self.burst

    def apply(
        self, inputs: InputState, age_s: Array, window: int, period_s: float, ts_s: Number = 0.0, skip: bool = False
    ) -> InputState:
        """Return the messages that a step reads at this delay.

        - ``zoh``: the last ``window`` messages that have arrived.
        - ``linear``: linear interpolation between messages over their arrival times. The newest entry is the value at
          the step's start, between the last message that has arrived and the next one, which has not. The entries
          before it are values at earlier times: as much earlier as their messages arrived before the newest one. An
          empty slot has the default output, which counts as having arrived at time 0.
        - ``linear_real_only``: the same, but the default output counts as having arrived infinitely long ago: the
          first message's value is then used even before it arrives.
        - ``zoh_mean``: the mean over the reader's period of the message that holds.

        Floats are interpolated and averaged; other values, and ``seq``, are those of the message that has arrived at
        that time (see ``sim2real.graph.interpolation``).

        Args:
            inputs: The lengthened window, leaves ``(W, ...)``; its arrival times are those at the smallest delay. In
                numpy the copies' axes come behind the first one, of ``age_s`` too.
            age_s: Shape ``(W,)``: step start minus sent time of each message [s]; large for empty slots.
            period_s: The reader's period [s]; for ``zoh_mean``.
            ts_s: The step's start [s from the episode's start]; for ``linear``.
            skip: Whether a message that arrives exactly at the start belongs to the next step.
        """
        # Arrival times, and the time since arrival, at this delay; negative if a message has not arrived.
        late = age_s - self.delay
        received = jnp.where(inputs.seq >= 0, inputs.ts_sent + self.delay, inputs.ts_recv)
        inputs = inputs.replace(ts_recv=received)
        if self.interp == "zoh_mean":
            return _mean_over_period(inputs, late, window, period_s, self.integers == "round")

        # Find the last message that has arrived. Times are whole ticks, and float32 resolves half a tick at these ages:
        # exact ties are recognised.
        width = inputs.seq.shape[0]
        arrived = late > HALF_TICK_S if skip else late > -HALF_TICK_S
        last = jnp.maximum(jnp.sum(arrived, axis=0) - 1, window - 1)
        if self.interp == "zoh":
            return _part(inputs, last - window + 1, window)

        # Interpolate at the times of the last messages, moved so that the newest lies at the step's start.
        late = jnp.where(inputs.seq < 0, ts_s if self.interp == "linear" else 1e9, late)
        steps = jnp.arange(window - 1, -1, -1).reshape(-1, *[1] * last.ndim)
        query = -(taken(late, jnp.clip(last - steps, 0, width - 1)) - taken(late, last[None]))
        slack = -HALF_TICK_S if skip else HALF_TICK_S
        return _interpolate(inputs, -late, query, slack, self.integers == "round")


def _interpolate(inputs: InputState, knots: jax.Array, query: jax.Array, slack: float, rounded: bool) -> InputState:
    """Interpolate every leaf at the times ``query``; before the first knot and after the last it is constant.

    Times ``knots (W,)`` and ``query (w,)`` are relative to the reader's start [s]. A message holds from its knot on;
    ``slack`` [s] is added to the queries, so that exact ties are recognised.
    """
    above = jnp.clip(jnp.sum(knots[None] <= query[:, None], axis=1), 1, knots.shape[0] - 1)
    low, high = taken(knots, above - 1), taken(knots, above)
    span = jnp.where(high > low, high - low, 1.0)
    weight = jnp.clip((query - low) / span, 0.0, 1.0)
    held = jnp.maximum(jnp.sum(knots[None] < query[:, None] + slack, axis=1) - 1, 0)
    one = partial(between, low=above - 1, weight=weight, held=held)
    seq, sent, received = (one(leaf, rounded=False) for leaf in (inputs.seq, inputs.ts_sent, inputs.ts_recv))
    data = pytree.map(partial(one, rounded=rounded), inputs.data)
    return InputState(seq, sent, received, data, inputs.delay_dist)


def _mean_over_period(inputs: InputState, late: Array, window: int, period_s: float, rounded: bool) -> InputState:
    """Average the messages over the reader's period, each weighted by its holding time; differentiable in the delay.

    ``seq`` and times are not averaged: they are those of the message that holds when the period begins. The oldest
    message in the window counts as holding from the start of the period.
    """
    # Fraction of the period in which each message, or a newer one, holds.
    share = jnp.clip(1.0 + late / period_s, 0.0, 1.0)
    held = _part(inputs, jnp.maximum(jnp.sum(late > -HALF_TICK_S, axis=0) - window, 0), window)
    mean = pytree.map(lambda leaf, now: mean_of(leaf, share, now, rounded), inputs.data, held.data)
    return held.replace(data=mean)


def _part(inputs: InputState, first: Array, window: int) -> InputState:
    """Return ``window`` messages of each leaf ``(W, ...)`` from the message ``first`` on, one number for each copy."""
    if jnp.ndim(first) == 0:
        return jax.tree_util.tree_map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, window), inputs)
    index = first + jnp.arange(window).reshape(-1, *[1] * first.ndim)
    return pytree.map(lambda leaf: taken(leaf, index), inputs)
