"""Artifacts in a few words: on the console, and as a table in a notebook."""

from __future__ import annotations

import html
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

_WIDTH = 80
"""Most characters of a value on the console."""
Rows = tuple[Sequence[str], Sequence[Sequence[Any]]]
"""Headers of a table, and its rows."""


class Shown(ABC):
    """An artifact that a notebook shows in a few words instead of all its numbers."""

    @abstractmethod
    def about(self) -> Mapping[str, Any]:
        """Return what to say about it: name -> value."""

    def rows(self) -> Rows | None:
        """Return a table that a notebook shows below it; None: it has none."""
        return None

    def __repr__(self) -> str:
        pairs = (f"{name}: {textwrap.shorten(_text(value), _WIDTH)}" for name, value in self.about().items())
        return f"{type(self).__name__}({', '.join(pairs)})"

    def _repr_html_(self) -> str:
        pairs = "".join(_row("td", [name, value]) for name, value in self.about().items())
        shown = f"<b>{type(self).__name__}</b><table>{pairs}</table>"
        if (table := self.rows()) is None:
            return shown
        return f"{shown}<table>{_row('th', table[0])}{''.join(_row('td', row) for row in table[1])}</table>"


class Summed(Shown):
    """An artifact of a stage with a ``summary`` of how the stage went, in text and numbers."""

    if TYPE_CHECKING:

        @property
        def summary(self) -> Any:
            """How the stage went."""

    def __iter__(self) -> Iterator[Any]:
        """Yield the artifact and its summary: earlier versions returned a pair of them."""
        yield self
        yield self.summary


def _row(tag: str, cells: Sequence[Any]) -> str:
    return f"<tr>{''.join(f'<{tag}>{html.escape(_text(cell))}</{tag}>' for cell in cells)}</tr>"


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
