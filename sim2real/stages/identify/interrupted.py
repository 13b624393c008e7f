"""The best values of a search that did not end with a verdict, as a file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim2real.artifacts.identification import Estimate, Identification, Judgement, Search
from sim2real.artifacts.run.run_folder import OpenStage, Source
from sim2real.identify.fit import Value, as_numbers
from sim2real.identify.parameters import ParameterTable
from sim2real.identify.problem.problem import Problem
from sim2real.stages.terminal.console import note, shown

PARTIAL = "partial.json"


@dataclass
class Best:
    """The best values of a search so far.

    Attributes:
        table: The parameters of the search.
        z: Shape ``(P,)``; None before the first evaluation.
        done: Phase -> completed share.
        on_fit: Called after the fit, before it is judged.
        on_begin: Called with each problem, before its search.
        on_advance: Called after each advance.
        ended: Whether the stage has ended; a thread that still computes records nothing.
    """

    table: ParameterTable | None = None
    z: np.ndarray | None = None
    loss: float = float("inf")
    done: dict[str, float] = field(default_factory=lambda: {"search": 0.0, "refine": 0.0})
    on_fit: Callable[[], object] | None = None
    on_begin: Callable[[Problem], object] | None = None
    on_advance: Callable[[Best], object] | None = None
    ended: bool = False

    def restart(self, table: ParameterTable) -> None:
        """Begin a search of other parameters."""
        self.table, self.z, self.loss, self.done = table, None, float("inf"), {"search": 0.0, "refine": 0.0}

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
        if self.on_advance:
            self.on_advance(self)

    def begin(self, problem: Problem) -> None:
        """Announce the problem of the next search."""
        if self.on_begin:
            self.on_begin(problem)

    def fitted(self, z: np.ndarray, loss: float) -> None:
        """Record the finished fit, which is written before the longer judgement begins.

        Args:
            z: Shape ``(P,)``: the estimate.
        """
        self.z, self.loss, self.done = np.array(z), loss, {"search": 1.0, "refine": 1.0}
        if self.on_fit:
            self.on_fit()


@contextmanager
def left_behind(
    stage: OpenStage, pipeline: str, logs: tuple[Source, ...], again: Callable[[Path], str]
) -> Iterator[Best]:
    """Yield the record of the best values, which is written to ``partial.json`` after the fit and on a signal.

    The file is an output of the stage if a signal ends it, or an error after the fit. A judgement removes it.

    Args:
        logs: The fitted logs, with their hashes from before the fit.
        again: Path of the file -> the command that continues from it.
    """
    best, path = Best(), stage.folder / PARTIAL

    def write() -> None:
        _unfinished(pipeline, logs, best, again(path)).write(path)

    best.on_fit = write
    try:
        yield best
    except BaseException as error:
        best.ended = True
        signalled = isinstance(error, KeyboardInterrupt | SystemExit)
        if best.z is not None and np.isfinite(best.loss) and (signalled or path.exists()):
            stage.output("partial", PARTIAL)
            write()
            ended = "interrupted: the best values so far" if signalled else "the judgement failed: the fitted values"
            note(f"{ended} are in {shown(path)}, without intervals and verdict")
            note(f"next: {again(path)}")
        raise
    best.ended = True
    path.unlink(missing_ok=True)


def _unfinished(pipeline: str, logs: tuple[Source, ...], best: Best, again: str) -> Identification:
    """Return the best values as an identification with the verdict ``not finished``."""
    # The best values so far, without intervals.
    table = best.table or ParameterTable([])
    values = as_numbers(table, np.asarray(best.z))
    done = ", ".join(f"{share:.0%} of {what}" for what, share in best.done.items())
    reason = f"it ended after {done}: these values have no intervals and were not judged on held-out data"
    rows = [
        Estimate(
            name=name,
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
        for name, value in _each(p.name, values[p.name])
    ]
    return Identification(
        pipeline=pipeline,
        logs=logs,
        verdict=Judgement("not finished", (reason,), again),
        parameters=tuple(rows),
        search=Search(loss=best.loss, done=best.done),
    )


def _each(name: str, value: Value) -> list[tuple[str, float]]:
    """Return a parameter's names and values: one for each recording if the value is a list."""
    return [(f"{name}@{i}", v) for i, v in enumerate(value)] if isinstance(value, list) else [(name, value)]
