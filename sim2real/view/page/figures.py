"""Figures of record, train and deploy. Each is one ``<svg>`` element with the colours of the page."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from sim2real.artifacts.bundle import History
from sim2real.artifacts.identification import with_small_unit, worst_window
from sim2real.log.schema import unit_of
from sim2real.view import style
from sim2real.view.blocks import FigureBlock
from sim2real.view.panels import Line, Panel, compared, over_time, with_unit
from sim2real.view.signals import ComparedSeries, Signals
from sim2real.view.style import BLUE, INK, new_figure, styled, to_svg

_DIFFERENCE = "robot \u2212 simulation"


def recording(log: Signals, name: str) -> str:
    """Draw the measurements of a log, with the true states of an embedded robot, and the commands to the motors."""
    middle, length = log.episode.duration_s / 2, min(2.0, log.episode.duration_s / 4)
    zoom = (round(middle, 1), round(middle + length, 1))
    panels = []
    for series in log.measured:
        lines = [Line(series.t_s, series.values, "measured", "measured")]
        if series.name in log.truth:
            truth = log.truth[series.name]
            lines.append(Line(truth.t_s, truth.values, "true state", "truth"))
        panels.append(Panel(with_unit(series.name, log.units), lines, zoom=zoom))
    commanded = "command, not sent" if log.dry else "command"
    for series in log.last_command():
        label = with_unit(f"{series.source}.{series.name}", log.units, series.name)
        panels.append(Panel(label, [Line(series.t_s, series.values, commanded, "command", held=True)], zoom=zoom))
    return over_time(panels, name, f"Measured and commanded signals over {log.episode.duration_s:.1f} s")


def training(curves: History, name: str) -> str:
    """Draw return and success of each seed over the steps of training, and their median."""
    seeds = curves.returns.shape[1]
    with styled():
        figure = new_figure(2.7)
        left, right = figure.subplots(1, 2, sharex=True)
        # Draw one curve for each seed, and their median.
        for axes, values, label in ((left, curves.returns, "return"), (right, curves.success, "success")):
            for seed in range(seeds):
                selected = seed == curves.best_seed
                dash = style.DASHES[0 if selected else 1 + seed % 3]
                look: dict[str, Any] = {"marker": "o", "ms": 3.5, "lw": 1.8} if selected else {"lw": 0.9, "alpha": 0.7}
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
                selected = f"seed {curves.best_seed}, in the bundle"
                entries.insert(1, Line2D([], [], color=BLUE, lw=1.8, marker="o", ms=3.5, label=selected))
            style.legend_above(figure, entries)
        return to_svg(figure, name, f"Return and success of {seeds} seeds over the steps of training")


def deployment(pairs: Sequence[ComparedSeries], units: Mapping[str, str], number: int, name: str) -> str:
    """Draw one episode on the robot, the same policy in simulation, and on the right their difference."""
    panels = []
    for pair in pairs:
        label = with_unit(pair.label, units, pair.robot.name)
        off = None
        if pair.difference is not None:
            off = Line(pair.robot.t_s, pair.difference, _DIFFERENCE, "residual", held=pair.held)
        panels.append(Panel(label, _lines(pair), difference=off))
    return over_time(panels, name, f"Episode {number} on the robot, in simulation, and their difference")


def largest_difference(
    episodes: Sequence[Sequence[ComparedSeries]], positions: Sequence[str], units: Mapping[str, str], name: str
) -> FigureBlock | None:
    """Draw the measurement with the largest difference to its simulation; None without a simulation.

    It is the largest root mean square over a second, as a share of the motion on the robot.

    Args:
        positions: Names of the measurements to choose from; empty: all.
        units: Field -> unit.
    """
    best: tuple[float, int, ComparedSeries, np.ndarray, tuple[float, float, float]] | None = None
    for number, pairs in enumerate(episodes):
        for pair in pairs:
            if positions and pair.robot.name not in positions:
                continue
            off = pair.difference
            if pair.held or off is None or not (finite := np.isfinite(off)).any():
                continue
            window = worst_window(pair.robot.t_s[finite], off[finite] ** 2)
            share = window[2] / max(float(np.std(pair.robot.values)), 1e-12)
            if best is None or share > best[0]:
                best = share, number, pair, off, window
    if best is None:
        return None
    _, number, pair, off, (begin_s, end_s, error) = best
    unit = unit_of(pair.robot.name, units)
    line = Line(pair.robot.t_s, off, f"difference [{unit}]" if unit else "difference", "residual")
    label = with_unit(pair.label, units, pair.robot.name)
    svg = compared(_lines(pair), line, label, (begin_s, end_s), name)
    where = f"{pair.label} in episode {number}, from {begin_s:.1f} s, root mean square {with_small_unit(error, unit)}"
    return FigureBlock(svg, f"The second with the largest difference, as a share of the motion: {where}.")


def _lines(pair: ComparedSeries) -> list[Line]:
    lines = [Line(pair.robot.t_s, pair.robot.values, "robot", "measured", held=pair.held)]
    if pair.simulation is not None:
        other = pair.simulation
        lines.append(Line(other.t_s, other.values, "simulation", "identified", held=pair.held))
    return lines


def _thousands(count: float) -> str:
    for size, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(count) >= size:
            return f"{count / size:g}{letter}"
    return f"{count:g}"
