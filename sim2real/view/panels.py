"""Figures with panels over a common time axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sim2real.log.schema import unit_of
from sim2real.view import style
from sim2real.view.style import GRID, MUTED, ROLES, SHADE, new_figure, new_grid, styled, to_svg


@dataclass(frozen=True)
class Line:
    """One line of a panel, with the appearance of its ``role``, a name in ``style.ROLES``."""

    t_s: np.ndarray
    values: np.ndarray
    label: str
    role: str
    held: bool = False
    """Whether each value holds until the next one, as for a command; drawn as steps."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes over time.

    Attributes:
        label: Label of the vertical axis.
        title: Title; empty for none.
        spans: Shaded intervals [s].
        zoom: Enlarged interval in a second column [s]; None for no second column.
        framed: Roles of the lines that determine the vertical range; empty for all lines.
        difference: Line in the second column instead of an enlarged interval; None for none.
    """

    label: str
    lines: Sequence[Line]
    title: str = ""
    spans: Sequence[tuple[float, float]] = ()
    zoom: tuple[float, float] | None = None
    framed: Sequence[str] = ()
    difference: Line | None = None


def over_time(panels: Sequence[Panel], name: str, label: str, shade: str = "held out") -> str:
    """Draw panels one above the other; panels over the same time share an axis. Returns SVG.

    Args:
        label: Description of the figure, for screen readers.
    """
    # Panels share a time axis unless they have titles or zooms.
    zooms = {panel.zoom for panel in panels}
    beside = [panel.difference for panel in panels if panel.difference is not None]
    closer = zooms != {None} or bool(beside)
    titled = any(panel.title for panel in panels)
    with styled():
        alone = len(zooms) > 1 or titled
        figure, grid = new_grid(
            len(panels),
            1 + closer,
            row_in=1.3,
            gap_in=0.25 + 0.25 * alone,
            beside_in=0.7,
            sharex="none" if alone else "col",
            sharey="none" if beside else "row",
            width_ratios=[2.1, 1][: 1 + closer],
        )
        # Draw each panel, with its enlarged part on the right.
        for panel, row in zip(panels, grid, strict=True):
            for axes in row[: 1 if beside else 2]:
                _fill(axes, panel)
            if panel.difference is not None:
                _fill(row[1], Panel("", [panel.difference], spans=panel.spans))
            elif beside:
                row[1].set_visible(False)
            row[0].set_ylabel(panel.label)
            if panel.title:
                row[0].set_title(panel.title, fontweight="normal", fontsize=8.5)
            if panel.zoom:
                row[1].set_xlim(*panel.zoom)
                row[1].xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        zoom = panels[0].zoom
        if zoom and len(zooms) == 1:
            grid[0, 1].set_title(f"{zoom[0]:g} to {zoom[1]:g} s", fontweight="normal", color=MUTED)
        if beside:
            grid[0, 1].set_title(beside[0].label, fontweight="normal", color=MUTED)
        # Add one legend with each label once.
        by_label = {line.label: line for panel in panels for line in panel.lines}
        entries: list[Artist] = [_legend_entry(line) for line in by_label.values()]
        entries += [Patch(facecolor=SHADE, edgecolor=GRID, label=shade)] if any(p.spans for p in panels) else []
        style.legend_above(figure, entries)
        return to_svg(figure, name, label)


def compared(lines: Sequence[Line], difference: Line, label: str, span: tuple[float, float], name: str) -> str:
    """Draw lines over time, and below them a difference, in a figure for a telephone. Returns SVG.

    Args:
        label: Label of the upper vertical axis; the difference labels the lower one.
        span: Shaded interval [s].
    """
    with styled():
        figure = new_figure(3.6, style.PHONE_IN)
        upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[1.7, 1])
        framed = [role for role in ("measured", "identified") if any(line.role == role for line in lines)]
        _fill(upper, Panel(label, lines, spans=[span], framed=framed))
        _fill(lower, Panel(difference.label, [difference], spans=[span]))
        lower.axhline(0.0, color=MUTED, lw=0.8)
        upper.set_ylabel(label)
        lower.set_ylabel(difference.label)
        lower.set_xlabel("time [s]")
        style.legend_above(figure, [_legend_entry(line) for line in lines])
        return to_svg(figure, name, f"{label} and {difference.label} from {span[0]:.1f} to {span[1]:.1f} s")


def with_unit(label: str, units: Mapping[str, str], field: str | None = None) -> str:
    """Return an axis label with the unit, if it has one.

    Args:
        units: Field -> unit.
        field: Field that the axis shows; None: ``label``.
    """
    unit = unit_of(field or label, units)
    return f"{label} [{unit}]" if unit else label


def with_gaps(t_s: np.ndarray, values: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return times and values with a NaN between pieces, so that no line connects them.

    Args:
        t_s: Times ``(N,)`` [s].
        values: Values ``(N,)``.
        piece: Number of the piece to which each value belongs, ``(N,)``.
    """
    cuts = np.flatnonzero(np.diff(piece)) + 1
    return np.insert(t_s.astype(float), cuts, np.nan), np.insert(values.astype(float), cuts, np.nan)


def _fill(axes: Axes, panel: Panel) -> None:
    for line in panel.lines:
        _draw(axes, line)
    for begin, end in panel.spans:
        axes.axvspan(begin, end, color=SHADE, lw=0, zorder=0)
    framed = [line.values[np.isfinite(line.values)] for line in panel.lines if line.role in panel.framed]
    inside = np.concatenate(framed) if framed else np.empty(0)
    if inside.size:
        low, high = float(inside.min()), float(inside.max())
        room = 0.08 * (high - low) or 1.0
        axes.set_ylim(low - room, high + room)


def _draw(axes: Axes, line: Line) -> None:
    look = ROLES[line.role]
    axes.plot(
        line.t_s,
        line.values,
        color=look.color,
        ls=look.dash,
        lw=look.width,
        zorder=look.order,
        drawstyle="steps-post" if line.held else "default",
    )


def _legend_entry(line: Line) -> Line2D:
    look = ROLES[line.role]
    return Line2D([], [], color=look.color, ls=look.dash, lw=look.width, label=line.label)
