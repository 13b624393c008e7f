"""Figures as data: instead of a picture, whose layout takes 0.4 s, a page holds a sketch with the figure's texts.

Instead of the robot's picture, which a process of its own draws in 1.5 s, it holds a few bytes.
"""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from sim2real.view import style
from sim2real.view.page import robot_picture

DRAW, DRAW_ROBOT = style.render, robot_picture.drawn


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
        pictures: The number of figures that are drawn nevertheless, the first ones, and of robots.
    """
    figures: list[Figure] = []
    robots: list[Path] = []

    def drawn(model: Path, pose: Mapping[str, float]) -> robot_picture.Drawing:
        robots.append(model)
        return DRAW_ROBOT(model, pose) if len(robots) <= pictures else robot_picture.Drawing(b"PNG", tuple(pose))

    def render(figure: Figure) -> str:
        figures.append(figure)
        return DRAW(figure) if len(figures) <= pictures else sketch(figure)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "render", render)
        patch.setattr(robot_picture, "drawn", drawn)
        yield figures
