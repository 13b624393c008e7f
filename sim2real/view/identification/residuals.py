"""Residuals of the identified model on held-out data: over time, as a histogram, and their autocorrelation."""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from sim2real.artifacts.identification import Identification
from sim2real.view import style
from sim2real.view.identification.figures import MAX_PANELS
from sim2real.view.panels import with_unit
from sim2real.view.style import BLUE, GRID, INK, MUTED, ORANGE, SHADE, new_figure, styled, to_svg

_BINS = 41


@dataclass(frozen=True)
class Residuals:
    """Measured minus predicted of one field, without the part to which initial states are fitted.

    Attributes:
        t_s: Shape ``(N,)``: time along all recordings [s], one after the other.
        values: Shape ``(N,)``.
        piece: Shape ``(N,)``: number of the segment.
        every: Shape ``(M,)``: values of all segments, overlapping ones included.
        lag_s: Shape ``(K,)``.
        autocorrelation: Shape ``(K,)``, around zero.
    """

    t_s: np.ndarray
    values: np.ndarray
    piece: np.ndarray
    every: np.ndarray
    lag_s: np.ndarray
    autocorrelation: np.ndarray


def residuals(result: Identification, quantity: str) -> Residuals:
    """Return the residuals of the identified model on held-out data."""
    s = result.samples
    rest = s[f"{quantity}_measured"].astype(float) - s[f"{quantity}_identified"]
    held_out = s["held_out"].astype(bool) & (s["into"] > result.settle_s)
    steps = np.diff(s["t"][held_out])[np.diff(s["segment"][held_out]) == 0]
    period_s = float(np.median(steps)) if steps.size else 0.0
    # Place the recordings one after the other on one time axis.
    t_s, reached = s["t"].astype(float).copy(), 0.0
    for number, recording in enumerate(result.recordings):
        of_recording = held_out & (s["recording"] == recording)
        if number and of_recording.any():
            t_s[of_recording] += reached + period_s - float(s["t"][of_recording].min())
        reached = max(reached, float(t_s[of_recording].max(initial=0.0)))
    # Draw residuals without overlapping segments, but use all for the statistics.
    chosen = held_out & result.disjoint()
    lags = autocorrelation(rest[held_out], s["segment"][held_out])
    return Residuals(
        t_s[chosen], rest[chosen], s["segment"][chosen], rest[held_out], period_s * np.arange(len(lags)), lags
    )


def autocorrelation(values: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Return the autocorrelation around zero within segments, up to two thirds of the longest; ``(K,)`` from lag 0."""
    parts = [values[segment == number] for number in np.unique(segment)]
    longest = max((len(p) for p in parts), default=0)
    power = float(np.mean(values**2)) if values.size else 0.0
    if longest < 3 or power == 0.0:
        return np.ones(1)
    lags = []
    for lag in range(2 * longest // 3):
        products = [p[: len(p) - lag] * p[lag:] for p in parts if len(p) > lag]
        lags.append(float(np.concatenate(products).mean()) / power)
    return np.array(lags)


def figure(result: Identification, name: str) -> str:
    """Draw a row for each field: residuals over time, their histogram, and their autocorrelation."""
    fields = [f for f in result.fields if "identified" in result.models(f)][:MAX_PANELS]
    with styled():
        drawing = new_figure(0.8 + 1.65 * len(fields))
        grid = drawing.subplots(len(fields), 3, squeeze=False, width_ratios=[2.0, 1, 1])
        # Draw the row of each field.
        for quantity, row in zip(fields, grid, strict=True):
            rest, sigma = residuals(result, quantity), result.sigma.get(quantity)
            _over_time(row[0], rest, sigma)
            row[0].set_ylabel(with_unit(quantity, result.units))
            _histogram(row[1], rest.every, sigma)
            _lags(row[2], rest)
        # Add titles, labels and the legend.
        titles = ("Residual on held-out data", "Distribution", "Autocorrelation")
        for axes, title in zip(grid[0], titles, strict=True):
            axes.annotate(title, (0, 1.16), xycoords="axes fraction", fontweight="bold", fontsize=9, color=INK)
        several = len(result.recordings) > 1
        for axes, label in zip(
            grid[-1], ("time, log after log [s]" if several else "time [s]", "residual", "lag [s]"), strict=True
        ):
            axes.set_xlabel(label)
        entries: list[Line2D | Patch] = [Line2D([], [], color=BLUE, label="measured \u2212 identified")]
        entries.append(
            Line2D([], [], color=INK, ls=style.DASHES[1], lw=1.1, label="normal distribution of the same deviation")
        )
        if result.sigma:
            entries.append(
                Line2D([], [], color=ORANGE, ls=style.DASHES[0], lw=1.4, label="assumed noise of the measurement")
            )
        entries.append(Patch(facecolor=SHADE, edgecolor=GRID, label="95 % of white noise"))
        style.legend_above(drawing, entries)
        return to_svg(drawing, name, f"Residuals of {', '.join(fields)} on held-out data")


def _over_time(axes: Axes, rest: Residuals, sigma: float | None) -> None:
    cuts = np.flatnonzero(np.diff(rest.piece)) + 1
    axes.plot(np.insert(rest.t_s, cuts, np.nan), np.insert(rest.values, cuts, np.nan), color=BLUE, lw=1.0)
    axes.axhline(0.0, color=MUTED, lw=0.8)
    for edge in (-1.96, 1.96) if sigma else ():
        axes.axhline(edge * (sigma or 0.0), color=ORANGE, lw=0.9)


def _histogram(axes: Axes, values: np.ndarray, sigma: float | None) -> None:
    """Draw the density over the range of most residuals; the outer bins hold the rest."""
    if not values.size:
        return
    # Choose the range, which outliers must not widen.
    deviation = float(np.sqrt(np.mean(values**2))) or 1e-12
    reach = max(2.0 * float(np.quantile(np.abs(values), 0.9)), 4 * (sigma or 0.0), 1e-12)
    bins = np.linspace(-reach, reach, _BINS)
    axes.hist(np.clip(values, -reach, reach), bins=bins.tolist(), density=True, facecolor=BLUE, alpha=0.35)
    x = np.linspace(-reach, reach, 241)
    axes.plot(x, _normal(x, deviation), color=INK, ls=style.DASHES[1], lw=1.1)
    top = axes.get_ylim()[1]
    if sigma:
        axes.plot(x, _normal(x, sigma), color=ORANGE, lw=1.4)
        axes.set_ylim(0, min(axes.get_ylim()[1], 2.2 * top))
    axes.set_yticks([])
    axes.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))
    text = f"RMS {deviation:.3g}" + (f", {deviation / sigma:.2g} times the assumed noise" if sigma else "")
    axes.set_title(text, fontweight="normal", fontsize=8)


def _lags(axes: Axes, rest: Residuals) -> None:
    band = 1.96 / np.sqrt(max(len(rest.values), 1))
    axes.axhspan(-band, band, color=SHADE, lw=0, zorder=0)
    axes.axhline(0.0, color=MUTED, lw=0.8)
    axes.plot(rest.lag_s, rest.autocorrelation, color=BLUE, marker="o", ms=2.5, lw=1.0)
    axes.set_ylim(min(-0.3, float(np.min(rest.autocorrelation)) - 0.1), 1.05)


def _normal(x: np.ndarray, deviation: float) -> np.ndarray:
    return np.exp(-0.5 * (x / deviation) ** 2) / (deviation * np.sqrt(2 * np.pi))
