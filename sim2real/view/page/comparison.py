"""The page of a comparison: parameters of all runs in one figure, then the tables."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from sim2real.artifacts.comparison import ComparedParameter, Comparison
from sim2real.view import style
from sim2real.view.blocks import Banner, Block, FigureBlock, PageSection, TableBlock, pretty_unit
from sim2real.view.page.page import write_page
from sim2real.view.style import BLUE, GREEN, INK, MUTED, ORANGE, new_figure, styled, to_svg

_COLOURS = (BLUE, ORANGE, GREEN, INK, MUTED)
_COLUMNS = 3


def comparison_page(comparison: Comparison, path: Path) -> Path:
    """Write the page of a comparison and return its path."""
    different = ", ".join(comparison.different)
    title = f"intervals that do not overlap: {different}" if different else "the intervals of all parameters overlap"
    banner = Banner("doubt" if different else "good", title)
    blocks: list[Block] = []
    if comparison.parameters:
        caption = "Estimates with 95 % intervals. Those of a parameter with an orange title do not overlap."
        wide, phone = (parameters_figure(comparison, f"comparison-{n}", n) for n in (_COLUMNS, 1))
        blocks.append(FigureBlock(wide, caption, phone=phone))
    blocks.append(TableBlock.of("Verdicts, errors and scores", comparison.figures()))
    blocks.append(TableBlock.of("Parameters: estimate and half-width of the 95 % interval", comparison.rows()))
    names = ", ".join(run.name for run in comparison.runs)
    section = PageSection("compare", "Comparison", f"{len(comparison.runs)} runs: {names}.", (), blocks, banner)
    return write_page(path, "comparison", [section])


def parameters_figure(comparison: Comparison, name: str, columns: int) -> str:
    """Draw a panel for each parameter with the estimate and interval of each run, as SVG."""
    count = len(comparison.parameters)
    columns = min(columns, count)
    rows = -(-count // columns)
    with styled():
        figure = new_figure(0.6 + rows * (0.7 + 0.16 * len(comparison.runs)), style.WIDTH_IN * columns / _COLUMNS)
        grid = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in grid[count:]:
            axes.set_visible(False)
        for parameter, axes in zip(comparison.parameters, grid, strict=False):
            _panel(axes, parameter)
        # The legend has one entry a run: panels are too small for the runs' names.
        marks = [
            Line2D([], [], color=_COLOURS[i % len(_COLOURS)], marker="o", ms=4.5, lw=1.6, label=run.name)
            for i, run in enumerate(comparison.runs)
        ]
        style.legend_above(figure, marks)
        return to_svg(figure, name, f"Estimates of {', '.join(p.name for p in comparison.parameters)} in each run")


def _panel(axes: Axes, parameter: ComparedParameter) -> None:
    """Draw one parameter: a mark and an interval for each run, from the top down."""
    scale, unit = (1e3, "ms") if parameter.unit == "s" else (1.0, pretty_unit(parameter.unit))
    for row, estimate in enumerate(parameter.estimates):
        if estimate is None:
            continue
        colour = _COLOURS[row % len(_COLOURS)]
        if estimate.low95 is not None and estimate.high95 is not None:
            axes.plot([scale * estimate.low95, scale * estimate.high95], [row, row], color=colour, lw=1.6)
        axes.plot(scale * estimate.estimate, row, color=colour, marker="o", ms=4.5)
    axes.set_title(parameter.name, color=ORANGE if parameter.overlap is False else INK)
    axes.set_xlabel("" if unit == "1" else unit)
    axes.set_ylim(len(parameter.estimates) - 0.5, -0.5)
    axes.set_yticks([])
