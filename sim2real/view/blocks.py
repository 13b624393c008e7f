"""The parts of a page (figures, tables, notes), and the formatting of numbers in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

MISSING = "–"  # noqa: RUF001 - a dash, as is usual in tables

_UNITS = {"_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_nm": "N m", "_v": "V", "_m": "m", "_s": "s"}


@dataclass(frozen=True)
class FigureBlock:
    """A figure.

    Attributes:
        svg: The figure as SVG.
        caption: What it shows.
        narrow: Whether two such figures fit side by side.
        kind: The kind of block, for the template.
    """

    svg: str
    caption: str
    narrow: bool = False
    kind: str = "figure"


@dataclass(frozen=True)
class TableBlock:
    """A table.

    Attributes:
        caption: What it shows.
        columns: Headers of the columns.
        rows: Cells as text; the first of each row is its header.
        text_columns: Indices of columns with text, which are aligned left.
        remarks: A remark for each row, shown small below its header.
        folded: Whether it is collapsed at first.
        kind: The kind of block, for the template.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: Sequence[int] = ()
    remarks: Sequence[str] = ()
    folded: bool = False
    kind: str = "table"


@dataclass(frozen=True)
class NoteBlock:
    """A note that the reader should see first."""

    text: str
    kind: str = "note"


@dataclass(frozen=True)
class FoldBlock:
    """Tables with details, collapsed at first."""

    caption: str
    tables: Sequence[TableBlock]
    kind: str = "fold"


@dataclass(frozen=True)
class ListBlock:
    """A list of sentences with a heading."""

    caption: str
    items: Sequence[str]
    kind: str = "list"


Block = FigureBlock | TableBlock | NoteBlock | FoldBlock | ListBlock
Tone = Literal["good", "doubt", "bad"]
MARKS: Mapping[Tone, str] = {"good": "✓", "doubt": "!", "bad": "✗"}


@dataclass(frozen=True)
class Banner:
    """A verdict at the top of a section, readable without its colour: a sign and words say the same."""

    tone: Tone
    title: str
    reasons: Sequence[str] = ()

    @property
    def mark(self) -> str:
        """The sign beside the title."""
        return MARKS[self.tone]


@dataclass(frozen=True)
class Tile:
    """An important number, shown large at the top."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class PageSection:
    """One stage's part of a page."""

    id: str
    title: str
    lead: str
    tiles: Sequence[Tile] = ()
    blocks: Sequence[Block] = field(default_factory=list)
    banner: Banner | None = None


def number(value: object, digits: int = 4) -> str:
    """Return a number as text with ``digits`` significant digits; other values as ``str`` does."""
    if value is None:
        return MISSING
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f") if abs(value) >= 10_000 else str(value)
    if not isinstance(value, float):
        return str(value)
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else ("∞" if value > 0 else "\u2212∞")
    if not value:
        return "0"
    # Trailing zeros stay: they show how precisely a number is known.
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa.rstrip('.')}e{int(exponent)}"
    return text.replace("-", "\u2212")


def fixed(value: float | None, decimals: int) -> str:
    """Return a number as text with a fixed number of decimals."""
    if value is None or math.isnan(value):
        return MISSING
    return f"{value:.{decimals}f}".replace("-", "\u2212") if math.isfinite(value) else number(value)


def interval(low: float | None, high: float | None, digits: int = 4) -> str:
    """Return an interval as text.

    Args:
        low: Lower end; None: unknown.
        high: Upper end; None: unknown.
    """
    return MISSING if low is None or high is None else f"{number(low, digits)} to {number(high, digits)}"


def decimals_for(error: float | None, value: float) -> int:
    """Return the number of decimals that shows two digits of a value's standard error; without one, four digits."""
    if not error or not math.isfinite(error):
        return max(0, 3 - math.floor(math.log10(abs(value)))) if value and math.isfinite(value) else 3
    return min(9, max(0, 1 - math.floor(math.log10(error))))


def pretty_unit(unit: str) -> str:
    """Return a unit or a formula with powers as superscripts."""
    return unit.replace("^2", "²").replace("^3", "³") or "1"


def spoken(name: str) -> tuple[str, str]:
    """Split a quantity's name into words and unit, e.g. ``angle_rms_rad`` into "angle rms" and "rad"."""
    for suffix, unit in _UNITS.items():
        if name.endswith(suffix):
            return name.removesuffix(suffix).replace("_", " "), unit
    return name.replace("_", " "), "1"


def flat(tree: object, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Yield dotted name and value, as text, of every leaf of nested dictionaries."""
    if isinstance(tree, Mapping) and tree:
        for name, value in tree.items():
            yield from flat(value, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(tree, list) and not any(isinstance(v, Mapping) for v in tree):
        yield prefix, " ".join(str(v) for v in tree)
    else:
        yield prefix, MISSING if tree is None else f"{tree:g}" if isinstance(tree, float) else str(tree)


def pairs_table(caption: str, tree: object) -> TableBlock:
    """Return a table of names and values."""
    return TableBlock(caption, ("name", "value"), list(flat(tree)), text_columns=(1,))
