"""Fewer segments for fits that are compared with each other, where a Jacobian of all of them takes long."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span
from sim2real.identify.validation.folds import Fold, masks

MOST_STEPS = 8e6
"""Steps of single joints in a Jacobian from which fewer segments are taken: about 4 s on two cores."""
BESIDE = 4
"""Joints whose steps take as long as what a step of a model takes beside its joints."""
_FEWEST = 2
"""Fewest segments of a channel that are live."""


def thinned(problem: Problem, parts: Sequence[Fold]) -> Problem:
    """Return a problem with the segments of each part in which the channels move most, if all would take long.

    Args:
        parts: Held out one at a time; each keeps a segment at least.
    """
    model, channels = problem.engine.model, len(problem.channels)
    if model is None:  # a program simulates segments without weight, too
        return problem
    steps = problem.segment_s / float(model.opt.timestep) * (BESIDE + int(model.nv)) * len(problem.table)
    keep = max(int(MOST_STEPS / steps), _FEWEST * channels, len(parts))
    if keep >= len(problem.train):
        return problem
    return problem.recut(_liveliest(problem, parts, keep), problem.segment_s)


def _liveliest(problem: Problem, parts: Sequence[Fold], keep: int) -> list[Span]:
    """Return the spans of about ``keep`` fitted segments, as many of each part."""
    live = np.zeros(len(problem.train), bool)
    for touched in masks(problem, parts):
        rest = problem.part(problem.train[~touched])
        live |= np.asarray(problem.evaluator.lively(rest, -(-keep // len(parts))).weight)[: len(live)] > 0.0
    return [problem.spans[i] for i in problem.train[live]]
