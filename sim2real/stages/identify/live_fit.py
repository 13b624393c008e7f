"""Progress of a search for a viewer that joins it: the loss, and the best fit so far over the recording."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from sim2real.artifacts.progress import write_best_fit, write_progress
from sim2real.artifacts.run.run_folder import OpenStage
from sim2real.identify.problem.problem import Problem
from sim2real.identify.validation.prediction import samples
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.identify.interrupted import Best, left_behind
from sim2real.stages.live.viewer import live_view

_PERIOD_S = 5.0
"""Least time between two best fits: each is a simulation of all segments [s]."""


@contextmanager
def searching(stage: OpenStage, inputs: Inputs, again: Callable[[Path], str]) -> Iterator[Best]:
    """Yield the record of the best values, and write the progress, beside a viewer if one is configured.

    Args:
        again: See ``left_behind``.
    """
    config = inputs.config
    live = LiveFit(stage.folder, config.view is not None, config.settle_s)
    view = live_view(config.view, stage.folder, f"identify {stage.run_dir.name}", dict)
    with left_behind(stage, inputs.pipeline.name, inputs.sources(stage.run_dir), again) as best, view:
        best.on_begin, best.on_advance = live.begin, live.advance
        yield best


class LiveFit:
    """Writes the progress of a search into its stage's folder.

    Args:
        fits: Whether it writes the best fit too, which takes a simulation of all segments each time.
        settle_s: First part of a held-out segment, to which its initial state is fitted [s].
    """

    def __init__(self, folder: Path, fits: bool, settle_s: float) -> None:
        self._folder, self._fits, self._settle_s = folder, fits, settle_s
        self._problem: Problem | None = None
        self._loss, self._next_s = np.inf, 0.0

    def begin(self, problem: Problem) -> None:
        """Take the problem of the next search."""
        self._problem, self._loss = problem, np.inf

    def advance(self, best: Best) -> None:
        """Write the loss, and the best fit if it is better than the one before."""
        if best.z is None or not np.isfinite(best.loss):
            return
        write_progress(self._folder, {"loss": best.loss})
        if self._fits and self._problem is not None and best.loss < self._loss and time.monotonic() >= self._next_s:
            values = self._problem.table.decode(best.z)
            write_best_fit(self._folder, samples(self._problem, {"identified": values}, self._settle_s))
            self._loss, self._next_s = best.loss, time.monotonic() + _PERIOD_S
