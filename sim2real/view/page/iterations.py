"""The iterations of a run on its page."""

from pathlib import Path

from sim2real.artifacts.run.iterations import Iterations
from sim2real.view.blocks import PageSection, TableBlock, Tile, number


def iterations_sections(run_dir: Path) -> list[PageSection]:
    """Return the section about a run's iterations; empty for a run without iterations."""
    iterations = Iterations.load(run_dir)
    rows = iterations.rows
    if not rows:
        return []
    block = TableBlock.of("Stages, success and verdict of each iteration", iterations.table())
    best = [r.real for r in rows if r.real is not None]
    tiles = [Tile("iterations", str(len(rows)), rows[-1].verdict)]
    if best:
        tiles.append(Tile("success of the last", number(best[-1]), f"of the first {number(best[0])}"))
    lead = "The log of each deployment decides which stages run again."
    return [PageSection("iterations", "Iterations", lead, tiles, [block])]
