"""The parts of a page (figures, tables, notes), and the format of their numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

from sim2real.artifacts.run import StageFolder
from sim2real.artifacts.summary import ArtifactTable, Cell, Interval

MISSING = "–"  # noqa: RUF001 - a dash, as is usual in tables

Tone = Literal["good", "doubt", "bad"]
MARKS: Mapping[Tone, str] = {"good": "✓", "doubt": "!", "bad": "✗"}
_SVG_WIDTH = re.compile(r'<svg[^>]* width="([\d.]+)pt"')
_WIDE_PT = 400.0
"""A figure up to this width [px] has letters of at least 7 px on a screen of 390 px."""
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)? ?%?")


@dataclass(frozen=True)
class FigureBlock:
    """A figure.

    Attributes:
        kind: Kind of block, for the template.
    """

    svg: str
    caption: str
    kind: str = "figure"

    @property
    def layout(self) -> str:
        """CSS class: on a telephone a ``wide`` figure scrolls, and any other figure is scaled to fit."""
        drawn = _SVG_WIDTH.search(self.svg)
        return "wide" if drawn is not None and float(drawn[1]) > _WIDE_PT else "small"


@dataclass(frozen=True)
class TableBlock:
    """A table.

    Attributes:
        columns: Headers of the columns.
        rows: Cells as text; the first cell of each row is its header.
        text_columns: Indices of columns with text, which are aligned left.
        remarks: A remark for each row, in small letters below its header.
        folded: Whether it is collapsed at first.
        tones: Tone of each row, which colours its last cell; empty for none.
        kind: Kind of block, for the template.
    """

    caption: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    text_columns: Sequence[int] = ()
    remarks: Sequence[str] = ()
    folded: bool = False
    tones: Sequence[Tone] = ()
    kind: str = "table"

    @property
    def marks(self) -> list[str]:
        """The sign of each row's tone."""
        return [MARKS[tone] for tone in self.tones]

    @staticmethod
    def of(caption: str, table: ArtifactTable) -> TableBlock:
        """Return an artifact's table as text: numbers with four digits, short times in ms, pretty units."""
        units = [header == "unit" for header in table.headers]
        readable = [_in_ms(row, units) for row in table.rows]
        rows = [[cell_text(cell, unit) for cell, unit in zip(row, units, strict=True)] for row in readable]
        # Text is aligned left; a number that its artifact has formatted counts as a number.
        is_text = lambda cell: isinstance(cell, bool) or (isinstance(cell, str) and not _NUMBER.fullmatch(cell))  # noqa: E731
        text = [i for i, column in enumerate(zip(*table.rows, strict=True)) if i and any(map(is_text, column))]
        return TableBlock(caption, [_with_minus(header) for header in table.headers], rows, text)


@dataclass(frozen=True)
class NoteBlock:
    """A note before the other blocks."""

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


@dataclass(frozen=True)
class Banner:
    """A verdict at the top of a section; a sign and words repeat the meaning of its colour."""

    tone: Tone
    title: str
    reasons: Sequence[str] = ()

    @property
    def mark(self) -> str:
        """The sign beside the title."""
        return MARKS[self.tone]


@dataclass(frozen=True)
class Tile:
    """An important number, in large letters at the top."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class PageSection:
    """The section of one stage; it begins with the banner and the figure."""

    id: str
    title: str
    lead: str
    tiles: Sequence[Tile] = ()
    blocks: Sequence[Block] = field(default_factory=list)
    banner: Banner | None = None
    figure: FigureBlock | None = None

    @property
    def box(self) -> Banner:
        """The verdict with its first reason, for the head of the page; without a verdict, the first number."""
        if self.banner is not None:
            return replace(self.banner, reasons=self.banner.reasons[:1])
        return Banner("doubt", "no verdict", [f"{tile.label} {tile.value}" for tile in self.tiles[:1]])


def sentence(text: str, names: Iterable[str] = ()) -> str:
    """Write a message as a sentence; a name at its beginning stays as it is.

    Args:
        names: Names of joints; other names have an underscore.
    """
    first = text.split(" ", 1)[0]
    named = "_" in first or first.rstrip(",:") in names
    return (text if named else text[:1].upper() + text[1:]).rstrip(".") + "."


def cell_text(cell: Cell, unit: bool = False) -> str:
    """Return a cell of an artifact's table as text.

    Args:
        unit: Whether the cell is a unit.
    """
    if unit:
        return pretty_unit(str(cell or ""))
    if isinstance(cell, Interval):
        return interval(cell.low, cell.high)
    return MISSING if cell == "" else _with_minus(cell) if isinstance(cell, str) else number(cell)


def _in_ms(row: Sequence[Cell], units: Sequence[bool]) -> Sequence[Cell]:
    """Return a row in ms if its unit is s and its numbers are below 1; other rows are unchanged."""
    if "s" not in [cell for cell, unit in zip(row, units, strict=True) if unit]:
        return row
    numbers = [x for cell in row for x in (_ends(cell) if isinstance(cell, Interval) else (cell,))]
    finite = [abs(x) for x in numbers if isinstance(x, float) and math.isfinite(x)]
    if not finite or max(finite) >= 1.0:
        return row
    return ["ms" if unit else _scaled(cell, 1e3) for cell, unit in zip(row, units, strict=True)]


def _ends(ends: Interval) -> tuple[float | None, float | None]:
    return ends.low, ends.high


def _scaled(cell: Cell, factor: float) -> Cell:
    if isinstance(cell, Interval):
        return Interval(*(None if x is None else factor * x for x in _ends(cell)))
    return factor * cell if isinstance(cell, float) else cell


def _with_minus(text: str) -> str:
    """Return a number that is written as text with a minus sign instead of a hyphen."""
    return text.replace("-", "\u2212") if _NUMBER.fullmatch(text) else text


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
    # Keep trailing zeros, which show the precision of a number.
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
    """Return an interval as text."""
    return MISSING if low is None or high is None else f"{number(low, digits)} to {number(high, digits)}"


def pretty_unit(unit: str) -> str:
    """Return a unit or a formula with powers as superscripts."""
    return unit.replace("^2", "²").replace("^3", "³")


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


def about(artifact: StageFolder) -> list[Block]:
    """Return configuration, files and versions of a stage as a folded block."""
    m = artifact.manifest
    when = {k: v for k in ("started", "duration_s", "command", "git") if (v := getattr(m, k))}
    tables = {
        "Summary": m.summary,
        "Configuration": m.config,
        "Run": when,
        "Inputs": {n: vars(source) for n, source in m.inputs.items()},
        "Outputs, by SHA-256": {n: source.sha256 for n, source in m.outputs.items()},
        "Versions": m.versions,
    }
    blocks = [pairs_table(caption, tree) for caption, tree in tables.items() if tree]
    return [FoldBlock("Configuration, files and versions", blocks)] if blocks else []
