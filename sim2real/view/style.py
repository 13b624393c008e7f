"""The common style of all figures, and their conversion to SVG with the page's colours."""

import html
import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

# A page can redefine each colour, for dark mode and for print; a single figure has the values below. The hues are those
# of Okabe and Ito, darkened so that text is readable on white.
INK, MUTED, GRID, SHADE = "#1b2430", "#5c6875", "#d9dfe6", "#eef2f6"
BLUE, ORANGE, GREEN, PURPLE = "#0a66b0", "#b8520a", "#0b7a52", "#8a3f86"
_VARIABLES = {
    INK: "ink", MUTED: "muted", GRID: "grid", SHADE: "shade",
    BLUE: "blue", ORANGE: "orange", GREEN: "green", PURPLE: "purple",
}  # fmt: skip
DASHES = ("-", (0, (5, 1.6)), (0, (1.2, 1.4)), (0, (6, 1.5, 1.2, 1.5)))
WIDTH_IN = 10.5
PHONE_IN = 5.5
"""Width of a figure that a telephone shows without scrolling, with letters of at least 7 pixels [in]."""

_RC: dict[str, Any] = {
    "svg.fonttype": "none",  # text, not outlines: can be searched, read aloud and copied
    "svg.hashsalt": "sim2real",
    "text.parse_math": False,  # names may contain a $
    "font.family": "sans-serif",
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 8.5,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.xmargin": 0.01,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "legend.handlelength": 2.8,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
    "path.simplify": True,
    "path.simplify_threshold": 0.2,
    "hatch.linewidth": 0.6,
}

Dash: TypeAlias = str | tuple[int, tuple[float, ...]]
"""The dashes of a line in matplotlib."""


@dataclass(frozen=True)
class Role:
    """The appearance of a kind of line, common to all figures."""

    color: str
    dash: Dash
    width: float
    order: float


ROLES = {
    "measured": Role(INK, DASHES[0], 1.5, 3.0),
    "identified": Role(BLUE, DASHES[1], 1.5, 4.0),
    "without delays": Role(MUTED, DASHES[2], 1.0, 2.2),
    "truth": Role(GREEN, DASHES[3], 1.3, 2.0),
    "residual": Role(BLUE, DASHES[0], 1.2, 3.0),
    "command": Role(PURPLE, DASHES[0], 1.0, 3.0),
}
"""Name of a kind of line -> its appearance: measurements are solid and dark, results of models dashed."""


@contextmanager
def styled() -> Iterator[None]:
    """Apply the style in the block; figures must be created and saved inside it."""
    with mpl.rc_context(cast(Any, _RC)):
        yield


def new_figure(height_in: float, width_in: float = WIDTH_IN) -> Figure:
    """Return an empty figure with automatic layout."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasSVG(figure)
    return figure


def new_grid(
    rows: int, columns: int, row_in: float, gap_in: float, beside_in: float, width_in: float = WIDTH_IN, **more: Any
) -> tuple[Figure, np.ndarray]:
    """Return a figure with many axes of one height, and the axes ``(rows, columns)``.

    Its margins are fixed: automatic layout measures each label, which takes as long as the drawing.

    Args:
        row_in: Height of the axes [in].
        gap_in: Space between rows, with the labels of an axis [in].
        beside_in: Space left of each column, with its labels [in].
        more: For ``Figure.subplots``.
    """
    above_in, below_in, right_in = 0.5, 0.42, 0.12
    height_in = above_in + rows * row_in + (rows - 1) * gap_in + below_in
    figure = Figure(figsize=(width_in, height_in))
    FigureCanvasSVG(figure)
    axes_in = (width_in - columns * beside_in - right_in) / columns
    margins = {
        "left": beside_in / width_in,
        "right": 1 - right_in / width_in,
        "bottom": below_in / height_in,
        "top": 1 - above_in / height_in,
        "hspace": gap_in / row_in,
        "wspace": beside_in / axes_in,
    }
    return figure, figure.subplots(rows, columns, squeeze=False, gridspec_kw=margins, **more)


def render(figure: Figure) -> str:
    """Return a figure as an SVG document.

    ``Figure.savefig`` would draw the figure twice, the first time only for its layout.
    """
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine("none")
    buffer = io.StringIO()
    canvas = cast(FigureCanvasSVG, figure.canvas)
    canvas.print_svg(buffer, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    return buffer.getvalue()


def to_svg(figure: Figure, name: str, label: str) -> str:
    """Return a figure as an ``<svg>`` element, for a page or a file.

    Args:
        figure: The figure, made inside ``styled()``.
        name: Prefix of all ids in it, which must be unique on a page.
        label: Description of the figure, for screen readers.
    """
    text = render(figure)
    text = text[text.index("<svg") :].strip()  # without XML declaration and DOCTYPE, which HTML does not allow
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = text.replace("<svg", f'<svg role="img" aria-label="{html.escape(label)}"', 1)
    text = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", text)
    return re.sub(r"(fill|stroke): (#[0-9a-f]{6})", _as_variable, text)


def legend_above(figure: Figure, entries: Sequence[Artist]) -> None:
    """Add one legend, in a row, above all panels of a figure."""
    if entries:
        figure.legend(handles=entries, loc="outside upper left", ncols=min(6, len(entries)), borderaxespad=0.2)


def _as_variable(match: re.Match[str]) -> str:
    kind, color = match.groups()
    name = _VARIABLES.get(color)
    return f"{kind}: var(--{name}, {color})" if name else match.group(0)
