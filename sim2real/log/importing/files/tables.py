"""Reads tables in text: CSV with commas, semicolons, tabs, bars or blanks between the cells."""

import codecs
import csv
import json
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.files import dates
from sim2real.log.importing.files.budget import MAX_BYTES, MAX_COLUMNS, WHOLE, require_signals, require_size
from sim2real.log.importing.files.cells import MISSING, OTHER, NoNumbersError, is_number, number_in
from sim2real.log.importing.files.raw_file import RawSignals
from sim2real.log.importing.signal_names import meaning
from sim2real.types import Json

_COMMENTS = ("#", "%", "//")
_BLOCK = 4096
_STAMP_UNITS = ("s", "ms", "us", "ns")
_LIST = re.compile(r"\[[^a-zA-Z]*\d")
_Cells = list[tuple[int, str]]


def encoding_of(path: Path, kind: str) -> str:
    """Return the encoding of a file of text: UTF-8, UTF-16 with a mark, else latin-1.

    Args:
        kind: Expected format, for the error.

    Raises:
        UsageError: When the file holds zero bytes, which text has not.
    """
    with path.open("rb") as stream:
        mark = stream.read(4)
        for bom, name in (
            (codecs.BOM_UTF8, "utf-8-sig"),
            (codecs.BOM_UTF16_LE, "utf-16"),
            (codecs.BOM_UTF16_BE, "utf-16"),
        ):
            if mark.startswith(bom):
                return name
        # Without a mark, the text is UTF-8 if all of it decodes, else latin-1.
        stream.seek(0)
        decoder, encoding = codecs.getincrementaldecoder("utf-8")(), "utf-8"
        while block := stream.read(1 << 20):
            if b"\0" in block:
                raise UsageError(f"{path} is no {kind}: it holds zero bytes, as no text does", hint=WHOLE)
            if encoding == "utf-8":
                try:
                    decoder.decode(block)
                except UnicodeDecodeError:
                    encoding = "latin-1"
    return encoding


def read_csv(path: Path) -> RawSignals:
    """Read a table with the names of its columns in the first line.

    Comment lines (``#``, ``%``, ``//``) are skipped; the last one before the numbers can hold the names.

    Raises:
        UsageError: When the table has no names, lines of different lengths, or is too large.
    """
    require_size(path, MAX_BYTES)
    encoding = encoding_of(path, "CSV")
    table = _Table(path)
    try:
        with path.open(encoding=encoding, newline=None) as stream:
            table.read(stream)
    except (UnicodeError, csv.Error) as error:
        raise UsageError(f"{path} is no CSV: {error}", hint=WHOLE) from None
    notes = (f"{path.name} is no UTF-8: it is read as latin-1",) if encoding == "latin-1" else ()
    return RawSignals([name for name in table.header if name], table.load, notes=(*notes, *table.notes()))


