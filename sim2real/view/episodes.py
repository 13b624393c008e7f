"""The figure of the distributions of the training's episodes, with the recorded values."""

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sim2real.artifacts.episodes import Episodes, Varied
from sim2real.artifacts.identification import Noise
from sim2real.view import style
from sim2real.view.style import BLUE, INK, MUTED, ORANGE, new_figure, styled, to_svg

_COLUMNS, _BINS = 2, 40
_ROW_IN = 1.7
_TAIL = 0.999


def episodes_svg(episodes: Episodes, name: str) -> str:
    """Draw parameters, computation times and noise as one ``<svg>`` element of a page."""
    with styled():
        return to_svg(_figure(episodes), name, "Distributions of the episodes, and recorded values")


def picture(path: Path, episodes: Episodes) -> None:
    """Draw the same into a PNG file."""
    with styled():
        _figure(episodes).savefig(path, dpi=110, facecolor="white")


def _figure(episodes: Episodes) -> Figure:
    nodes = [n for n in episodes.recorded_s if n in episodes.drawn_s]
    noise = [n for n in episodes.noise if n.column in episodes.off]
    grows = episodes.curriculum != (1.0, 1.0) and not episodes.follow
    count = max(1, len(episodes.parameters) + len(nodes) + len(noise) + grows)
    rows = math.ceil(count / _COLUMNS)
    figure = new_figure(0.3 + _ROW_IN * rows, style.PHONE_IN)
    axes = figure.subplots(rows, _COLUMNS, squeeze=False).ravel()
    for ax in axes:
        ax.set_yticks([])
        ax.tick_params(labelsize="small")
    # Draw parameters, computation times, noise and curriculum, one panel each.
    used = iter(axes)
    for parameter in episodes.parameters:
        _parameter(next(used), parameter, episodes.draws[parameter.name])
    for node in nodes:
        _times(next(used), node, 1e3 * episodes.recorded_s[node], 1e3 * episodes.drawn_s[node])
    for one in noise:
        _noise(next(used), one, episodes.off[one.column])
    if grows:
        _curriculum(next(used), episodes.curriculum)
    for ax in used:
        ax.set_axis_off()
    return figure


def _parameter(ax: Axes, parameter: Varied, drawn: np.ndarray) -> None:
    """Draw the histogram of a parameter's draws, its value, and its 95 % interval."""
    scale, unit = (1e3, "ms") if parameter.unit == "s" else (1.0, parameter.unit)
    ax.hist(scale * drawn, bins=_BINS, color=BLUE, alpha=0.8)
    if parameter.low95 is not None and parameter.high95 is not None:
        ax.axvspan(scale * parameter.low95, scale * parameter.high95, color=ORANGE, alpha=0.35, lw=0)
    ax.axvline(scale * parameter.value, color=INK, lw=1.0)
    ax.set_title(f"{parameter.name} [{unit or '1'}]", fontsize="small")
    ax.set_xlabel("drawn" if parameter.low95 is None else "drawn; band: 95 % interval", fontsize="x-small")


def _curriculum(ax: Axes, shares: tuple[float, float]) -> None:
    """Draw the share of all differences between episodes over the training."""
    ax.plot([0.0, 1.0], shares, color=BLUE)
    ax.set_ylim(-0.05, 1.05)
    ax.set_yticks([0.0, 1.0])
    ax.set_title("share of all differences", fontsize="small")
    ax.set_xlabel("share of the training; other plots: at its end", fontsize="x-small")


def _times(ax: Axes, node: str, recorded: np.ndarray, drawn: np.ndarray) -> None:
    """Draw recorded and drawn computation times, in logarithmic counts, as hiccups are rare."""
    recorded, drawn = recorded[np.isfinite(recorded)], drawn[np.isfinite(drawn)]
    if not (recorded.size and drawn.size):
        return
    end = max(float(np.quantile(np.concatenate([recorded, drawn]), _TAIL)), 1e-3)
    bins = np.append(np.linspace(0.0, end, _BINS), np.inf)
    shares = [np.histogram(x, bins)[0] / x.size for x in (drawn, recorded)]
    edges = np.append(bins[:-1], bins[-2] + bins[1])
    ax.stairs(shares[0], edges, color=BLUE, fill=True, alpha=0.8)
    ax.stairs(shares[1], edges, color=ORANGE, lw=1.2)
    ax.set_yscale("log")
    ax.set_yticks([])
    ax.minorticks_off()
    ax.set_title(f"steps of {node} [ms]", fontsize="small")
    ax.set_xlabel(f"drawn; line: recorded, up to {recorded.max():.1f} ms", fontsize="x-small")


def _noise(ax: Axes, noise: Noise, off: np.ndarray) -> None:
    """Draw the differences between measurements and model, and the noise of a reading in simulation."""
    wide = max(float(np.quantile(np.abs(off), 0.995)), 1e-12)
    bins = np.linspace(-wide, wide, _BINS)
    ax.hist(off, bins=bins.tolist(), density=True, histtype="step", color=ORANGE, lw=1.2)
    size = math.sqrt(noise.deviation**2 + noise.bias**2 + noise.quantum**2 / 12.0)
    if size > 0.0:
        x = np.linspace(-wide, wide, 200)
        density = np.exp(-0.5 * (x / size) ** 2) / (size * math.sqrt(2.0 * math.pi))
        ax.fill_between(x, density, color=BLUE, alpha=0.8, lw=0)
    ax.axvline(0.0, color=MUTED, lw=0.8)
    ax.set_title(f"{noise.column}: difference from the model [{noise.unit or '1'}]", fontsize="small")
    ax.set_xlabel("noise drawn; line: recorded", fontsize="x-small")
