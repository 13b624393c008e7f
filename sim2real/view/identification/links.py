"""What identification found of links: how long messages take, how much that varies, and how many are lost."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sim2real.artifacts.estimation.links import Link
from sim2real.artifacts.files import number as known
from sim2real.view.blocks import Block, FigureBlock, TableBlock, number
from sim2real.view.style import BLUE, INK, ORANGE, new_figure, styled, to_svg

_ROW_IN = 1.9
_SEEN = 1e-4
"""Delays that fewer messages have are not drawn."""


def link_blocks(links: Sequence[Link]) -> list[Block]:
    """Return picture and numbers of links; nothing without any."""
    if not links:
        return []
    with styled():
        figure = new_figure(0.4 + _ROW_IN * len(links))
        for ax, link in zip(figure.subplots(len(links), 1, squeeze=False)[:, 0], links, strict=True):
            draw_link(ax, link)
        svg = to_svg(figure, "identify-links", "How delays are distributed")
    rows = [
        [name, number(factor * known(r.value), 3), *(number(factor * known(e), 3) for e in (r.low95, r.high95)), unit]
        for link in links
        for name, r, factor, unit in link.rows()
    ]
    caption = (
        "How long messages take, as the motion shows it: the share of each delay, the mean with its 95 % interval, and "
        "what 95 % of the messages do not exceed. Of what is the same for all messages only a sum is known."
    )
    return [FigureBlock(svg, caption), TableBlock("Links", ("link", "value", "from", "to (95 %)", "unit"), rows, (4,))]


def draw_link(ax: Any, link: Link) -> None:
    """Draw the distribution of a link's delays with its mean and its 95th percentile."""
    shown = np.flatnonzero(link.share >= _SEEN * link.share.max())
    own = slice(max(shown[0] - 1, 0), shown[-1] + 2)
    ms, share = 1e3 * link.delays[own], 100.0 * link.share[own]
    ax.fill_between(ms, share, step="mid", color=BLUE, alpha=0.8, lw=0)
    if link.mean.low95 is not None and link.mean.high95 is not None:
        ax.axvspan(1e3 * link.mean.low95, 1e3 * link.mean.high95, color=ORANGE, alpha=0.35, lw=0)
    ax.axvline(1e3 * known(link.mean.value), color=INK, lw=1.0)
    ax.axvline(1e3 * known(link.p95.value), color=INK, lw=1.0, ls="--")
    lost = "" if link.lost.value is None else f"; {100.0 * link.lost.value:.2g} % lost"
    if lost and link.burst.value is not None:
        lost += f", {link.burst.value:.2g} in a row"
    ax.set_title(f"{' + '.join(link.parts)}{lost}", fontsize="small")
    ax.set_xlabel("delay [ms]; line: mean, band: its 95 %, dashed: 95 % of the messages are faster", fontsize="x-small")
    ax.set_ylabel("% of messages", fontsize="x-small")
    ax.set_ylim(bottom=0.0)
