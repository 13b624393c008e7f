"""The initial state and the commands of each held-out segment, for a comparison with another simulator."""

from collections.abc import Mapping

import jax
import numpy as np
from numpy.typing import ArrayLike

from sim2real.graph.node import TICKS_PER_S
from sim2real.identify.problem.problem import Problem


def replays(problem: Problem, values: Mapping[str, ArrayLike], settle_s: float, kind: str) -> dict[str, np.ndarray]:
    """Return columns of the R held-out segments, named ``KIND/...``; empty if several nodes drive the model.

    Args:
        values: Values of all parameters.
        settle_s: Length of the first part of a segment, to which its initial state is fitted [s].

    Returns:
        ``segment``, ``recording``, ``begin_s``: ``(R,)``. ``start (R, 2 * channels)``: positions, then velocities.
        ``sent_s (R, K)``: when each command was sent [s from the segment's start], NaN after the last one.
        ``command/FIELD (R, K, ...)``.
    """
    if len(problem.messages) != 1:
        return {}
    held_out = np.flatnonzero(~np.isin(np.arange(problem.segments), problem.train))
    rows = {n: np.broadcast_to(v, (len(held_out), *np.shape(v))) for n, v in values.items()}
    starts = problem.simulated(rows, held_out, np.full(len(held_out), settle_s))[1]
    ((node, messages),) = problem.messages.items()
    steps = problem.timeline.vertices[node]
    sent = np.where(np.arange(steps.end.shape[1]) < steps.count[:, None], steps.end / TICKS_PER_S, np.nan)
    columns = {
        "segment": held_out,
        "recording": problem.recording[held_out],
        "begin_s": problem.begins_s[held_out],
        "start": starts,
        "sent_s": sent[held_out],
    }
    names = jax.tree_util.tree_leaves(problem.model.given[node])
    for name, field in zip(names, jax.tree_util.tree_leaves(messages), strict=True):
        columns[f"command/{name}"] = np.asarray(field)[held_out]
    return {f"{kind}/{name}": column for name, column in columns.items()}
