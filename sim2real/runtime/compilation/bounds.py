"""The bounds of trainable delays as arrays, so that they can be arguments of a compiled program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sim2real.graph.delays import TrainableDist
from sim2real.graph.node import BaseNode
from sim2real.later import jnp

if TYPE_CHECKING:
    from sim2real.graph.base import Number


class Bounds(NamedTuple):
    """The numbers of a ``TrainableDist``, each of shape ``()``.

    Attributes:
        low: Its smallest delay [s].
        span: Its largest delay minus the smallest [s].
        alpha: Its position between the bounds, in [0, 1].
    """

    low: Number
    span: Number
    alpha: Number

    def at(self, dist: TrainableDist, delay: Number | None) -> TrainableDist:
        """Return a distribution at a delay [s], clipped to these bounds; None: at ``alpha``."""
        if delay is None:
            return dist.replace(alpha=jnp.asarray(self.alpha))
        alpha = (jnp.asarray(delay, jnp.float32) - self.low) / self.span
        return dist.replace(alpha=jnp.clip(alpha, 0.0, 1.0))

    def opened(self, dist: TrainableDist) -> TrainableDist:
        """Return a distribution with the same delay and the bounds 0 and 1 s, which are the same in each program."""
        return dist.replace(alpha=self.low + dist.alpha * self.span, min=0.0, max=1.0)


DelayBounds = Mapping[str, Mapping[str, Bounds]]
"""Node -> input -> the bounds of its trainable delay."""


def bounds_of(nodes: Mapping[str, BaseNode]) -> dict[str, dict[str, Bounds]]:
    """Return the bounds of all trainable delays."""
    bounds: dict[str, dict[str, Bounds]] = {}
    for name, node in nodes.items():
        for input_name, connection in node.inputs.items():
            if isinstance(dist := connection.delay_dist, TrainableDist):
                numbers = (np.float32(dist.min), np.float32(dist.max - dist.min), dist.alpha)
                bounds.setdefault(name, {})[input_name] = Bounds(*numbers)
    return bounds
