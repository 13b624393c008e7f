"""The output of commands: results on stdout, progress and messages on stderr, without colour."""

from __future__ import annotations

import io
import re
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim2real.artifacts.paths import shown

if TYPE_CHECKING:
    from sim2real.artifacts.summary import ArtifactTable

_TICK_S = 1.0
"""Period of a terminal's progress display [s]."""
_LINES_S = (1.0, 2.0, 4.0, 8.0, 15.0)
"""Times at which a log file gets a line of progress [s after the start]; later lines come at doubling intervals."""
_ANEW_S = 0.1
"""Shortest time between two displays on a terminal [s]."""
_CLEAR = "\r\033[K"

# Characters that control a terminal: control characters except line feed and tab, and changes of text direction.
_ACTS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def clean(text: str) -> str:
    """Return a text with control sequences escaped: names in foreign files must not control the user's terminal."""
    return _ACTS.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


# -- results


def table(rows: Iterable[Sequence[Any]], headers: Sequence[str] | None = None) -> str:
    """Return rows as aligned plain text: numbers to the right, all else to the left.

    Args:
        rows: Cells by row; rows may differ in length. Floats are shown with 4 significant digits, None as '-'.
        headers: Column titles; None: no titles and no rule below them.

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


def artifact_table(content: ArtifactTable, most: int | None = None) -> str:
    """Return a table of an artifact as aligned plain text; a last line counts the rows beyond ``most``."""
    text, more = table(content.rows[:most], content.headers), len(content.rows) - len(content.rows[:most])
    return f"{text}\n... and {more} more rows" if more else text


def pairs(values: Mapping[str, Any]) -> str:
    """Return names and values as text, one pair per line."""
    return "\n".join(line.rstrip() for line in table([[name, _cell(v)] for name, v in values.items()]).splitlines())


def wrote(path: Path | str) -> None:
    """Print the name of a file or folder that was written, on stdout."""
    print(f"wrote {clean(shown(path))}", flush=True)


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
    """Return whether a column has numbers only, apart from missing values."""
    values = [value for value in column if value is not None]
    return bool(values) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)


# -- messages and progress


class Bar:
    """Progress of an activity. On a terminal it is one line; in a log file it is a few lines, at growing intervals.

    Attributes:
        n: Steps that were done.
    """

    def __init__(self, total: float | None, desc: str, shown: bool = True) -> None:
        self.n: float = 0
        self._total, self._postfix, self._lock = total, "", threading.Lock()
        self._shown, self._terminal = shown, sys.stderr.isatty()
        self._begin(desc)

    def update(self, n: float = 1) -> None:
        """Add steps that were done."""
        self.n += n
        self.refresh()

    def refresh(self) -> None:
        """Show the present state, if a display is due."""
        with self._lock:
            passed_s = time.monotonic() - self._begun_s
            if passed_s < self._due_s or not self._visible:
                return
            done = f"{self.n:g} of {self._total:g}" if self._total else f"{self.n:g}" if self.n else ""
            text = f"{self._desc}: {', '.join(filter(None, [done, self._postfix, f'{passed_s:.0f} s so far']))}"
            if self._terminal:
                self._due_s = passed_s + _ANEW_S
                _on_line(clean(text)[: shutil.get_terminal_size().columns - 1])
            else:
                last_s = _LINES_S[-1]
                self._due_s = next((s for s in _LINES_S if s > passed_s), last_s * (passed_s // last_s + 1))
                note(text)

    def set_description_str(self, desc: str) -> None:
        """Begin another part of the activity."""
        if desc != self._desc:
            self.end("finished")
            self._begin(desc)

    def set_postfix_str(self, text: str) -> None:
        """Set a text such as an intermediate result."""
        self._postfix = text

    def end(self, how: str) -> None:
        """Print how long the activity took; remove the terminal's line."""
        if self._visible and self._terminal:
            _on_line("")
        elif self._visible:
            suffix = f" ({self._postfix})" if self._postfix else ""
            note(f"{self._desc}: {how} after {time.monotonic() - self._begun_s:.1f} s{suffix}")

    def _begin(self, desc: str) -> None:
        self._desc = desc
        self._begun_s, self._due_s = time.monotonic(), 0.0 if self._terminal else _LINES_S[0]
        if _brief is not None:
            _brief.activity = desc
        elif self._visible and not self._terminal:
            note(f"{desc}: started")

    @property
    def _visible(self) -> bool:
        return self._shown and _brief is None


@contextmanager
def progress(total: float | None, desc: str, shown: bool = True) -> Iterator[Bar]:
    """Show progress on stderr; the shown time also advances during a long step.

    Args:
        total: Number of steps; None if unknown.
        shown: Whether to show it; of several processes, one shows it.
    """
    bar = Bar(total, desc, shown)
    try:
        with _ticking(bar.refresh):
            yield bar
    except BaseException:
        bar.end("ended")
        raise
    bar.end("finished")


def note(text: str, urgent: bool = False) -> None:
    """Print a message on stderr, without breaking a progress display.

    Args:
        urgent: Whether a person must act now: it is printed even while output is held back, like warnings.
    """
    if _brief is not None:
        if not urgent and not text.startswith("warning:"):
            _brief.text.write(f"{clean(text)}\n")
            return
        sys.stderr.write("\n")  # the line of dots ends
    elif sys.stderr.isatty():
        sys.stderr.write(_CLEAR)
    print(clean(text), file=sys.stderr, flush=True)


def _on_line(text: str) -> None:
    """Show a text in place of the terminal's last line."""
    print(f"{_CLEAR}{text}", end="", file=sys.stderr, flush=True)


class _Brief:
    """Output that is held back, and the present activity."""

    def __init__(self) -> None:
        self.text, self.activity = io.StringIO(), ""


_brief: _Brief | None = None


@contextmanager
def brief() -> Iterator[None]:
    """Show a block on one line: hold back its tables, notes and progress, and print them if it fails.

    Warnings, and notes that a person must act on, are printed. A terminal shows the seconds that have passed and the
    present activity; a log file gets a dot each second, so that neither is silent.
    """
    global _brief
    held, terminal, begun_s = _Brief(), sys.stderr.isatty(), time.monotonic()

    def tick() -> None:
        if terminal:
            _on_line(f"  {time.monotonic() - begun_s:.0f} s  {held.activity}"[:100])
        else:
            print(".", end="", file=sys.stderr, flush=True)

    print("  ", end="", file=sys.stderr, flush=True)
    _brief = held
    try:
        with redirect_stdout(held.text), _ticking(tick):
            yield
    except BaseException:
        # Print the details after a failure: they may name the cause.
        sys.stderr.write(f"\n{held.text.getvalue()}")
        raise
    finally:
        _brief = None
    # Replace the display by the duration.
    print(f"{f'{_CLEAR} ' if terminal else ''} {time.monotonic() - begun_s:.0f} s", file=sys.stderr, flush=True)


@contextmanager
def _ticking(tick: Callable[[], object]) -> Iterator[None]:
    """Call a function every second, in a thread, while the block runs."""
    ended = threading.Event()

    def run() -> None:
        while not ended.wait(_TICK_S):
            tick()

    thread = threading.Thread(target=run, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
