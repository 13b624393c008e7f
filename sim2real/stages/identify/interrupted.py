"""What a search that is ended by a signal leaves: the best values that it had found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.identification import Estimate, Identification, Judgement, Search
from sim2real.artifacts.run.run_folder import OpenStage, Source
from sim2real.identify.fit import as_numbers
from sim2real.identify.parameters import ParameterTable
from sim2real.stages.terminal.console import note, shown

PARTIAL = "partial.json"


@dataclass
class Best:
    """The best so far.

    Attributes:
        table: The parameters that are searched for.
        z: Shape ``(P,)``: where it is; None before anything was evaluated.
        loss: Its loss.
        done: Shares of search and refinement that are done.
        on_fit: Called when the fit is finished, before it is judged.
    """

    table: ParameterTable | None = None
    z: np.ndarray | None = None
    loss: float = float("inf")
    done: dict[str, float] = field(default_factory=lambda: {"search": 0.0, "refine": 0.0})
    on_fit: Callable[[], object] | None = None

    def restart(self, table: ParameterTable) -> None:
        """Begin another search, of other parameters."""
        self.table, self.z, self.loss, self.done = table, None, float("inf"), {"search": 0.0, "refine": 0.0}

    def advance(self, stage: str, share: float, loss: float, z: np.ndarray) -> None:
        """Take note of progress; the first result of a refinement replaces that of the search, even with a larger loss.

        Args:
            stage: ``search`` or ``refine``.
            share: Share of it that was done since the last call.
            z: Shape ``(P,)``: where it is.
        """
        if loss < self.loss or (stage == "refine" and not self.done["refine"]):
            self.z, self.loss = np.array(z), loss
        self.done[stage] = min(1.0, self.done[stage] + share)

    def fitted(self, z: np.ndarray, loss: float) -> None:
        """Take note of the finished fit; it is written before it is judged, which takes longer than the fit.

        Args:
            z: Shape ``(P,)``: the estimate.
        """
        self.z, self.loss, self.done = np.array(z), loss, {"search": 1.0, "refine": 1.0}
        if self.on_fit:
            self.on_fit()


@contextmanager
def left_behind(stage: OpenStage, pipeline: str, logs: Sequence[Path], again: Callable[[Path], str]) -> Iterator[Best]:
    """Yield a place for the best so far.

    It is written to ``partial.json`` when the fit is finished, and when a signal ends the block; a block that ends by
    itself removes the file.

    Args:
        again: Returns the command that goes on from that file.
    """
    best, path = Best(), stage.folder / PARTIAL

    def write() -> None:
        _unfinished(pipeline, logs, stage.run_dir, best, again(path)).write(path)

    best.on_fit = write
    try:
        yield best
    except (KeyboardInterrupt, SystemExit):
        if best.z is not None and np.isfinite(best.loss):
            stage.output("partial", PARTIAL)
            write()
            note(f"interrupted: the best so far is in {shown(path)}, neither judged nor with intervals")
            note(f"next: {again(path)}")
        raise
    path.unlink(missing_ok=True)


def _unfinished(pipeline: str, logs: Sequence[Path], run_dir: Path, best: Best, again: str) -> Identification:
    """Return the best so far as an identification with the verdict ``interrupted``."""
    table = best.table or ParameterTable([])
    values = as_numbers(table, np.asarray(best.z))
    done = ", ".join(f"{share:.0%} of {what}" for what, share in best.done.items())
    reason = f"it ended after {done}: these values were neither judged on held-out data nor do they have intervals"
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
            verdict="interrupted" if p.free else "fixed",
        )
        for p in table
        for name, value in _each(p.name, values[p.name])
    ]
    return Identification(
        pipeline=pipeline,
        logs=tuple(Source.of(path, run_dir) for path in logs),
        verdict=Judgement("interrupted", (reason,), again),
        parameters=tuple(rows),
        search=Search(loss=best.loss, done=best.done),
    )


def _each(name: str, value: Any) -> list[tuple[str, float]]:
    """Return a parameter's names and values: several where each recording has its own."""
    return [(f"{name}@{i}", v) for i, v in enumerate(value)] if isinstance(value, list) else [(name, value)]
