"""The estimate with its covariance, saved so that training can draw robots from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.identify.parameters import ParameterTable, Transform, from_scale

_FORMAT = 1


@dataclass(frozen=True)
class Posterior:
    """A Normal distribution on the parameters' scales, cut off at their bounds.

    Attributes:
        names: P of them, with ``@recording`` where each recording has its own.
        transform: How each scale makes a value: linear, log or logit.
        mean: Shape ``(P,)``, on the scales.
        covariance: Shape ``(P, P)``, on the scales.
        low: Shape ``(P,)``: bounds on the scales.
        high: Shape ``(P,)``.
    """

    names: tuple[str, ...]
    transform: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def of(table: ParameterTable, z: np.ndarray, covariance: np.ndarray) -> Posterior:
        """Return the posterior at ``z (P,)`` with a covariance on the parameters' scales."""
        transform = tuple(c.parameter.transform for c in table.columns)
        return Posterior(table.names, transform, table.scale(z)[0], covariance, table.low, table.high)

    def sample(self, rng: np.random.Generator, count: int, widen: float = 1.0) -> dict[str, np.ndarray]:
        """Draw parameter sets: name -> ``(count,)``.

        Args:
            rng: Random numbers.
            count: How many.
            widen: Factor on the standard deviations.
        """
        values, axes = np.linalg.eigh(self.covariance)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        x = self.mean + widen * rng.standard_normal((count, len(self.mean))) @ root.T
        x = np.clip(x, self.low, self.high)
        return {n: from_scale(t, x[:, i]) for i, (n, t) in enumerate(zip(self.names, self.transform, strict=True))}

    def to_json(self) -> dict[str, Any]:
        """Return the posterior as JSON takes it."""
        return {
            "format": _FORMAT,
            "names": list(self.names),
            "transform": list(self.transform),
            **{n: getattr(self, n).tolist() for n in ("mean", "covariance", "low", "high")},
        }

    @staticmethod
    def from_json(document: Mapping[str, Any]) -> Posterior:
        """Return what ``to_json`` made.

        Raises:
            Sim2RealError: When it is none.
        """
        try:
            arrays = {n: np.asarray(document[n], np.float64) for n in ("mean", "covariance", "low", "high")}
            found = Posterior(tuple(document["names"]), tuple(document["transform"]), **arrays)
        except (KeyError, TypeError, ValueError) as error:
            raise Sim2RealError(f"no posterior: {type(error).__name__}: {error}", hint="identify again") from None
        size = len(found.names)
        shapes = {a.shape for a in (found.mean, found.low, found.high)}
        fits = shapes == {(size,)} and found.covariance.shape == (size, size) and len(found.transform) == size
        if document.get("format") != _FORMAT or not fits or not set(found.transform) <= set(get_args(Transform)):
            raise Sim2RealError("a posterior of another format or of mixed sizes", hint="identify again")
        if not all(np.isfinite(a).all() for a in arrays.values()):
            raise Sim2RealError("a posterior with an entry that is no number", hint="identify again")
        return found
