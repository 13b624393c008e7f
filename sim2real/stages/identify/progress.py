"""The course of a fit: its best values so far, and the files that show and keep them.

``progress.jsonl`` and ``best_fit.npz`` are for a viewer that joins the search. ``partial.json`` has the fitted values
while they are judged; it stays if a signal or an error ends the stage before the verdict.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim2real.artifacts.identification import Estimate, Identification, Judgement, Search
from sim2real.artifacts.progress import write_best_fit, write_progress
from sim2real.artifacts.run import OpenStage
from sim2real.identification.fit import as_numbers
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.predictions import samples
from sim2real.identification.problem import Problem
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.live.viewer import live_view
from sim2real.stages.terminal.console import note, shown

PARTIAL = "partial.json"
_PERIOD_S = 5.0
"""Least time between two best fits: each is a simulation of all segments [s]."""


@dataclass
class Best:
    """The best values of a fit so far.

    Attributes:
        table: The parameters of the search.
        z: Shape ``(P,)``; None before the first evaluation.
        done: Phase -> completed share.
        files: Where they are written; None: nowhere.
        ended: Whether the stage has ended; a thread that still computes records nothing.
    """

    table: ParameterTable | None = None
    z: np.ndarray | None = None
    loss: float = float("inf")
    done: dict[str, float] = field(default_factory=lambda: {"search": 0.0, "refine": 0.0})
    files: FitFiles | None = None
    ended: bool = False

    def restart(self, table: ParameterTable) -> None:
        """Begin a search of other parameters."""
        self.table, self.z, self.loss, self.done = table, None, float("inf"), {"search": 0.0, "refine": 0.0}

    def begin(self, problem: Problem) -> None:
        """Take the problem of the next search."""
        if self.files:
            self.files.begin(problem)

    def advance(self, stage: str, share: float, loss: float, z: np.ndarray) -> None:
        """Record progress; the first result of a refinement replaces that of the search, even with a larger loss.

        Args:
            stage: ``search`` or ``refine``.
            share: Share of the phase that was completed since the last call.
            z: Shape ``(P,)``.

        Raises:
            RuntimeError: The stage has ended; it ends the thread that still computes.
        """
        if self.ended:
            raise RuntimeError("the stage has ended")
        if loss < self.loss or (stage == "refine" and not self.done["refine"]):
            self.z, self.loss = np.array(z), loss
        self.done[stage] = min(1.0, self.done[stage] + share)
        if self.files:
            self.files.show(self)

    def fitted(self, z: np.ndarray, loss: float) -> None:
        """Record the finished fit, which is written before the longer judgement begins.

        Args:
            z: Shape ``(P,)``: the estimate.
        """
        self.z, self.loss, self.done = np.array(z), loss, {"search": 1.0, "refine": 1.0}
        if self.files:
            self.files.keep(self)

    def unfinished(self, inputs: Inputs, run_dir: Path, again: str) -> Identification:
        """Return the best values as an identification with the verdict ``not finished``, without intervals."""
        table = self.table or ParameterTable([])
        values = {name: np.ravel(value) for name, value in as_numbers(table, np.asarray(self.z)).items()}
        done = ", ".join(f"{share:.0%} of {what}" for what, share in self.done.items())
        reason = f"it ended after {done}: these values have no intervals and were not judged on held-out data"
        rows = [
            Estimate(
                name=f"{p.name}@{i}" if p.per_recording else p.name,
                unit=p.unit,
                kind=p.kind,
                about=p.about,
                nominal=p.nominal,
                estimate=float(value),
                lower=p.low,
                upper=p.high,
                verdict="not determined" if p.free else "fixed",
            )
            for p in table
            for i, value in enumerate(values[p.name])
        ]
        return Identification(
            pipeline=inputs.loaded.name,
            logs=inputs.sources(run_dir),
            verdict=Judgement("not finished", (reason,), again),
            parameters=tuple(rows),
            search=Search(loss=self.loss, done=self.done),
        )


class FitFiles:
    """The files of a fit in its stage's folder.

    Args:
        again: Path of ``partial.json`` -> the command that continues from it.
    """

    def __init__(self, stage: OpenStage, inputs: Inputs, again: Callable[[Path], str]) -> None:
        self.path = stage.folder / PARTIAL
        self.again = again(self.path)
        self._stage, self._inputs = stage, inputs
        self._problem: Problem | None = None
        self._loss, self._next_s = np.inf, 0.0

    def begin(self, problem: Problem) -> None:
        """Take the problem of the next search."""
        self._problem, self._loss = problem, np.inf

    def show(self, best: Best) -> None:
        """Write the loss and, beside a viewer, the best fit if it is better than the one before."""
        if best.z is None or not np.isfinite(best.loss):
            return
        write_progress(self._stage.folder, {"loss": best.loss})
        config, problem, now_s = self._inputs.config, self._problem, time.monotonic()
        if config.view is not None and problem is not None and best.loss < self._loss and now_s >= self._next_s:
            values = {"identified": problem.table.decode(best.z)}
            write_best_fit(self._stage.folder, samples(problem, values, config.settle_s))
            self._loss, self._next_s = best.loss, time.monotonic() + _PERIOD_S

    def keep(self, best: Best) -> None:
        """Write the best values."""
        best.unfinished(self._inputs, self._stage.run_dir, self.again).write(self.path)


@contextmanager
def kept(stage: OpenStage, inputs: Inputs, again: Callable[[Path], str]) -> Iterator[Best]:
    """Yield the record of the best values, with its files in the stage's folder, beside a viewer if one is configured.

    ``partial.json`` is an output of the stage if a signal ends it, or an error after the fit. A judgement removes it.
    """
    files = FitFiles(stage, inputs, again)
    best, path = Best(files=files), files.path
    try:
        with live_view(inputs.config.view, stage.folder, f"identify {stage.run_dir.name}", dict):
            yield best
    except BaseException as error:
        best.ended = True
        signalled = isinstance(error, KeyboardInterrupt | SystemExit)
        if best.z is not None and np.isfinite(best.loss) and (signalled or path.exists()):
            stage.output("partial", PARTIAL)
            files.keep(best)
            ended = "interrupted: the best values so far" if signalled else "the judgement failed: the fitted values"
            note(f"{ended} are in {shown(path)}, without intervals and verdict")
            note(f"next: {files.again}")
        raise
    best.ended = True
    path.unlink(missing_ok=True)
