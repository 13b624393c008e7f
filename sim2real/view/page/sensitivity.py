"""The sensitivity of a policy to wrong parameters, as a figure and a table."""

from pathlib import Path

from matplotlib.lines import Line2D

from sim2real.artifacts.sensitivity import BROKEN, SENSITIVITY, Sensitivity
from sim2real.view import style
from sim2real.view.blocks import Block, FigureBlock, NoteBlock, TableBlock
from sim2real.view.style import CYCLE, DASHES, GRID, INK, MARKERS, MUTED, new_figure, styled, to_svg

_MAX_CURVES = 8
"""Maximum number of curves; the table has all parameters."""


def sensitivity_blocks(folder: Path) -> list[Block]:
    """Return the sensitivity of a train stage; empty if it was not simulated."""
    if not (folder / SENSITIVITY).is_file():
        return []
    sensitivity = Sensitivity.load(folder)
    if not sensitivity.parameters:
        return []
    return [
        NoteBlock(sensitivity.advice),
        FigureBlock(
            sensitivity_figure(sensitivity, "train-sensitivity"),
            "Success on models with one changed parameter, over the change in half-widths of its 95 % interval. The "
            f"other parameters follow by their covariance. All models play the same {sensitivity.episodes} episodes.",
        ),
        TableBlock.of("Success with one changed parameter, the most harmful first", sensitivity.rows()),
    ]


def sensitivity_figure(sensitivity: Sensitivity, name: str) -> str:
    """Draw success over the multiples, a line for each of the worst parameters."""
    shown = sensitivity.parameters[:_MAX_CURVES]
    # The estimate has a place of its own between the negative and positive changes.
    below = int((sensitivity.multiples < 0).sum())
    places = [i if i < below else i + 1 for i in range(len(sensitivity.multiples))]
    with styled():
        figure = new_figure(3.0)
        axes = figure.subplots()
        axes.axhline(BROKEN * sensitivity.success, color=MUTED, lw=1.0, ls=DASHES[1])
        entries = []
        # Draw a curve for each of the most harmful parameters.
        for i, p in enumerate(shown):
            success = [*p.success[:below], sensitivity.success, *p.success[below:]]
            look = {"color": CYCLE[i % len(CYCLE)], "marker": MARKERS[i % len(MARKERS)], "ls": DASHES[i // len(CYCLE)]}
            axes.plot(range(len(success)), success, ms=4.0, **look)
            entries.append(Line2D([], [], label=p.name, ms=4.0, **look))
        axes.axvline(below, color=GRID, lw=1.0, zorder=0)
        axes.plot(below, sensitivity.success, color=INK, marker="o", ms=5.0)
        entries.append(
            Line2D([], [], color=MUTED, lw=1.0, ls=DASHES[1], label=f"{BROKEN:.0%} of the success at the estimate")
        )
        axes.set_xticks([*places, below], [*(f"{m:+g}" for m in sensitivity.multiples), "estimate"])
        axes.set(ylim=(-0.03, 1.05), ylabel="success", xlabel="change [half-widths of the 95 % interval]")
        style.legend_above(figure, entries)
        return to_svg(figure, name, "Success over the change of each parameter: " + ", ".join(p.name for p in shown))
