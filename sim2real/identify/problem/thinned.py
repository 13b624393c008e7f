"""Fewer segments to fit, where a Jacobian of all of them takes long: those with most motion."""

import numpy as np

from sim2real.identify.problem.problem import Problem
from sim2real.identify.problem.segments import Span

MOST_OF_FIT = 4e7
"""Steps of single joints in a Jacobian from which a fit takes fewer segments: about 30 s on two cores."""
MOST_OF_SETS = 8e6
"""The same for the first of two descents, for baselines and for sets of terms that are compared: about 4 s."""
BESIDE = 4
"""Joints whose steps take as long as what a step of a model takes beside its joints."""
_FEWEST = 2
"""Fewest segments of a channel that are live."""


def thinned(problem: Problem, parts: np.ndarray, most: float) -> Problem:
    """Return a problem with the segments of each part in which the channels move most, if all would take long.

    Args:
        parts: Shape ``(K, S)``, bool: which fitted segments are in each part, which keeps one at least.
        most: Steps of single joints in a Jacobian.
    """
    model, channels = problem.engine.model, len(problem.channels)
    if model is None:  # a program simulates segments without weight, too
        return problem
    steps = problem.segment_s / float(model.opt.timestep) * (BESIDE + int(model.nv)) * len(problem.table)
    keep = max(int(most / steps), _FEWEST * channels, len(parts))
    if keep >= len(problem.train):
        return problem
    return problem.recut(_liveliest(problem, parts, keep), problem.segment_s)


def of_recordings(problem: Problem) -> np.ndarray:
    """Return which fitted segments are in each recording, ``(K, S)``, bool."""
    recording = problem.recording[problem.train]
    return recording == np.unique(recording)[:, None]


def few_of(problem: Problem) -> Problem:
    """Return a problem with the segments with most motion, of whichever recording, if all would take long."""
    return thinned(problem, np.ones((1, len(problem.train)), bool), MOST_OF_SETS)


def _liveliest(problem: Problem, parts: np.ndarray, keep: int) -> list[Span]:
    """Return the spans of ``keep`` fitted segments, as many of each part."""
    live, (each, more) = np.zeros(len(problem.train), bool), divmod(keep, len(parts))
    for k, touched in enumerate(parts):
        rest = problem.part(problem.train[~touched])
        live |= np.asarray(problem.evaluator.lively(rest, each + (k < more)).weight)[: len(live)] > 0.0
    return [problem.spans[i] for i in problem.train[live]]
