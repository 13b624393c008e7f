"""The picture of a designed excitation: commands, the motion to expect, and the intervals to expect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from sim2real.artifacts.design import Design
from sim2real.view.style import BLUE, MUTED, ORANGE, PURPLE, new_figure, styled


def picture(path: Path, design: Design) -> None:
    """Draw a design into a PNG file.

    Args:
        path: The file.
        design: What is drawn.
    """
    names = list(design.speed)
    rows = max(design.commands.shape[1], len(names))
    t_s = np.arange(len(design.commands)) / design.rate_hz
    with styled():
        figure = new_figure(2.0 + 1.3 * rows + 0.3 * len(design.expected))
        heights = [1.0] * rows + [0.6 + 0.2 * len(design.expected)]
        panels: Any = figure.subplots(rows + 1, 1, height_ratios=heights)
        for i, ax in enumerate(panels[:-1]):
            if i < design.commands.shape[1]:
                ax.plot(t_s, design.commands[:, i], color=BLUE, label="command")
                for limit in (design.low[i], design.high[i]):
                    ax.axhline(limit, color=MUTED, linestyle="--", linewidth=0.8)
            if i < len(names):
                ax.plot(design.t_s, design.predicted[:, i], color=ORANGE, label="predicted position [rad]")
                ax.set_title(names[i])
        panels[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        panels[-2].set_xlabel("s; dashed: limits of commands")
        ax = panels[-1]
        place = np.arange(len(design.expected))[::-1]
        kinds = (("now", "now"), ("after_other", f"after a {design.other}"), ("after", "after the design"))
        for k, ((field, label), color) in enumerate(zip(kinds, (MUTED, PURPLE, BLUE), strict=True)):
            percent = [100 * getattr(e, field) for e in design.expected]
            ax.barh(place + 0.25 * (1 - k), percent, 0.25, color=color, label=label)
        ax.set_yticks(place, [e.name for e in design.expected])
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_xlabel("half of the 95 % interval to expect [%]")
        ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
        figure.savefig(path, dpi=110, facecolor="white")
