"""What a command prints: data on stdout, talk on stderr, no colour."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm


# What makes a terminal do something: control characters but line feed and tab, and what turns the direction of text.
_ACTS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def clean(text: str) -> str:
    """Return a text as it may go to a terminal: names in files of others may hold sequences that a terminal obeys."""
    return _ACTS.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def table(rows: Iterable[Sequence[Any]], headers: Sequence[str] | None = None) -> str:
    """Return rows as aligned plain text: numbers to the right, everything else to the left.

    Args:
        rows: Cells by row; rows may differ in length. Floats are shown with 4 significant digits, None as '-'.
        headers: Column titles; None leaves them and the rule below them out.

    Returns:
        Lines without trailing spaces and without a final newline; '' for an empty table without headers.
    """
    cells = [list(row) for row in rows]
    text = [[_cell(value) for value in row] for row in cells]
    titles = [list(headers)] if headers is not None else []
    columns = max((len(row) for row in titles + text), default=0)
    for row in titles + text:
        row.extend([""] * (columns - len(row)))
    widths = [max(len(row[c]) for row in titles + text) for c in range(columns)]
    right = [_is_numeric([row[c] for row in cells if c < len(row)]) for c in range(columns)]
    body = [*titles, *([["-" * width for width in widths]] if titles else []), *text]
    return "\n".join(
        "  ".join(cell.rjust(w) if r else cell.ljust(w) for cell, w, r in zip(row, widths, right, strict=True)).rstrip()
        for row in body
    )


def pairs(values: Mapping[str, Any]) -> str:
    """Return names and values, one pair a line."""
    return "\n".join(line.rstrip() for line in table([[name, _cell(v)] for name, v in values.items()]).splitlines())


def progress(total: int | None, desc: str, *, always: bool = False) -> tqdm:
    """Return a progress bar on stderr; it shows nothing unless stderr is a terminal.

    Args:
        total: Number of steps; None if unknown.
        desc: What is being done.
        always: Show the bar without a terminal too.
    """
    from tqdm import tqdm  # not needed for --help

    return tqdm(total=total, desc=desc, file=sys.stderr, leave=False, disable=not (always or sys.stderr.isatty()))


def note(text: str) -> None:
    """Tell the user something, on stderr; progress bars on the screen stay whole."""
    if "tqdm" in sys.modules:
        from tqdm import tqdm

        tqdm.write(clean(text), file=sys.stderr)
    else:
        print(clean(text), file=sys.stderr)
    sys.stderr.flush()


def wrote(path: Path | str) -> None:
    """Name a file or folder that was written, on stdout."""
    print(f"wrote {clean(shown(path))}", flush=True)


def shown(path: Path | str) -> str:
    """Return a path as the user would type it: relative to the working directory where it lies inside."""
    absolute = Path(os.path.abspath(path))
    here = Path.cwd()
    return str(absolute.relative_to(here)) if absolute.is_relative_to(here) else str(absolute)


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, list | tuple | Mapping) and not value):
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(_cell(v) for v in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_cell(v)}" for name, v in value.items())
    return clean(str(value)).replace("\n", "\\n")


def _is_numeric(column: Sequence[Any]) -> bool:
    """Whether a column holds numbers, and perhaps gaps."""
    values = [value for value in column if value is not None]
    return bool(values) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
