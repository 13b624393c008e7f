"""The posterior, from which training draws: estimate, covariance, and other models that fit the recordings."""

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
"""Scales of the search; on its scale, the uncertainty of a parameter is Normal."""


def from_scale(transform: str, x: Any, numpy: ModuleType = np) -> Any:
    """Return the values of points on a scale.

    Args:
        numpy: ``numpy``, or ``jax.numpy`` inside a program.
    """
    return TRANSFORMS[transform][1](x, numpy)


@dataclass(frozen=True)
class Alternative:
    """Another model that fits the recordings as well as the estimate.

    Attributes:
        weight: Share of the draws that come from this model, in [0, 1].
        posterior: Parameters of the model; has no alternatives.
    """

    about: str
    weight: float
    posterior: Posterior

    def __post_init__(self) -> None:
        """Check the share, which can come from a file."""
        check(
            0.0 <= self.weight <= 1.0 and not self.posterior.others, f"{self.about!r} is no single model with a share"
        )


@dataclass(frozen=True)
class Posterior:
    """A Normal distribution on the parameters' scales, folded back at their bounds; with alternatives, a mixture.

    Attributes:
        names: Names of P parameters; ``NAME@recording`` if each recording has a value of its own.
        transform: Scale of each parameter.
        mean: Shape ``(P,)``, on the scales.
        covariance: Shape ``(P, P)``, on the scales.
        low: Shape ``(P,)``: lower bounds on the scales.
        without: Parameter of an alternative that this model lacks -> the value that it stands for here.
        others: The alternatives; this model gets the rest of the draws.

    Raises:
        ValueError: When the sizes differ, an entry is no number, or an alternative has other parameters.
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
        """Check the distribution, which can come from a file."""
        size = len(self.names)
        shapes = {a.shape for a in (self.mean, self.low, self.high)}
        fits = shapes == {(size,)} and self.covariance.shape == (size, size) and len(self.transform) == size
        check(fits, "the posterior has mixed sizes")
        finite = all(np.isfinite(a).all() for a in (self.mean, self.covariance, self.low, self.high))
        check(finite, "an entry of the posterior is no number")
        check(sum(o.weight for o in self.others) < 1.0 + 1e-9, "shares of alternatives beyond all draws")
        parameter_sets = {frozenset((*p.names, *p.without)) for p in (self, *(o.posterior for o in self.others))}
        check(len(parameter_sets) == 1, "alternatives are of other parameters")

    def sample(self, rng: np.random.Generator, count: int, widen: float = 1.0) -> dict[str, np.ndarray]:
        """Draw parameter sets from this model and its alternatives by their shares: name -> ``(count,)``.

        Args:
            widen: Factor on the standard deviations.
        """
        if not self.others:
            return {**self._draw(rng, count, widen), **{n: np.full(count, v) for n, v in self.without.items()}}
        parts = [replace(self, others=()), *(o.posterior for o in self.others)]
        shares = np.array([1.0 - sum(o.weight for o in self.others), *(o.weight for o in self.others)])
        which = rng.choice(len(parts), size=count, p=np.maximum(shares, 0.0) / np.maximum(shares, 0.0).sum())
        drawn = [part.sample(rng, count, widen) for part in parts]
        return {n: np.stack([draws[n] for draws in drawn])[which, np.arange(count)] for n in drawn[0]}

    def _draw(self, rng: np.random.Generator, count: int, widen: float) -> dict[str, np.ndarray]:
        values, axes = np.linalg.eigh(self.covariance)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        x = self.mean + widen * rng.standard_normal((count, len(self.mean))) @ root.T
        # Fold draws back at the bounds: clipping would put many draws exactly on a bound.
        folds = np.abs((x - self.low) / (self.high - self.low) % 2.0 - 1.0)
        x = np.where((x < self.low) | (x > self.high), self.high - folds * (self.high - self.low), x)
        return {n: from_scale(t, x[:, i]) for i, (n, t) in enumerate(zip(self.names, self.transform, strict=True))}
