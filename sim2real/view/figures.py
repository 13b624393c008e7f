"""Figures of what the stages found. Every function returns one ``<svg>`` element; colours follow the page's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from sim2real.view import style
from sim2real.view.artifacts import Deployment, Identification, Training
from sim2real.view.signals import Recording, unit_of
from sim2real.view.style import BLUE, GREEN, GRID, INK, MUTED, ORANGE, ROLES, SHADE, new_figure, styled, to_svg


@dataclass(frozen=True)
class Line:
    """One line of a panel; ``role`` is a name in ``style.ROLES`` and says how it looks."""

    t_s: np.ndarray
    values: np.ndarray
    label: str
    role: str
    held: bool = False
    """Whether the value holds until the next one: a command."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes over time."""

    label: str
    lines: Sequence[Line]


def over_time(
    panels: Sequence[Panel],
    name: str,
    label: str,
    spans: Sequence[tuple[float, float]] = (),
    zoom: tuple[float, float] | None = None,
) -> str:
    """Draw panels above each other on one axis of time.

    Args:
        panels: What to draw.
        name: Name of the figure, unique on its page.
        label: What it shows, in words.
        spans: Intervals [s] that are shaded: held out.
        zoom: An interval [s] that a second column shows closer.
    """
    with styled():
        figure = new_figure(0.7 + 1.45 * len(panels))
        columns = 2 if zoom else 1
        grid = figure.subplots(
            len(panels), columns, sharex="col", sharey="row", squeeze=False, width_ratios=[2.1, 1][:columns]
        )
        for panel, row in zip(panels, grid, strict=True):
            for axes in row:
                for line in panel.lines:
                    _draw(axes, line)
                for begin, end in spans:
                    axes.axvspan(begin, end, color=SHADE, lw=0, zorder=0)
            row[0].set_ylabel(panel.label)
        for axes in grid[-1]:
            axes.set_xlabel("time [s]")
        if zoom:
            grid[0, 1].set_xlim(*zoom)
            grid[0, 1].xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
            grid[0, 1].set_title(f"{zoom[0]:g} to {zoom[1]:g} s", fontweight="normal", color=MUTED)
        seen = {line.label: line for panel in panels for line in panel.lines}
        entries: list[Any] = [_legend_entry(line) for line in seen.values()]
        entries += [Patch(facecolor=SHADE, edgecolor=GRID, label="held out")] if len(spans) else []
        style.legend_above(figure, entries)
        return to_svg(figure, name, label)


def recording(log: Recording, name: str) -> str:
    """Draw what a log measured, with the truth where it is known, and what was commanded last."""
    panels = []
    for series in log.measured:
        lines = [Line(series.t_s, series.values, "measured", "measured")]
        if series.name in log.truth:
            true = log.truth[series.name]
            lines.append(Line(true.t_s, true.values, "true state", "truth"))
        panels.append(Panel(_with_unit(series.name, log.units), lines))
    for series in log.last_command():
        label = _with_unit(f"{series.source}.{series.name}", log.units, series.name)
        panels.append(Panel(label, [Line(series.t_s, series.values, "commanded", "command", held=True)]))
    middle, length = log.episode.duration_s / 2, min(2.0, log.episode.duration_s / 4)
    zoom = (round(middle, 1), round(middle + length, 1))
    return over_time(panels, name, f"Measured and commanded signals over {log.episode.duration_s:.1f} s", zoom=zoom)


def predictions(found: Identification, name: str) -> str:
    """Draw measured against predicted, segment by segment; what was held out is shaded and shown closer."""
    samples = {n: v[found.disjoint()] for n, v in found.samples.items()}
    t_s, segment = samples["t"], samples["segment"]
    panels = []
    for quantity in found.fields:
        lines = []
        for model in ("measured", *found.models(quantity)):
            label = {"measured": "measured", "identified": "identified model", "nominal": "nominal model"}[model]
            if model == "measured":
                lines.append(Line(*_measured(found, quantity), label, model))
            else:
                lines.append(Line(*_with_gaps(t_s, samples[f"{quantity}_{model}"], segment), label, model))
        panels.append(Panel(_with_unit(quantity, found.units), lines))
    ordered = np.argsort(found.samples["t"], kind="stable")
    spans = _spans(found.samples["t"][ordered], found.samples["held_out"][ordered].astype(bool))
    begin = spans[0][0] if spans else float(t_s[0])
    zoom = (round(begin, 1), round(min(begin + 4.0, float(t_s[-1])), 1))
    label = f"Measured {', '.join(found.fields)} against predictions of the identified and the nominal model"
    return over_time(panels, name, label, spans, zoom if zoom[1] > zoom[0] else None)


