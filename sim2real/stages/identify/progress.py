"""The best values of a running fit, and the file that keeps them.

``partial.json`` has the fitted values until the verdict; it stays if a signal or an error ends the stage before.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sim2real.artifacts.identification import Identification, Judgement
from sim2real.artifacts.paths import shown
from sim2real.artifacts.run import OpenStage
from sim2real.identification.fit import as_numbers
from sim2real.identification.parameters import ParameterTable
from sim2real.identification.verdict import estimates
from sim2real.stages.identify.inputs import Inputs
from sim2real.stages.terminal.console import note

PARTIAL = "partial.json"


@dataclass
class Best:
    """The best values of a fit so far.

    Attributes:
        folder: Folder of the stage, into which the values are written; None: they are not written.
        inputs: The data of the identification.
        again: The command that continues from ``partial.json``.
        table: The parameters of the search.
        z: Shape ``(P,)``; None before the first evaluation.
        done: Phase -> completed share.
        ended: Whether the stage has ended; a thread that still computes records nothing.
    """

    folder: Path | None = None
    inputs: Inputs | None = None
    again: str = ""
    table: ParameterTable = field(default_factory=lambda: ParameterTable([]))
    z: np.ndarray | None = None
    loss: float = np.inf
    done: dict[str, float] = field(default_factory=dict)
    ended: bool = False

    def __post_init__(self) -> None:
        self.restart(self.table)

    def restart(self, table: ParameterTable) -> None:
        """Begin a search of other parameters."""
        self.table, self.z, self.loss, self.done = table, None, np.inf, {"search": 0.0, "refine": 0.0}

    def advance(self, stage: str, share: float, loss: float, z: np.ndarray) -> None:
        """Record progress; the first result of a refinement replaces the search's result, even if its loss is larger.

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

    def fitted(self, z: np.ndarray, loss: float) -> None:
        """Record the finished fit, and write it before the judgement, which takes longer.

        Args:
            z: Shape ``(P,)``: the estimate.
        """
        self.z, self.loss, self.done = np.array(z), loss, {"search": 1.0, "refine": 1.0}
        self.write()

    def write(self) -> None:
        """Write the best values as an identification with the verdict ``not finished``, without intervals."""
        if self.folder is None or self.inputs is None or self.z is None:
            return
        done = ", ".join(f"{share:.0%} of {what}" for what, share in self.done.items())
        reason = f"it ended after {done}: these values have no intervals and were not judged on held-out parts"
        Identification(
            pipeline=self.inputs.loaded.name,
            logs=self.inputs.sources(self.folder.parent),
            verdict=Judgement("not finished", (reason,), self.again),
            parameters=estimates(self.table, as_numbers(self.table, self.z)),
        ).write(self.folder / PARTIAL)


@contextmanager
def kept(stage: OpenStage, inputs: Inputs, again: str) -> Iterator[Best]:
    """Yield the record of the best values, with its file in the stage's folder.

    ``partial.json`` becomes an output of the stage if a signal ends the stage, or an error after the fit; the verdict
    removes it.

    Args:
        again: The command that continues from ``partial.json``.
    """
    best, path = Best(stage.folder, inputs, again), stage.folder / PARTIAL
    try:
        yield best
    except BaseException as error:
        best.ended = True
        signalled = isinstance(error, KeyboardInterrupt | SystemExit)
        if best.z is not None and np.isfinite(best.loss) and (signalled or path.exists()):
            best.write()
            stage.output("partial", PARTIAL)
            ended = "interrupted: the best values so far" if signalled else "the judgement failed: the fitted values"
            note(f"{ended} are in {shown(path)}, without intervals and verdict")
            note(f"next: {again}")
        raise
    best.ended = True
    path.unlink(missing_ok=True)
