"""The figure of the identified parameters: where each estimate lies, how sure it is, and where the truth is."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from sim2real.view import style
from sim2real.view.artifacts import Estimate
from sim2real.view.style import BLUE, GREEN, GRID, MUTED, ORANGE, SHADE, new_figure, styled, to_svg

_FAR = 6.0
"""Standard errors beyond which a mark is drawn as an arrow at the edge."""


def intervals(estimates: Sequence[Estimate], name: str) -> str:
    """Draw each parameter inside its bounds, and beside it, in standard errors, where truth and nominal value lie."""
    times = [e for e in estimates if e.unit == "s"]
    others = [e for e in estimates if e.unit != "s"]
    groups = [g for g in (others, times) if g]
    with styled():
        figure = new_figure(0.9 + 0.36 * len(estimates) + 0.4 * len(groups))
        grid = figure.subplots(
            len(groups), 2, squeeze=False, width_ratios=[2.1, 1], height_ratios=[len(g) + 0.6 for g in groups]
        )
        for group, (left, right) in zip(groups, grid, strict=True):
            _inside_bounds(left, group, relative=group is others)
            _in_errors(right, group)
            left.set_yticks(range(len(group)), [e.name for e in group])
            for axes in (left, right):
                axes.set_ylim(len(group) - 0.4, -0.6)
                axes.grid(False, axis="y")
                axes.tick_params(axis="y", length=0)
        grid[-1, 1].set_xlabel("distance from the estimate [standard errors]")
        entries = [
            Line2D([], [], color=BLUE, marker="o", ms=5.5, lw=3, label="estimate, 95 %"),
            Line2D([], [], color=GRID, marker="|", mec=MUTED, ms=8, lw=4, label="bounds"),
            Line2D([], [], color=ORANGE, marker="s", mfc="none", ms=5.5, lw=0, label="nominal"),
        ]
        if any(e.truth is not None for e in estimates):
            entries.append(Line2D([], [], color=GREEN, marker="D", ms=5, lw=0, label="truth"))
        style.legend_above(figure, entries)
        names = ", ".join(e.name for e in estimates)
        return to_svg(figure, name, f"Estimates with 95 percent intervals, bounds and nominal values of {names}")


def _inside_bounds(axes: Axes, group: Sequence[Estimate], relative: bool) -> None:
    """Draw the whole interval that was searched: relative to the nominal value on a log axis, times in ms."""
    for row, e in enumerate(group):
        scale = _scale(e) if relative else 1e-3
        if e.lower is not None and e.upper is not None:
            bounds = [e.lower / scale, e.upper / scale]
            axes.plot(bounds, [row, row], color=GRID, marker="|", mec=MUTED, ms=8, lw=4, zorder=1)
        if e.low95 is not None and e.high95 is not None:
            axes.plot([e.low95 / scale, e.high95 / scale], [row, row], color=BLUE, lw=3, zorder=3)
        axes.plot(e.estimate / scale, row, color=BLUE, marker="o", ms=5.5, zorder=4)
        if e.nominal is not None:
            axes.plot(e.nominal / scale, row, color=ORANGE, marker="s", mfc="none", ms=5.5, zorder=5)
        if e.truth is not None:
            axes.plot(e.truth / scale, row, color=GREEN, marker="D", ms=4, zorder=6)
    if relative and all((v is None or v / _scale(e) > 0) for e in group for v in (e.lower, e.estimate, e.truth)):
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        ticks = [t for t in (0.01, 0.1, 0.25, 0.5, 0.8, 1, 1.25, 2, 4, 10, 100) if low <= t <= high]
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()
    axes.set_xlabel("relative to nominal" if relative else "time [ms]")


def _in_errors(axes: Axes, group: Sequence[Estimate]) -> None:
    axes.axvspan(-1.96, 1.96, color=SHADE, lw=0, zorder=0)
    axes.axvline(0, color=BLUE, lw=1.3)
    for row, e in enumerate(group):
        if not e.standard_error:
            axes.text(0.2, row, "no standard error", va="center", color=MUTED, fontsize=8)
            continue
        for value, color, mark in ((e.nominal, ORANGE, "s"), (e.truth, GREEN, "D")):
            if value is None:
                continue
            distance = (value - e.estimate) / e.standard_error
            if abs(distance) > _FAR:
                mark, distance = (">", _FAR) if distance > 0 else ("<", -_FAR)
            hollow = color == ORANGE
            axes.plot(distance, row, color=color, marker=mark, ms=5, mfc="none" if hollow else color, clip_on=False)
    axes.set_xlim(-_FAR, _FAR)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)


def _scale(e: Estimate) -> float:
    return e.nominal or abs(e.estimate) or 1.0
