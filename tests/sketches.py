"""Figures as data: instead of a picture, whose layout takes 0.4 s, a page holds a sketch with the figure's texts."""

from __future__ import annotations

import html
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from sim2real.view import style

DRAW = style.render


def texts(figure: Figure) -> list[str]:
    """Return the texts of a figure: titles, labels, legends, annotations and the labels of ticks."""
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            axis.get_ticklabels()  # computes the ticks, and with them their labels
    return [text.get_text() for text in figure.findobj(Text) if text.get_visible() and text.get_text()]


def sketch(figure: Figure) -> str:
    """Return an SVG document that holds the texts of a figure, and one id."""
    shown = [text.get_text() for text in figure.findobj(Text) if text.get_visible() and text.get_text()]
    rows = "".join(f"<text>{html.escape(text)}</text>" for text in shown)
    return f'<?xml version="1.0"?>\n<svg xmlns="http://www.w3.org/2000/svg"><g id="figure_1">{rows}</g></svg>\n'


@contextmanager
def sketched(pictures: int = 0) -> Iterator[list[Figure]]:
    """Sketch the figures that are made in the block; yields the list of these figures, which grows.

    Args:
        pictures: The number of figures that are drawn nevertheless, the first ones.
    """
    figures: list[Figure] = []

    def render(figure: Figure) -> str:
        figures.append(figure)
        return DRAW(figure) if len(figures) <= pictures else sketch(figure)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "render", render)
        yield figures
