"""Model and sizes that both robots of the bench of graphs share."""

from __future__ import annotations

import jax

from sim2real.stages.pipeline.pipeline import load_pipeline

MODEL = load_pipeline("pendulum").load("model")
EPISODES = 32


def unroll_of(ticks: int) -> int:
    """Return how many ticks a pass of a yardstick's loop holds: as many as the graph's, of two rows on a GPU."""
    return ticks if jax.default_backend() == "cpu" else 2 * ticks
