"""Figures of the estimates: intervals within the bounds, and the agreement of recordings."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from sim2real.artifacts.identification import Estimate, Quantity
from sim2real.view import style
from sim2real.view.blocks import pretty_unit
from sim2real.view.style import BLUE, GREEN, GRID, INK, MUTED, ORANGE, SHADE, new_figure, styled, to_svg

_FAR = 6.0
"""Standard errors beyond which a mark is drawn as an arrow at the edge."""
_KINDS = ("relative to nominal", "position between the bounds [%]", "time [ms]")
_MAX_QUANTITIES = 12


def intervals(estimates: Sequence[Estimate], name: str) -> str:
    """Draw each estimate within its bounds, and the distance of truth and nominal value in standard errors."""
    groups = [(kind, g) for kind in _KINDS if (g := [e for e in estimates if _kind(e) == kind])]
    with styled():
        figure = new_figure(0.9 + 0.36 * len(estimates) + 0.4 * len(groups))
        grid = figure.subplots(
            len(groups), 2, squeeze=False, width_ratios=[2.1, 1], height_ratios=[len(g) + 0.6 for _, g in groups]
        )
        # Draw each group of parameters on an axis of its kind.
        for (kind, group), (left, right) in zip(groups, grid, strict=True):
            _inside_bounds(left, group, kind)
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


def aggregate(quantities: Sequence[Quantity], name: str) -> str:
    """Draw each recording's estimate with its 95 % interval, their mean, and the interval for a further recording."""
    shown = quantities[:_MAX_QUANTITIES]
    columns = min(3, len(shown))
    rows = -(-len(shown) // columns)
    with styled():
        figure = new_figure(0.6 + 1.9 * rows, style.WIDTH_IN * columns / 3)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes in grid.ravel()[len(shown) :]:
            axes.set_visible(False)
        # Draw a panel for each quantity.
        for quantity, axes in zip(shown, grid.ravel(), strict=False):
            _recordings(axes, quantity)
        entries = [
            Line2D([], [], color=BLUE, marker="o", ms=4.5, lw=1.6, label="one recording, 95 %"),
            Line2D([], [], color=INK, lw=1.4, label="mean"),
            Patch(facecolor=SHADE, edgecolor=GRID, label="95 % for a further recording"),
        ]
        style.legend_above(figure, entries)
        names = ", ".join(q.name for q in shown)
        return to_svg(figure, name, f"Estimates of {names} from each recording, their mean and spread")


def _recordings(axes: Axes, quantity: Quantity) -> None:
    scale, unit = (1e3, "ms") if quantity.unit == "s" else (1.0, pretty_unit(quantity.unit))
    at = np.arange(len(quantity.estimates))
    values, reach = scale * quantity.estimates, 1.96 * scale * quantity.standard_errors
    low, high = scale * quantity.low95, scale * quantity.high95
    axes.axhspan(low, high, color=SHADE, lw=0, zorder=0)
    axes.axhline(scale * quantity.mean, color=INK, lw=1.4, zorder=1)
    axes.errorbar(at, values, yerr=reach, color=BLUE, fmt="o", ms=4.5, lw=1.6, zorder=3)
    # Fit the axis to the estimates, as the interval for a further recording can be very wide.
    bottom, top = float((values - reach).min()), float((values + reach).max())
    room = 0.6 * (top - bottom) or 1.0
    axes.set_ylim(max(bottom - room, min(low, bottom) - 0.1 * room), min(top + room, max(high, top) + 0.1 * room))
    axes.set_title(quantity.name + ("" if quantity.agree else ": disagree"))
    axes.set_ylabel("" if unit == "1" else unit)
    axes.set_xticks(at if len(at) <= 12 else at[:: -(-len(at) // 12)])
    axes.set_xlim(-0.6, len(at) - 0.4)
    axes.grid(False, axis="x")
    axes.set_xlabel("recording")


def _kind(e: Estimate) -> str:
    if e.unit == "s":
        return _KINDS[2]
    values = [v for v in (e.nominal, e.estimate, e.lower, e.truth) if v is not None]
    if e.nominal is None or e.lower is None or min(values) > 0:
        return _KINDS[0]
    return _KINDS[1]


def _inside_bounds(axes: Axes, group: Sequence[Estimate], kind: str) -> None:
    """Draw estimates within their bounds: relative to nominal on a log axis, as a share of the bounds, or in ms."""
    for row, e in enumerate(group):
        at = _placed(e, kind)
        if e.lower is not None and e.upper is not None:
            bounds = [at(e.lower), at(e.upper)]
            axes.plot(bounds, [row, row], color=GRID, marker="|", mec=MUTED, ms=8, lw=4, zorder=1)
        if e.low95 is not None and e.high95 is not None:
            axes.plot([at(e.low95), at(e.high95)], [row, row], color=BLUE, lw=3, zorder=3)
        axes.plot(at(e.estimate), row, color=BLUE, marker="o", ms=5.5, zorder=4)
        if e.nominal is not None:
            axes.plot(at(e.nominal), row, color=ORANGE, marker="s", mfc="none", ms=5.5, zorder=5)
        if e.truth is not None:
            axes.plot(at(e.truth), row, color=GREEN, marker="D", ms=4, zorder=6)
    # Use a logarithmic axis for positive values relative to nominal.
    values = [v for e in group for v in (e.lower, e.estimate, e.truth, e.nominal) if v is not None]
    if kind == _KINDS[0] and min(values, default=0.0) > 0:
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        ticks = [t for t in (0.001, 0.01, 0.1, 0.25, 0.5, 0.8, 1, 1.25, 2, 4, 10, 100, 1000) if low <= t <= high]
        if high > 30 * low:
            ticks = [t for t in ticks if t in (0.001, 0.01, 0.1, 1, 10, 100, 1000)]
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.minorticks_off()
    axes.set_xlabel(kind)


def _placed(e: Estimate, kind: str) -> Callable[[float], float]:
    """Return the function from a parameter's value to its place on the group's axis."""
    if kind == _KINDS[2]:
        return lambda v: 1e3 * v
    if kind == _KINDS[0]:
        return lambda v: v / (e.nominal or abs(e.estimate) or 1.0)
    low = e.lower if e.lower is not None else min(e.estimate, 0.0)
    high = e.upper if e.upper is not None else low + 1.0
    return lambda v: 100.0 * (v - low) / ((high - low) or 1.0)


def _in_errors(axes: Axes, group: Sequence[Estimate]) -> None:
    axes.axvspan(-1.96, 1.96, color=SHADE, lw=0, zorder=0)
    axes.axvline(0, color=BLUE, lw=1.3)
    for row, e in enumerate(group):
        if not e.standard_error:
            text = "fixed" if e.verdict == "fixed" else "no standard error"
            axes.text(0.2, row, text, va="center", color=MUTED, fontsize=8)
            continue
        # Mark nominal value and truth; an arrow marks a value beyond the edge.
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