class _Table:
    """The columns of a table, read in blocks of lines: numbers take 8 bytes each, other cells stay text.

    Attributes:
        header: Names of the columns; empty for a column without a name.
    """

    def __init__(self, path: Path) -> None:
        self.header: list[str] = []
        self._path = path
        self._delimiter = ","
        self._blocks: list[list[np.ndarray | _Cells]] = []
        self._line = 0
        self._point: tuple[int, str] | None = None
        self._comma: tuple[int, str] | None = None

    def read(self, stream: Iterator[str]) -> None:
        """Read all lines."""
        comments: list[str] = []
        # Find the separator from the first two lines; a spreadsheet can name it in a line "sep=".
        lines = self._lines(stream, comments)
        head = list(islice(lines, 2))
        if head and head[0][1].lower().startswith("sep=") and len(head[0][1].strip()) == 5:
            self._delimiter = head[0][1].strip()[4]
            head = [*head[1:], *islice(lines, 1)]
        elif head:
            self._delimiter = _delimiter(head[0][1], head[-1][1])
        if not head:
            raise UsageError(f"{self._path} is empty", hint=WHOLE)
        # Take the names from the first line, or from the last comment if the first line holds numbers.
        first = self._cells(head[0][1])
        named = [c for c in map(self._cells, comments[::-1]) if len(c) == len(first)]
        if all(is_number(name) for name in first):
            if not named or all(is_number(name) for name in named[0]):
                raise UsageError(
                    f"the first line of {self._path} holds numbers, not names", hint="put the columns' names there"
                )
            self.header, rest = named[0], head
        else:
            self.header, rest = first, head[1:]
        require_signals(len(self.header), self._path)
        twice = [name for name, count in Counter(self.header).items() if name and count > 1]
        if twice:
            raise UsageError(f"{self._path} has more than one column {min(twice)!r}", hint="rename one of them")
        self._blocks = [[] for _ in self.header]

        def texts() -> Iterator[str]:
            for self._line, text in chain(rest, lines):
                yield text

        # Convert the lines in blocks, so that the text of a large file is never in the memory at once.
        rows = csv.reader(texts(), delimiter=self._delimiter, skipinitialspace=True)
        numbered = ((self._line, self._row(row)) for row in rows if any(cell.strip() for cell in row))
        head_rows = list(islice(numbered, 2))
        self._refuse_words(head_rows)
        numbered = chain(head_rows, numbered)
        while block := list(islice(numbered, _BLOCK)):
            self._take(block)
        # A file with both decimal points and commas is ambiguous.
        if self._point and self._comma:
            listed = "line {} {!r} with a comma, line {} {!r} with a point".format(*self._comma, *self._point)
            raise UsageError(
                f"decimals in {self._path} are written in two ways: {listed}",
                hint="write all numbers alike, without marks between thousands",
            )

    def _lines(self, stream: Iterator[str], comments: list[str]) -> Iterator[tuple[int, str]]:
        """Yield number and text of the lines that are no comments, and collect the first comments."""
        for number, text in enumerate(stream, 1):
            stripped = text.strip()
            if stripped.startswith(_COMMENTS):
                if len(comments) < 100:
                    comments.append(stripped.lstrip("#%/ \t"))
            elif stripped:
                yield number, text.strip("\r\n") if self._delimiter != " " else stripped

    def _cells(self, text: str) -> list[str]:
        rows = list(csv.reader([text.strip()], delimiter=self._delimiter, skipinitialspace=True))
        return [name.strip() for name in rows[0]] if rows else []

    def _row(self, row: list[str]) -> list[str]:
        """Return a line's cells, without empty cells after the last column with a name."""
        width = len(self.header)
        named = max((i + 1 for i, name in enumerate(self.header) if name), default=0)
        # Drop empty cells after the last named column.
        while len(row) > named and not row[-1].strip():
            row.pop()
        if [cell.strip() for cell in row[:named]] == self.header[:named]:
            raise UsageError(
                f"line {self._line} of {self._path} repeats the names of the columns: two recordings were joined",
                hint="cut the file there, and import the parts one by one; or delete the line, if time goes on",
            )
        if named <= len(row) <= width:
            row += [""] * (width - len(row))
        else:
            comma = self._delimiter == "," and len(row) > named
            raise UsageError(
                f"line {self._line} of {self._path} has {len(row)} cells, the first has {named}",
                hint="decimal commas need semicolons or tabs between the cells" if comma else WHOLE,
            )
        return row

    def _refuse_words(self, rows: Sequence[tuple[int, list[str]]]) -> None:
        """Refuse a line of words below the names, such as units."""
        if len(rows) < 2:
            return
        (line, first), (_, second) = rows
        words = [cell.strip() for cell in first]
        plain = [i for i, word in enumerate(words) if word.lower() not in MISSING]
        if any(is_number(words[i].replace(",", ".")) or _LIST.match(words[i]) for i in plain):
            return
        if any(dates.is_other(words[i]) or dates.are_dates([words[i]]) for i in plain):
            return
        if any(is_number(second[i].replace(",", ".")) for i in plain):
            raise UsageError(
                f"line {line} of {self._path} holds words below the names of the columns, no numbers: "
                f"{', '.join(words[:6])}",
                hint="delete the line, and write units into the names, as in q_rad or t_ms",
            )

    def _take(self, block: list[tuple[int, list[str]]]) -> None:
        """Convert the cells of some lines, column by column."""
        numbers = [n for n, _ in block]
        # Try integers, then floats; keep other cells as text with their lines.
        for column, cells in zip(self._blocks, zip(*(row for _, row in block), strict=True), strict=True):
            try:
                column.append(np.array([int(cell) for cell in cells], np.int64))
                continue
            except (ValueError, OverflowError):
                pass
            try:
                column.append(np.array([float(cell) if cell.strip() else np.nan for cell in cells]))
            except ValueError:
                column.append(list(zip(numbers, cells, strict=True)))
            if self._delimiter != ",":
                for n, cell in zip(numbers, cells, strict=True):
                    if "," in cell and is_number(cell.replace(",", ".")):
                        self._comma = self._comma or (n, cell)
                    elif "." in cell and is_number(cell):
                        self._point = self._point or (n, cell)

    def notes(self) -> list[str]:
        """Return a sentence on columns without a name."""
        unnamed = [blocks for name, blocks in zip(self.header, self._blocks, strict=True) if not name]
        nonempty = [
            blocks for blocks in unnamed if any(isinstance(b, list) or np.isfinite(b).any() for b in blocks)
        ]  # fmt: skip
        return [f"skipped: columns without a name: {len(nonempty)}"] * bool(nonempty)

    def load(self, name: str) -> np.ndarray | list[Json]:
        """Return a column.

        Raises:
            KeyError: When no column has this name.
            UsageError: When a cell holds no number.
        """
        if not name or name not in self.header:
            raise KeyError(name)
        blocks = self._blocks[self.header.index(name)]
        if not blocks:
            return []
        # Choose by the first text: lists, dates, or numbers with missing values.
        texts = [cell for block in blocks if isinstance(block, list) for cell in block]
        if texts and texts[0][1].lstrip().startswith("["):
            return self._lists(texts, name)
        if len(texts) and dates.are_dates([texts[0][1]]):
            return self._dates(blocks, texts, name)
        if len(texts) == sum(map(len, blocks)) and not any(self._may_be_number(cell) for _, cell in texts):
            raise NoNumbersError(f"column {name!r} of {self._path} holds no numbers: {texts[0][1][:60]!r}", hint=OTHER)
        parts = [
            block if isinstance(block, np.ndarray) else np.array([self._number(n, cell, name) for n, cell in block])
            for block in blocks
        ]
        return np.concatenate(parts)

    def _dates(self, blocks: Sequence[np.ndarray | _Cells], texts: _Cells, name: str) -> np.ndarray:
        unit = meaning(name).unit
        try:
            if not all(isinstance(block, list) for block in blocks):
                raise ValueError("it mixes dates and numbers", 0)
            return dates.parsed([cell for _, cell in texts], unit if unit in _STAMP_UNITS else "")
        except ValueError as error:
            line = texts[error.args[1]][0]
            raise UsageError(
                f"line {line} of {self._path}, column {name!r}: {error.args[0]}", hint="dates as 2024-05-01T12:00:00.25"
            ) from None

    def _lists(self, texts: _Cells, name: str) -> list[Json]:
        """Return the lists in cells, as ``[0.1, 0.2]`` or ``[0.1 0.2]``."""
        lists = []
        for line, text in texts:
            try:
                lists.append(json.loads(text) if "," in text else [float(x) for x in text.strip("[] ").split()])
            except (ValueError, RecursionError):
                raise UsageError(
                    f"line {line} of {self._path}, column {name!r} holds {text[:60]!r}, no list of numbers", hint=WHOLE
                ) from None
            if len(lists[-1]) > MAX_COLUMNS:
                raise UsageError(f"line {line} of {self._path}, column {name!r} holds {len(lists[-1])} numbers")
        return lists

    def _number(self, line: int, text: str, name: str) -> float:
        """Return the number in a cell, with a decimal point or comma; NaN for a missing number."""
        stripped, where = text.strip(), f"line {line} of {self._path}, column {name!r}"
        comma = is_number(stripped.replace(",", ".")) and stripped.count(",") == 1
        if comma and self._delimiter != ",":
            return float(stripped.replace(",", "."))
        hint = "write dates as 2024-05-01T12:00:00.25" if dates.is_other(stripped) else ""
        hint = "decimal commas need semicolons or tabs between the cells" if comma else hint
        if hint:
            raise UsageError(f"{where} holds {text[:60]!r}, no number", hint=hint)
        return number_in(stripped, where)

    def _may_be_number(self, text: str) -> bool:
        """Return whether a cell holds a number, a word for a missing number, or a date in another form."""
        stripped = text.strip()
        return is_number(stripped.replace(",", ".")) or stripped.lower() in MISSING or dates.is_other(stripped)


def _delimiter(first: str, second: str) -> str:
    """Return the separator of a table's cells, from its first two lines."""
    best = max(",;\t|", key=first.count)
    if best in first:
        return best
    return " " if len(first.split()) == len(second.split()) > 1 else ","