def prediction_errors(found: Identification, name: str) -> str:
    """Draw the prediction's error over its horizon, a panel for each field; filled marks are held-out data."""
    fields = sorted({f for row in found.prediction for f in row.rmse}, key=lambda f: (f not in found.fields, f))
    models = list(dict.fromkeys(row.model for row in found.prediction))
    with styled():
        figure = new_figure(2.7, min(style.WIDTH_IN, 4.7 * len(fields)))
        grid = figure.subplots(1, len(fields), squeeze=False)[0]
        for axes, quantity in zip(grid, fields, strict=True):
            for number, model in enumerate(models):
                _error_lines(axes, found, quantity, model, _model_look(model, number))
            axes.set_yscale("log")
            style.plain_log(axes.yaxis)
            axes.margins(x=0.05)
            axes.set_xlabel("horizon [s]")
            unit = unit_of(quantity, found.units)
            axes.set_ylabel(f"RMSE of {quantity}" + (f" [{unit}]" if unit else ""))
        entries: list[Any] = []
        for number, model in enumerate(models):
            color, dash, mark = _model_look(model, number)
            entries.append(Line2D([], [], color=color, ls=dash, marker=mark, ms=5, label=model))
        kinds = {row.held_out for row in found.prediction}
        if kinds == {True, False}:
            entries.append(
                Line2D([], [], color=MUTED, ls="", marker="o", ms=5, mfc="none", label="fitted data (hollow)")
            )
        style.legend_above(figure, entries)
        return to_svg(figure, name, f"Prediction error of {', '.join(models)} over the horizon")


def search(found: Identification, name: str) -> str:
    """Draw the best loss of each generation."""
    with styled():
        figure = new_figure(2.6, 3.8)
        axes = figure.subplots()
        axes.plot(np.arange(1, len(found.history) + 1), found.history, color=BLUE)
        if np.nanmin(found.history) > 0:
            axes.set_yscale("log")
            style.plain_log(axes.yaxis)
        axes.set(xlabel="generation", ylabel="best loss")
        return to_svg(figure, name, f"Best loss over {len(found.history)} generations")


def correlation(names: Sequence[str], matrix: np.ndarray, name: str) -> str:
    """Draw a correlation matrix; the numbers stand in the cells."""
    count = len(names)
    with styled():
        figure = new_figure(1.3 + 0.42 * count, min(style.WIDTH_IN, 2.1 + 0.62 * count))
        axes = figure.subplots()
        axes.pcolormesh(matrix, cmap="RdBu_r", vmin=-1, vmax=1, edgecolor="white", lw=1)
        for i in range(count):
            for j in range(count):
                color = "#ffffff" if abs(matrix[i, j]) > 0.6 else "#000000"
                text = f"{matrix[i, j]:.2f}".replace("-0.00", "0.00").replace("-", "\u2212")
                axes.text(j + 0.5, i + 0.5, text, ha="center", va="center", color=color, fontsize=8)
        ticks = np.arange(count) + 0.5
        axes.set_xticks(ticks, names, rotation=30, ha="right", rotation_mode="anchor")
        axes.set_yticks(ticks, names)
        axes.invert_yaxis()
        axes.grid(False)
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        return to_svg(figure, name, f"Correlations between the estimates of {', '.join(names)}")


def training(curves: Training, name: str) -> str:
    """Draw return and success of each seed over the steps, and their median."""
    seeds = curves.returns.shape[1]
    with styled():
        figure = new_figure(2.7)
        left, right = figure.subplots(1, 2, sharex=True)
        for axes, values, label in ((left, curves.returns, "return"), (right, curves.success, "success")):
            for seed in range(seeds):
                kept = seed == curves.best_seed
                dash = style.DASHES[0 if kept else 1 + seed % 3]
                look: dict[str, Any] = {"marker": "o", "ms": 3.5, "lw": 1.8} if kept else {"lw": 0.9, "alpha": 0.7}
                axes.plot(curves.steps, values[:, seed], color=BLUE, ls=dash, **look)
            if seeds > 1:
                axes.plot(curves.steps, np.nanmedian(values, axis=1), color=INK, lw=2.2)
            axes.set(xlabel="steps in simulation", ylabel=label)
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _thousands(value)))
        right.set_ylim(-0.03, 1.03)
        if seeds > 1:
            entries = [
                Line2D([], [], color=BLUE, lw=0.9, ls=style.DASHES[1], label="one seed each"),
                Line2D([], [], color=INK, lw=2.2, label=f"median of {seeds} seeds"),
            ]
            if curves.best_seed is not None:
                kept = f"seed {curves.best_seed}, whose policy was kept"
                entries.insert(1, Line2D([], [], color=BLUE, lw=1.8, marker="o", ms=3.5, label=kept))
            style.legend_above(figure, entries)
        return to_svg(figure, name, f"Return and success of {seeds} seeds over the steps of training")


