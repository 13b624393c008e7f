"""Distributions of computation and transport times: fixed, random, recorded or to be identified.

Timelines are drawn in numpy, all episodes at once. Wherever a distribution is expected, a number of seconds or a
distrax distribution is accepted too.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from numbers import Real
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from sim2real import pytree
from sim2real.errors import UsageError
from sim2real.graph.base import Base, InputState
from sim2real.later import jax, jnp
from sim2real.types import PyTree

if TYPE_CHECKING:
    from jax.typing import ArrayLike

    from sim2real.graph.base import Array, Number


_CONSTANT_S = 1e-7
"""Recorded delays with a smaller standard deviation are a constant [s]."""
_MAX_LAG = 200
"""Largest lag at which the autocorrelation of recorded delays is computed [delays]."""


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

        Exact for a constant and a Normal; of other distributions estimated from 1e5 samples.
        """
        if not 0.0 < q < 1.0:
            raise UsageError(f"a quantile lies between 0 and 1, got {q}")
        if self._constant is not None:
            return self._constant
        if type(self.dist).__name__ == "Normal":
            return max(0.0, NormalDist(float(self.dist.loc), float(self.dist.scale)).inv_cdf(q))
        samples = self.sample(np.random.default_rng(0), (100_000,))
        return float(np.quantile(samples, q))


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

    @classmethod
    def fit(cls, samples: np.ndarray) -> EmpiricalDist:
        """Return the distribution whose blocks are as long as the recorded delays stay correlated.

        The block length is ``1 + 2 * (sum of the autocorrelation over lags 1, 2, ...)``, up to the first lag at which
        it falls below 0.1: independent delays are drawn one by one, and runs of slow steps stay together.
        """
        dist = cls(samples, 1)
        spread = dist.samples - dist.samples.mean()
        power = float(spread @ spread)
        if power < _CONSTANT_S**2 * spread.size:
            return dist
        block = 1.0
        for lag in range(1, min(_MAX_LAG, spread.size // 4)):
            rho = float(spread[:-lag] @ spread[lag:]) / power
            if rho < 0.1:
                break
            block += 2.0 * rho
        return cls(samples, round(block))

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
_INTERPOLATIONS = ("zoh", "linear", "zoh_mean")


@pytree.dataclass
class TrainableDist(Base, DelayDistribution):
    """A delay that may change while the graph runs, between two bounds: ``min + alpha * (max - min)``.

    It is traced by JAX, so it can be identified or randomised without compiling again. Timelines are drawn with the
    smallest delay, and the reader's window is lengthened so that it holds the messages for every delay in the bounds.

    Attributes:
        alpha: Position between the bounds, in [0, 1]; traced.
        min: Smallest delay [s].
        max: Largest delay [s].
        interp: Interpolation in the window: ``zoh``, ``linear``, or ``zoh_mean`` (inputs of a world only); see
            ``apply``.
        burst: Extra messages in the window, for a sender that at times sends faster than its rate.
    """

    alpha: jax.Array
    min: float = pytree.field(pytree_node=False)
    max: float = pytree.field(pytree_node=False)
    interp: str = pytree.field(pytree_node=False, default="zoh")
    burst: int = pytree.field(pytree_node=False, default=0)

    @classmethod
    def create(cls, delay: float, min: float, max: float, interp: str = "zoh", burst: int = 0) -> TrainableDist:
        """Return the distribution at a delay [s] between the bounds ``min`` and ``max`` [s].

        Args:
            burst: Recorded timing usually needs 1 or 2; the other arguments are those of the class.

        Raises:
            UsageError: Unless ``0 <= min < max``, ``min <= delay <= max``, and ``interp`` is a name above.
        """
        if interp not in _INTERPOLATIONS:
            raise UsageError(f"unknown interpolation {interp!r}. Available: {', '.join(_INTERPOLATIONS)}")
        if not 0.0 <= min < max:
            raise UsageError(f"a trainable delay needs 0 <= min < max, got min={min} s and max={max} s")
        if not min <= delay <= max:
            raise UsageError(f"the delay {delay} s lies outside its bounds [{min}, {max}] s")
        alpha = jnp.float32((delay - min) / (max - min))
        return cls(alpha=alpha, min=min, max=max, interp=interp, burst=burst)

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
        """Return the delay [s], for every ``q``: a new connection expects it."""
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
          before it are values at earlier times, with the distances at which their messages arrived. An empty slot has
          the default output, as if it had arrived at time 0.
        - ``zoh_mean``: the mean of the command over the reader's period; a message holds until the next one arrives.

        Floats are interpolated and averaged. Other values, and ``seq``, are those of the message that has arrived at
        that time: an integer may be a flag, a counter, or an encoder's ticks, which start again at 0 after a turn.

        Args:
            inputs: The lengthened window, leaves ``(W, ...)``; its arrival times are those at the smallest delay.
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
            return _mean_over_period(inputs, late, window, period_s)

        # Find the last message that has arrived. Times are whole ticks, and float32 resolves half a tick at these ages:
        # exact ties are recognised.
        width = inputs.seq.shape[0]
        arrived = late > HALF_TICK_S if skip else late > -HALF_TICK_S
        last = jnp.maximum(jnp.sum(arrived) - 1, window - 1)
        if self.interp == "zoh":
            return _part(inputs, last - window + 1, window)

        # Interpolate at the times of the last messages, moved so that the newest lies at the step's start.
        late = jnp.where(inputs.seq < 0, ts_s, late)
        query = late[last] - late[jnp.clip(last - jnp.arange(window - 1, -1, -1), 0, width - 1)]
        return _interpolate(inputs, -late, query, -HALF_TICK_S if skip else HALF_TICK_S)


def _interpolate(inputs: InputState, knots: Array, query: Array, slack: float) -> InputState:
    """Interpolate every leaf at the times ``query``; before the first knot and after the last it is constant.

    Times ``knots (W,)`` and ``query (w,)`` are relative to the reader's start [s]. A message holds from its knot on;
    ``slack`` [s] is added to the queries, so that exact ties are recognised.
    """
    held = jnp.maximum(jnp.sum(knots[None] < query[:, None] + slack, axis=1) - 1, 0)
    above = jnp.clip(held + 1, 1, knots.shape[0] - 1)
    low, high = knots[above - 1], knots[above]
    # In a burst two messages may arrive at the same time: the value of the later one holds.
    span = jnp.where(high > low, high - low, 1.0)
    weight = jnp.where(held >= above, 1.0, jnp.clip((query - low) / span, 0.0, 1.0))

    def between(leaf: Array) -> Array:
        leaf = jnp.asarray(leaf)
        if not _is_float(leaf):
            return leaf[held]
        a, b = (_at_least_float32(leaf[index]) for index in (above - 1, above))
        return (a + (b - a) * _beside(weight, leaf)).astype(leaf.dtype)

    seq, sent, received = (between(leaf) for leaf in (inputs.seq, inputs.ts_sent, inputs.ts_recv))
    return InputState(seq, sent, received, pytree.map(between, inputs.data), inputs.delay_dist)


def _mean_over_period(inputs: InputState, late: Array, window: int, period_s: float) -> InputState:
    """Average the messages over the reader's period, each weighted by its holding time; differentiable in the delay.

    ``seq`` and times are not averaged: they are those of the message that holds when the period begins. The oldest
    message in the window counts as holding from the start of the period.
    """
    # Fraction of the period in which this message or a newer one holds.
    share = jnp.clip(1.0 + late / period_s, 0.0, 1.0)
    held = _part(inputs, jnp.maximum(jnp.sum(late > -HALF_TICK_S) - window, 0), window)

    def mean(leaf: Array, now: jax.Array) -> jax.Array:
        """Return the window ``now (w, ...)``, its last value replaced by the mean over the messages."""
        leaf = jnp.asarray(leaf)
        if not _is_float(leaf):
            return now
        # A sum over the messages, not a dot product, as XLA fuses it with the physics: measured 17 ns per tick against
        # 27 ns (rollout of a motor, window of five messages, two CPU cores).
        wide, shares = _at_least_float32(leaf), _beside(share, leaf)
        total = wide[0]
        for i in range(1, leaf.shape[0]):
            total = total + (wide[i] - wide[i - 1]) * shares[i].astype(wide.dtype)
        total = total.astype(leaf.dtype)
        return total[None] if now.shape[0] == 1 else now.at[-1].set(total)

    return held.replace(data=pytree.map(mean, inputs.data, held.data))


def _part(inputs: InputState, first: Array, window: int) -> InputState:
    """Return ``window`` messages of each leaf ``(W, ...)`` from the message ``first`` on."""
    return jax.tree_util.tree_map(lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, first, window), inputs)


def _beside(numbers: Array, leaf: Array) -> Array:
    """Append axes to ``numbers (W,)`` until they broadcast with the leaf of ``W`` messages."""
    return numbers.reshape(*numbers.shape, *[1] * (leaf.ndim - numbers.ndim))


def _is_float(leaf: Array) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jnp.inexact))


def _at_least_float32(leaf: Array) -> Array:
    """Return a float leaf with at least 32 bits: differences of float16 overflow from 65,504 on."""
    return leaf.astype(jnp.float32) if leaf.dtype.itemsize < 4 else leaf
