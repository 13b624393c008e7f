"""The output of commands: results on stdout, progress and messages on stderr, without colour."""

from __future__ import annotations

import io
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sim2real.artifacts.paths import shown as shown

if TYPE_CHECKING:
    from sim2real.artifacts.summary import ArtifactTable

_TICK_S = 1.0
"""Period of a terminal's progress display [s]."""
_LINES_S = (1.0, 2.0, 4.0, 8.0, 15.0)
"""When a log file gets a line of progress [s after its start]; after the last one, a line each time as long again."""

# Characters that control a terminal: control characters except line feed and tab, and changes of text direction.
_ACTS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


@dataclass
class HeldOutput:
    """Output that is held back while a command prints few lines.

    Attributes:
        terminal: Whether stderr is a terminal.
        activity: Text of the latest progress display.
    """

    text: io.StringIO
    terminal: bool
    activity: str = ""


_held: HeldOutput | None = None


def hold(held: HeldOutput | None) -> None:
    """Hold notes and progress back from now on; None: print them again."""
    global _held
    _held = held


class _Silent:
    """Progress that only names the present activity."""

    def __init__(self, held: HeldOutput, total: float | None, desc: str) -> None:
        self.n: float = 0
        self.total = total
        self._held = held
        held.activity = desc

    def update(self, n: float = 1) -> None:
        self.n += n

    def refresh(self) -> None:
        """Do nothing: the holder of the output shows that time passes."""

    def set_description_str(self, desc: str) -> None:
        self._held.activity = desc

    def set_postfix_str(self, s: str) -> None:
        """Do nothing: an intermediate result is a detail."""


def clean(text: str) -> str:
    """Return a text with control sequences escaped: names in foreign files must not control the user's terminal."""
    return _ACTS.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


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


class Bar(Protocol):
    """A progress display; the part of tqdm's interface that is used."""

    n: float
    total: float | None

    def update(self, n: float = 1) -> Any:
        """Add steps that were done."""
        ...

    def refresh(self) -> Any:
        """Show the present state."""
        ...

    def set_description_str(self, desc: str) -> None:
        """Set the description of the activity."""
        ...

    def set_postfix_str(self, s: str) -> None:
        """Set the text after the bar, e.g. an intermediate result."""
        ...


@contextmanager
def progress(total: float | None, desc: str, shown: bool = True) -> Iterator[Bar]:
    """Show a progress bar on stderr, or plain lines if that is not a terminal (a log file).

    The time goes on while one step takes long: on a terminal every second, in a log file after 1, 2, 4, 8, 15 s and
    then every 15 s.

    Args:
        total: Number of steps; None if unknown.
        shown: False shows nothing: another process does.
    """
    # Within a brief stage, only its activity changes.
    if _held is not None:
        yield _Silent(_held, total, desc)
        return
    if sys.stderr.isatty() or not shown:
        from tqdm import tqdm  # not needed for --help

        # Without a total there is nothing to count: the time alone.
        look = None if total else "{desc}: {elapsed}{postfix}"
        bar = tqdm(total=total, desc=desc, file=sys.stderr, leave=False, disable=not shown, bar_format=look)
        with bar, ticking(bar.refresh):
            yield bar
        return
    # Without a terminal, print lines.
    lines = _Lines(total, desc)
    try:
        with ticking(lines.refresh):
            yield lines
    except BaseException:
        lines.end("ended")
        raise
    lines.end("finished")


@contextmanager
def ticking(tick: Callable[[], object]) -> Iterator[None]:
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


class _Lines:
    """Progress as lines of text: one at the start, one at the end, and fewer and fewer in between."""

    def __init__(self, total: float | None, desc: str) -> None:
        self.n: float = 0
        self.total = total
        self._postfix = ""
        self._lock = threading.Lock()
        self._begin(desc)

    def update(self, n: float = 1) -> None:
        self.n += n
        self.refresh()

    def refresh(self) -> None:
        with self._lock:
            passed = time.monotonic() - self._begun_s
            if passed < self._due_s:
                return
            last = _LINES_S[-1]
            self._due_s = next((s for s in _LINES_S if s > passed), last * (passed // last + 1))
            done = f"{self.n:g} of {self.total:g}" if self.total else f"{self.n:g}" if self.n else ""
            note(f"{self._desc}: {', '.join(filter(None, [done, self._postfix, f'{passed:.0f} s so far']))}")

    def set_description_str(self, desc: str) -> None:
        if desc != self._desc:
            self.end("finished")
            self._begin(desc)

    def set_postfix_str(self, s: str) -> None:
        self._postfix = s

    def _begin(self, desc: str) -> None:
        self._desc = desc
        self._begun_s, self._due_s = time.monotonic(), _LINES_S[0]
        note(f"{desc}: started")

    def end(self, how: str) -> None:
        suffix = f" ({self._postfix})" if self._postfix else ""
        note(f"{self._desc}: {how} after {time.monotonic() - self._begun_s:.1f} s{suffix}")


def note(text: str, urgent: bool = False) -> None:
    """Print a message on stderr, without breaking a progress bar.

    Args:
        urgent: Whether a person must act on it now: it is printed even where output is held back. Warnings are, too.
    """
    if _held is not None:
        if not urgent and not text.startswith("warning:"):
            _held.text.write(f"{clean(text)}\n")
            return
        sys.stderr.write("\n")  # the line of dots ends
    if "tqdm" in sys.modules:
        from tqdm import tqdm

        tqdm.write(clean(text), file=sys.stderr)
    else:
        print(clean(text), file=sys.stderr)
    sys.stderr.flush()


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
