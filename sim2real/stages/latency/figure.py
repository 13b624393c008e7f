"""The picture of a test of latency: where the milliseconds go, and how they scatter."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.identification import Link
from sim2real.artifacts.recording import Recording
from sim2real.stages.latency.result import Latency, measured
from sim2real.view.identification.links import draw_link
from sim2real.view.style import BLUE, MUTED, ORANGE, PURPLE, new_figure, styled

_COLORS = {"host": BLUE, "bus": ORANGE, "device": PURPLE}
_BINS = 60


def picture(
    path: Path, latency: Latency, recording: Recording, chain: Sequence[str], links: Sequence[Link] = ()
) -> None:
    """Draw a bar of the medians, and how each part that the clocks saw, or the motion, scatters, into a PNG file.

    Args:
        links: Distributions of the device's delays, estimated from the motion.
    """
    parts = list(measured(recording, chain))
    with styled():
        count = len(parts) + len(links)
        figure = new_figure(1.6 + 1.1 * count)
        axes = figure.subplots(1 + count, 1, height_ratios=[1.4, *[1.0] * count])
        _budget(axes[0], latency)
        for ax, (name, where, took, _) in zip(axes[1 : 1 + len(parts)], parts, strict=True):
            _histogram(ax, 1e3 * took, _COLORS[where])
            ax.set_title(f"{name}: {where}, {took.size} times")
        axes[len(parts)].set_xlabel("ms; lines at the median and at 99 %")
        for ax, link in zip(axes[1 + len(parts) :], links, strict=True):
            draw_link(ax, link)
        figure.savefig(path, dpi=110, facecolor="white")


def _budget(ax: Any, latency: Latency) -> None:
    """Draw the medians side by side, the device's share with its 95 % interval."""
    begin, named = 0.0, set()
    for part in (p for p in latency.parts if p.counted):
        width = 1e3 * (part.took.p50 or 0.0)
        label = None if part.where in named else part.where
        ax.barh(0, width, left=begin, color=_COLORS[part.where], edgecolor="white", linewidth=0.5, label=label)
        named.add(part.where)
        begin += width
    if hidden := latency.hidden:
        width = 1e3 * hidden.estimate
        ax.barh(0, width, left=begin, color=_COLORS["device"], edgecolor="white", linewidth=0.5, label="device")
        error = 1e3 * np.array([[hidden.estimate - hidden.low95], [hidden.high95 - hidden.estimate]])
        ax.errorbar(begin + width, 0, xerr=np.maximum(error, 0.0), color=MUTED, capsize=3)
    ax.set_title(f"from motion to motion: {1e3 * latency.total_s:.1f} ms, by medians")
    ax.set_yticks([])
    ax.set_xlabel("ms")
    ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _histogram(ax: Any, ms: np.ndarray, color: str) -> None:
    """Draw up to the 99.5 % quantile, and say how many are beyond."""
    ms = ms[np.isfinite(ms)]
    if not ms.size:
        return
    end = max(float(np.quantile(ms, 0.995)), 1e-3)
    low = min(0.0, float(ms.min()))
    ax.hist(ms[ms <= end], bins=np.linspace(low, end, _BINS), color=color)
    for q, dash in ((0.5, "-"), (0.99, ":")):
        ax.axvline(np.quantile(ms, q), color=MUTED, linestyle=dash, linewidth=1.0)
    if beyond := int((ms > end).sum()):
        ax.annotate(
            f"{beyond} beyond, up to {ms.max():.1f}", (1.0, 0.9), xycoords="axes fraction", ha="right", va="top"
        )
    ax.set_yticks([])
