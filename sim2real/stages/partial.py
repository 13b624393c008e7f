"""What a search that is ended by a signal leaves behind: the best that it had found."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.identify.fit import as_numbers
from sim2real.identify.parameters import ParameterTable
from sim2real.stages.console import note, shown
from sim2real.stages.identified import hashed
from sim2real.stages.runs import OpenStage

PARTIAL = "partial.json"


@dataclass
class Best:
    """The best so far.

    Attributes:
        z: Shape ``(P,)``: where it is; None before anything was evaluated.
        loss: Its loss.
        done: Shares of search and refinement that are done.
    """

    z: np.ndarray | None = None
    loss: float = float("inf")
    done: dict[str, float] = field(default_factory=lambda: {"search": 0.0, "refine": 0.0})

    def advance(self, stage: str, share: float, loss: float, z: np.ndarray) -> None:
        """Take note of what ``fit`` tells; a refinement begins at the search's best, then its loss counts."""
        if loss < self.loss or (stage == "refine" and not self.done["refine"]):
            self.z, self.loss = np.array(z), loss
        self.done[stage] = min(1.0, self.done[stage] + share)


@contextmanager
def left_behind(stage: OpenStage, pipeline: str, logs: Sequence[Path], table: ParameterTable) -> Iterator[Best]:
    """Yield a place for the best so far, which is written to ``partial.json`` if a signal ends the block.

    Args:
        stage: The running stage.
        pipeline: The pipeline's name.
        logs: What is identified from.
        table: The parameters.
    """
    best = Best()
    try:
        yield best
    except (KeyboardInterrupt, SystemExit):
        if best.z is not None and np.isfinite(best.loss):
            path = stage.output("partial", PARTIAL)
            path.write_text(json.dumps(_document(pipeline, logs, stage.run_dir, table, best), indent=1))
            note(f"interrupted: the best so far is in {shown(path)}, neither judged nor with intervals")
        raise


def _document(pipeline: str, logs: Sequence[Path], run_dir: Path, table: ParameterTable, best: Best) -> dict[str, Any]:
    values = as_numbers(table, np.asarray(best.z))
    done = ", ".join(f"{share:.0%} of {what}" for what, share in best.done.items())
    reason = (
        f"ended by a signal after {done}: these values were neither judged on held-out data nor do they have intervals"
    )
    rows = [
        {
            **{"name": p.name, "unit": p.unit, "kind": p.kind, "about": p.about, "nominal": p.nominal},
            **{"estimate": values[p.name], "lower": p.low, "upper": p.high},
            "verdict": "interrupted" if p.free else "fixed",
        }
        for p in table
    ]
    return {
        "format": 2,
        "pipeline": pipeline,
        **hashed(logs, run_dir),
        "verdict": {"status": "interrupted", "reasons": [reason], "next": f"sim2real identify {pipeline}"},
        "parameters": rows,
        "search": {"loss": best.loss, "done": best.done},
    }
