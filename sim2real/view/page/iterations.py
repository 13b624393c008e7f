"""The iterations of a run on its page."""

from __future__ import annotations

from pathlib import Path

from sim2real.artifacts.run.iterations import Iterations
from sim2real.view.blocks import PageSection, TableBlock, Tile, number


def iterations_sections(run_dir: Path) -> list[PageSection]:
    """Return the section about a run's iterations; none where it has not gone around."""
    rows = Iterations.load(run_dir).rows
    if not rows:
        return []
    cells = [
        [str(r.number), ", ".join(r.stages), number(r.real), number(r.simulation), r.verdict, r.why, r.then]
        for r in rows
    ]
    columns = ("iteration", "ran", "success", "in simulation", "verdict", "why", "then")
    block = TableBlock("What each iteration did, and what it found", columns, cells, text_columns=(1, 4, 5, 6))
    best = [r.real for r in rows if r.real is not None]
    tiles = [Tile("iterations", str(len(rows)), rows[-1].verdict)]
    if best:
        tiles.append(Tile("success of the last", number(best[-1]), f"of the first {number(best[0])}"))
    lead = "The deployment's own log says what is done again."
    return [PageSection("iterations", "Iterations", lead, tiles, [block])]
