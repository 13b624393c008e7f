"""What a page consists of: figures, tables and notes; and how numbers are written in them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

MISSING = "–"  # noqa: RUF001 - a dash, as tables have it

_UNITS = {"_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_nm": "N m", "_v": "V", "_m": "m", "_s": "s"}


@dataclass(frozen=True)
class FigureBlock:
    """A figure: its SVG and what to see in it; two narrow ones stand beside each other where there is room."""

    svg: str
    caption: str
    narrow: bool = False
    kind: str = "figure"


@dataclass(frozen=True)
class TableBlock:
    """A table.

    Attributes:
        caption: What it is about.
        columns: Headers.
        rows: Cells as text; the first of each row is its header.
        text_columns: Indices of columns that are no numbers, aligned left.
        remarks: For each row a remark, shown small below its header.
        folded: Whether it is folded away at first.
        kind: What the template tells blocks apart by.
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
    """Something the reader has to know first."""

    text: str
    kind: str = "note"


@dataclass(frozen=True)
class FoldBlock:
    """Tables that are folded away at first: there for who wants to know."""

    caption: str
    tables: Sequence[TableBlock]
    kind: str = "fold"


@dataclass(frozen=True)
class ListBlock:
    """Sentences below a heading."""

    caption: str
    items: Sequence[str]
    kind: str = "list"


Block = FigureBlock | TableBlock | NoteBlock | FoldBlock | ListBlock
Tone = Literal["good", "doubt", "bad"]
MARKS: Mapping[Tone, str] = {"good": "✓", "doubt": "!", "bad": "✗"}


@dataclass(frozen=True)
class Banner:
    """A judgement, above everything else of a section: its colour says no more than its sign and its words."""

    tone: Tone
    title: str
    reasons: Sequence[str] = ()

    @property
    def mark(self) -> str:
        """The sign beside the title."""
        return MARKS[self.tone]


@dataclass(frozen=True)
class Tile:
    """A number that matters: shown large, at the top."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Section:
    """One stage's part of a page."""

    id: str
    title: str
    lead: str
    tiles: Sequence[Tile] = ()
    blocks: Sequence[Block] = field(default_factory=list)
    banner: Banner | None = None


def number(value: Any, digits: int = 4) -> str:
    """Write a number with so many significant digits; other values as they are."""
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
    # Trailing zeros stay: they say how exactly a number is known.
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e" in text:
        mantissa, exponent = text.split("e")
        text = f"{mantissa.rstrip('.')}e{int(exponent)}"
    return text.replace("-", "\u2212")


def fixed(value: float | None, decimals: int) -> str:
    """Write a number with so many decimals."""
    if value is None or math.isnan(value):
        return MISSING
    return f"{value:.{decimals}f}".replace("-", "\u2212") if math.isfinite(value) else number(value)


def interval(low: float | None, high: float | None, digits: int = 4) -> str:
    """Write an interval."""
    return MISSING if low is None or high is None else f"{number(low, digits)} to {number(high, digits)}"


def decimals_for(error: float | None, value: float) -> int:
    """Return with how many decimals a value is worth writing, two digits of its standard error."""
    if not error or not math.isfinite(error):
        return max(0, 3 - math.floor(math.log10(abs(value)))) if value and math.isfinite(value) else 3
    return min(9, max(0, 1 - math.floor(math.log10(error))))


def pretty_unit(unit: str) -> str:
    """Write a unit, or a formula, with its powers as such."""
    return unit.replace("^2", "²").replace("^3", "³") or "1"


def spoken(name: str) -> tuple[str, str]:
    """Return a quantity's name in words, and the unit that it carries: ``angle_rms_rad`` is an angle rms in rad."""
    for suffix, unit in _UNITS.items():
        if name.endswith(suffix):
            return name.removesuffix(suffix).replace("_", " "), unit
    return name.replace("_", " "), "1"


def flat(tree: Any, prefix: str = "") -> Iterable[tuple[str, str]]:
    """Yield dotted name and value of every leaf of nested dicts."""
    if isinstance(tree, Mapping) and tree:
        for name, value in tree.items():
            yield from flat(value, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(tree, list) and not any(isinstance(v, Mapping) for v in tree):
        yield prefix, " ".join(str(v) for v in tree)
    else:
        yield prefix, MISSING if tree is None else f"{tree:g}" if isinstance(tree, float) else str(tree)


def pairs_table(caption: str, tree: Any) -> TableBlock:
    """Return a table of names and values."""
    return TableBlock(caption, ("name", "value"), list(flat(tree)), text_columns=(1,))