def deployment(deployed: Deployment, number: int, name: str) -> str:
    """Draw one episode on the robot against the same policy in simulation."""
    log = deployed.episodes[number]
    units = {**log.units, **deployed.units}
    simulated = {s.name: s for s in deployed.simulated[number]}
    commands = [n for n in simulated if n.partition("[")[0] == "command"]
    panels = []
    for series in log.measured:
        lines = [Line(series.t_s, series.values, "robot", "measured")]
        if series.name in simulated:
            other = simulated[series.name]
            lines.append(Line(other.t_s, other.values, "simulation", "identified"))
        panels.append(Panel(_with_unit(series.name, units), lines))
    for index, series in enumerate(log.last_command()):
        lines = [Line(series.t_s, series.values, "robot", "measured", held=True)]
        if index < len(commands):
            other = simulated[commands[index]]
            lines.append(Line(other.t_s, other.values, "simulation", "identified", held=True))
        panels.append(Panel(_with_unit(f"{series.source}.{series.name}", units, series.name), lines))
    zoom = (0.0, round(min(3.0, log.episode.duration_s / 3), 1))
    return over_time(panels, name, f"Episode {number} on the robot and in simulation", zoom=zoom)


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


def _with_unit(label: str, units: Mapping[str, str], field: str | None = None) -> str:
    unit = unit_of(field or label, units)
    return f"{label} [{unit}]" if unit else label


def _with_gaps(t_s: np.ndarray, values: np.ndarray, segment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Break a line where a segment ends: the next one starts from a state of its own."""
    cuts = np.flatnonzero(np.diff(segment)) + 1
    return np.insert(t_s.astype(float), cuts, np.nan), np.insert(values.astype(float), cuts, np.nan)


def _measured(found: Identification, quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a measurement wherever there is one, in order of time: segments may overlap, and repeat it."""
    t_s, first = np.unique(found.samples["t"], return_index=True)
    pieces = np.cumsum(np.diff(t_s, prepend=t_s[:1]) > 3 * np.median(np.diff(t_s)))
    return _with_gaps(t_s, found.samples[f"{quantity}_measured"][first], pieces)


def _spans(t_s: np.ndarray, chosen: np.ndarray) -> list[tuple[float, float]]:
    """Return the intervals over which ``chosen`` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int)))
    return [(float(t_s[b]), float(t_s[e - 1])) for b, e in zip(edges[::2], edges[1::2], strict=True)]


def _thousands(count: float) -> str:
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(count) >= size:
            return f"{count / size:g}{letter}"
    return f"{count:g}"


def _model_look(model: str, number: int) -> tuple[str, Any, str]:
    """Return colour, dash and mark of a model; those of the overlay where it is one of them."""
    known = {"identified": (BLUE, style.DASHES[0], "o"), "nominal": (ORANGE, style.DASHES[1], "s")}
    others = ((MUTED, style.DASHES[2], "^"), (GREEN, style.DASHES[3], "D"), (style.PURPLE, style.DASHES[1], "v"))
    return known.get(model, others[number % len(others)])


def _error_lines(axes: Axes, found: Identification, quantity: str, model: str, look: tuple[str, Any, str]) -> None:
    color, dash, mark = look
    for held_out in (False, True):
        rows = [r for r in found.prediction if r.model == model and r.held_out == held_out and quantity in r.rmse]
        rows.sort(key=lambda r: r.horizon_s)
        axes.plot(
            [r.horizon_s for r in rows],
            [r.rmse[quantity] for r in rows],
            color=color,
            ls=dash if held_out else "",
            marker=mark,
            ms=5,
            mfc=color if held_out else "none",
        )
