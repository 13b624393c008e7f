"""Which parameter breaks a policy, as a figure and a table."""

from __future__ import annotations

from pathlib import Path

from matplotlib.lines import Line2D

from sim2real.artifacts.sensitivity import BROKEN, SENSITIVITY, Sensitivity
from sim2real.view import style
from sim2real.view.blocks import MISSING, Block, FigureBlock, NoteBlock, TableBlock, number, pretty_unit
from sim2real.view.style import CYCLE, DASHES, GRID, INK, MARKERS, MUTED, new_figure, styled, to_svg

_SHOWN = 8
"""Parameters that are drawn; the table has all."""


def sensitivity_blocks(folder: Path) -> list[Block]:
    """Return what a train stage found out about wrong parameters; nothing where it did not look."""
    if not (folder / SENSITIVITY).is_file():
        return []
    found = Sensitivity.load(folder)
    if not found.parameters:
        return []
    rows = []
    for p in found.parameters:
        at = found.breaks_at(p)
        rows.append(
            [p.name, pretty_unit(p.unit), number(p.estimate), number(p.half_width, 2)]
            + [MISSING if at is None else f"{at:+g}".replace("-", "\u2212")]
            + [f"{s:.2f}" for s in p.success]
        )
    heads = [f"{m:+g}".replace("-", "\u2212") for m in found.multiples]
    columns = ("parameter", "unit", "estimate", "half-width", "breaks at", *heads)
    return [
        NoteBlock(found.said),
        FigureBlock(
            sensitivity_figure(found, "train-sensitivity"),
            "Success on models with one parameter moved, by multiples of half the width of its 95 % interval. The "
            f"others follow as the recording ties them together. All models play the same {found.episodes} episodes.",
        ),
        TableBlock("Success with one parameter moved, the worst first", columns, rows, text_columns=(1,)),
    ]


def sensitivity_figure(found: Sensitivity, name: str) -> str:
    """Draw success over the multiples, a line for each of the worst parameters."""
    shown = found.parameters[:_SHOWN]
    before = int((found.multiples < 0).sum())
    at = [i if i < before else i + 1 for i in range(len(found.multiples))]
    with styled():
        figure = new_figure(3.0)
        axes = figure.subplots()
        axes.axhline(BROKEN * found.success, color=MUTED, lw=1.0, ls=DASHES[1])
        entries = []
        for i, p in enumerate(shown):
            success = [*p.success[:before], found.success, *p.success[before:]]
            look = {"color": CYCLE[i % len(CYCLE)], "marker": MARKERS[i % len(MARKERS)], "ls": DASHES[i // len(CYCLE)]}
            axes.plot(range(len(success)), success, ms=4.0, **look)
            entries.append(Line2D([], [], label=p.name, ms=4.0, **look))
        axes.axvline(before, color=GRID, lw=1.0, zorder=0)
        axes.plot(before, found.success, color=INK, marker="o", ms=5.0)
        entries.append(Line2D([], [], color=MUTED, lw=1.0, ls=DASHES[1], label=f"{BROKEN:.0%} of the success as it is"))
        axes.set_xticks([*at, before], [*(f"{m:+g}" for m in found.multiples), "estimate"])
        axes.set(ylim=(-0.03, 1.05), ylabel="success", xlabel="moved by [half-widths of its 95 % interval]")
        style.legend_above(figure, entries)
        return to_svg(figure, name, "Success over how far each parameter is moved: " + ", ".join(p.name for p in shown))
