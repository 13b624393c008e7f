"""The page of a comparison: verdicts, errors and parameters of several runs, in tables."""

from pathlib import Path

from sim2real.artifacts.comparison import Comparison
from sim2real.view.blocks import Banner, PageSection, TableBlock
from sim2real.view.page import write_page


def comparison_page(comparison: Comparison, path: Path) -> Path:
    """Write the page of a comparison and return its path."""
    different = ", ".join(comparison.different)
    title = f"intervals that do not overlap: {different}" if different else "the intervals of all parameters overlap"
    blocks = [
        TableBlock.of("Verdicts, errors and scores", comparison.figures()),
        TableBlock.of("Parameters: estimate and half-width of the 95 % interval", comparison.rows()),
    ]
    lead = f"{len(comparison.runs)} runs: {', '.join(run.name for run in comparison.runs)}."
    banner = Banner("doubt" if different else "good", title)
    return write_page(path, "comparison", [PageSection("compare", "Comparison", lead, (), blocks, banner)])
