"""The posterior, from which training draws robots: estimate and covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from sim2real.artifacts.files import check

if TYPE_CHECKING:
    from types import ModuleType

Transform = Literal["linear", "log"]
TRANSFORMS = {
    # each scale: value -> scale (numpy); scale -> value (numpy or JAX); d value / d scale as a function of the value
    "linear": (lambda v: v, lambda x, m: x, lambda v: 1.0 + 0.0 * v),
    "log": (np.log, lambda x, m: m.exp(x), lambda v: v),
}
"""Scales of the search; on its scale, a parameter is assumed to be normally distributed."""


def from_scale(transform: str, x: Any, numpy: ModuleType = np) -> Any:
    """Return the values of points on a scale.

    Args:
        numpy: ``numpy``, or ``jax.numpy`` inside a program.
    """
    return TRANSFORMS[transform][1](x, numpy)


@dataclass(frozen=True)
class Posterior:
    """A Normal distribution on the parameters' scales, folded back at their bounds.

    Attributes:
        names: Names of P parameters; ``NAME@recording`` if each recording has its own value.
        transform: Scale of each parameter.
        mean: Shape ``(P,)``, on the scales.
        covariance: Shape ``(P, P)``, on the scales.
        lower: Shape ``(P,)``: lower bounds on the scales.
        widening: Factor on the standard deviations, so that draws cover the errors of the model.

    Raises:
        ValueError: The sizes differ, or an entry is no number.
    """

    names: tuple[str, ...]
    transform: tuple[Transform, ...]
    mean: np.ndarray
    covariance: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    widening: float = 1.0

    def __post_init__(self) -> None:
        """Check the distribution, because it may come from a file."""
        size = len(self.names)
        shapes = {a.shape for a in (self.mean, self.lower, self.upper)}
        fits = shapes == {(size,)} and self.covariance.shape == (size, size) and len(self.transform) == size
        check(fits, "the posterior has mixed sizes")
        finite = all(np.isfinite(a).all() for a in (self.mean, self.covariance, self.lower, self.upper))
        check(finite, "an entry of the posterior is no number")

    def sample(self, rng: np.random.Generator, count: int, widen: float = 1.0) -> dict[str, np.ndarray]:
        """Draw parameter sets: name -> ``(count,)``.

        Args:
            widen: Factor on the standard deviations.
        """
        values, axes = np.linalg.eigh(self.covariance)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        x = self.mean + widen * rng.standard_normal((count, len(self.mean))) @ root.T
        # Fold draws back at the bounds: clipping would put many draws exactly on a bound.
        folds = np.abs((x - self.lower) / (self.upper - self.lower) % 2.0 - 1.0)
        x = np.where((x < self.lower) | (x > self.upper), self.upper - folds * (self.upper - self.lower), x)
        return {n: from_scale(t, x[:, i]) for i, (n, t) in enumerate(zip(self.names, self.transform, strict=True))}
