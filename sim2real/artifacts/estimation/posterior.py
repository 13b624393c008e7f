"""The estimate with its covariance, and the models that explain the recordings as well: what training draws from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sim2real.artifacts.files import check

if TYPE_CHECKING:
    from types import ModuleType

Transform = Literal["linear", "log", "logit"]
TRANSFORMS = {
    # value -> scale (numpy); scale -> value (numpy or JAX); d value / d scale, as a function of the value
    "linear": (lambda v: v, lambda x, m: x, lambda v: 1.0 + 0.0 * v),
    "log": (np.log, lambda x, m: m.exp(x), lambda v: v),
    "logit": (lambda v: np.log(v / (1.0 - v)), lambda x, m: 1.0 / (1.0 + m.exp(-x)), lambda v: v * (1.0 - v)),
}
"""The scales on which parameters are searched, and on which their uncertainty is Normal."""


def from_scale(transform: str, x: Any, numpy: ModuleType = np) -> Any:
    """Return values for points on a scale.

    Args:
        x: The points, of any shape.
        numpy: ``numpy``, or ``jax.numpy`` inside a program.
    """
    return TRANSFORMS[transform][1](x, numpy)


@dataclass(frozen=True)
class Alternative:
    """Another model that explains the recordings as well as the estimate.

    Attributes:
        about: What it is.
        weight: Share of the draws that are of it, in [0, 1].
        posterior: Its parameters; without alternatives of its own.
    """

    about: str
    weight: float
    posterior: Posterior

    def __post_init__(self) -> None:
        """Check that it is a share, of one distribution: it may come from a file."""
        check(
            0.0 <= self.weight <= 1.0 and not self.posterior.others, f"{self.about!r} is no single model with a share"
        )


@dataclass(frozen=True)
class Posterior:
    """A Normal distribution on the parameters' scales, folded back at their bounds; with alternatives, a mixture.

    Attributes:
        names: P of them, with ``@recording`` where each recording has its own.
        transform: How each scale makes a value.
        mean: Shape ``(P,)``, on the scales.
        covariance: Shape ``(P, P)``, on the scales.
        low: Shape ``(P,)``: bounds on the scales.
        high: Shape ``(P,)``.
        without: Parameter that alternatives have and this model lacks -> what it is without.
        others: The alternatives, with what is left of the draws for this one.

    Raises:
        ValueError: When the sizes differ, an entry is no number, or alternatives leave a parameter open.
    """

    names: tuple[str, ...]
    transform: tuple[Transform, ...]
    mean: np.ndarray
    covariance: np.ndarray
    low: np.ndarray
    high: np.ndarray
    without: Mapping[str, float] = field(default_factory=dict)
    others: tuple[Alternative, ...] = ()

    def __post_init__(self) -> None:
        """Check that it is one distribution: it may come from a file."""
        size = len(self.names)
        shapes = {a.shape for a in (self.mean, self.low, self.high)}
        fits = shapes == {(size,)} and self.covariance.shape == (size, size) and len(self.transform) == size
        check(fits, "the posterior has mixed sizes")
        finite = all(np.isfinite(a).all() for a in (self.mean, self.covariance, self.low, self.high))
        check(finite, "an entry of the posterior is no number")
        check(sum(o.weight for o in self.others) < 1.0 + 1e-9, "shares of alternatives beyond all draws")
        known = {frozenset((*p.names, *p.without)) for p in (self, *(o.posterior for o in self.others))}
        check(len(known) == 1, "alternatives are of other parameters")

    def sample(self, rng: np.random.Generator, count: int, widen: float = 1.0) -> dict[str, np.ndarray]:
        """Draw parameter sets, of all alternatives by their shares: name -> ``(count,)``.

        Args:
            widen: Factor on the standard deviations.
        """
        if not self.others:
            return {**self._own(rng, count, widen), **{n: np.full(count, v) for n, v in self.without.items()}}
        parts = [replace(self, others=()), *(o.posterior for o in self.others)]
        shares = np.array([1.0 - sum(o.weight for o in self.others), *(o.weight for o in self.others)])
        which = rng.choice(len(parts), size=count, p=np.maximum(shares, 0.0) / np.maximum(shares, 0.0).sum())
        drawn = [part.sample(rng, count, widen) for part in parts]
        return {n: np.stack([own[n] for own in drawn])[which, np.arange(count)] for n in drawn[0]}

    def _own(self, rng: np.random.Generator, count: int, widen: float) -> dict[str, np.ndarray]:
        values, axes = np.linalg.eigh(self.covariance)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        x = self.mean + widen * rng.standard_normal((count, len(self.mean))) @ root.T
        # Folded back at the bounds, not clipped: clipped ones would heap up there.
        turns = np.abs((x - self.low) / (self.high - self.low) % 2.0 - 1.0)
        x = np.where((x < self.low) | (x > self.high), self.high - turns * (self.high - self.low), x)
        return {n: from_scale(t, x[:, i]) for i, (n, t) in enumerate(zip(self.names, self.transform, strict=True))}
