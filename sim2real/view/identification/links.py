"""The delays of links on a page: distribution, mean and share of lost messages."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from sim2real.artifacts.files import number
from sim2real.artifacts.identification import Link, links_table
from sim2real.view.blocks import Block, FigureBlock, TableBlock
from sim2real.view.style import BLUE, INK, ORANGE, new_figure, styled, to_svg

_ROW_IN = 1.9
_MIN_SHARE = 1e-4
"""Delays with a smaller share of the largest share are not drawn."""


def link_blocks(links: Sequence[Link]) -> list[Block]:
    """Return figure and table of links; empty without links."""
    if not links:
        return []
    with styled():
        figure = new_figure(0.4 + _ROW_IN * len(links))
        for ax, link in zip(figure.subplots(len(links), 1, squeeze=False)[:, 0], links, strict=True):
            draw_link(ax, link)
        svg = to_svg(figure, "identify-links", "How delays are distributed")
    caption = (
        "Delays of messages, estimated from the motion: the share of each delay, the mean with its 95 % interval, and "
        "the 95th percentile. The motion determines only the sum of delays that are the same for all messages."
    )
    return [FigureBlock(svg, caption), TableBlock.of("Links", links_table(links))]


def draw_link(ax: Axes, link: Link) -> None:
    """Draw the distribution of a link's delays with its mean and its 95th percentile."""
    large = np.flatnonzero(link.share >= _MIN_SHARE * link.share.max())
    drawn = slice(max(large[0] - 1, 0), large[-1] + 2)
    # Draw the distribution, then mean, interval and 95th percentile.
    ms, share = 1e3 * link.delays[drawn], 100.0 * link.share[drawn]
    ax.fill_between(ms, share, step="mid", color=BLUE, alpha=0.8, lw=0)
    if link.mean.low95 is not None and link.mean.high95 is not None:
        ax.axvspan(1e3 * link.mean.low95, 1e3 * link.mean.high95, color=ORANGE, alpha=0.35, lw=0)
    ax.axvline(1e3 * number(link.mean.value), color=INK, lw=1.0)
    ax.axvline(1e3 * number(link.p95.value), color=INK, lw=1.0, ls="--")
    lost = "" if link.lost.value is None else f"; {100.0 * link.lost.value:.2g} % lost"
    if lost and link.burst.value is not None:
        lost += f", {link.burst.value:.2g} in a row"
    ax.set_title(f"{' + '.join(link.parts)}{lost}", fontsize="small")
    ax.set_xlabel("delay [ms]; line: mean, band: its 95 % interval, dashed: 95th percentile", fontsize="x-small")
    ax.set_ylabel("% of messages", fontsize="x-small")
    ax.set_ylim(bottom=0.0)
