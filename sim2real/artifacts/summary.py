"""Facts and tables of artifacts, for the console, pages, JSON and notebooks."""

from __future__ import annotations

import html
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from sim2real.types import Json

_WIDTH = 80
"""Maximum number of characters of a value on the console."""
_UNITS = {"_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_nm": "N m", "_v": "V", "_m": "m", "_s": "s"}


@dataclass(frozen=True)
class Interval:
    """A 95 % interval as a cell of a table; both ends are None if it is unknown."""

    low: float | None
    high: float | None

    def __str__(self) -> str:
        return "" if self.low is None or self.high is None else f"[{self.low:.4g}, {self.high:.4g}]"


Cell: TypeAlias = str | float | bool | Interval | None
"""A cell: text, number, boolean or interval; None for a missing value."""


@dataclass(frozen=True)
class ArtifactTable:
    """A table of an artifact; each reader (console, page, notebook) formats its cells.

    Attributes:
        headers: Titles of the columns; the column ``unit`` holds units.
        rows: Rows of cells; the first cell is the row's name.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[Cell]]

    def records(self) -> list[dict[str, Cell]]:
        """Return each row as header -> cell, for JSON."""
        return [dict(zip(self.headers, row, strict=True)) for row in self.rows]

    def without(self, *headers: str) -> ArtifactTable:
        """Return the table without some columns."""
        keep = [i for i, header in enumerate(self.headers) if header not in headers]
        return ArtifactTable([self.headers[i] for i in keep], [[row[i] for i in keep] for row in self.rows])


def words_and_unit(name: str) -> tuple[str, str]:
    """Split a quantity's name into words and unit: ``angle_rms_rad`` into "angle rms" and "rad"; "" for none."""
    for suffix, unit in _UNITS.items():
        if name.endswith(suffix):
            return name.removesuffix(suffix).replace("_", " "), unit
    return name.replace("_", " "), ""


class Shown(ABC):
    """An artifact that a notebook shows as a few facts and a table, instead of all its numbers."""

    @abstractmethod
    def about(self) -> Mapping[str, Json]:
        """Return the facts: name -> value."""

    def rows(self) -> ArtifactTable | None:
        """Return the artifact's main table; None if it has none."""
        return None

    def __repr__(self) -> str:
        pairs = (f"{name}: {textwrap.shorten(_text(value), _WIDTH)}" for name, value in self.about().items())
        return f"{type(self).__name__}({', '.join(pairs)})"

    def _repr_html_(self) -> str:
        pairs = "".join(_row("td", [name, value]) for name, value in self.about().items())
        shown = f"<b>{type(self).__name__}</b><table>{pairs}</table>"
        if (table := self.rows()) is None:
            return shown
        return f"{shown}<table>{_row('th', table.headers)}{''.join(_row('td', row) for row in table.rows)}</table>"


def _row(tag: str, cells: Sequence[Json]) -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(_text(cell))}</{tag}>' for cell in cells)}</tr>"


def _text(value: Json) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
