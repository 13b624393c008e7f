"""Reads files of other recorders as tables: npz, JSON and CSV; bags.py and lerobot.py read the other formats."""

from __future__ import annotations

import csv
import difflib
import io
import json
import re
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.names import is_unit
from sim2real.types import Json

_NULL = frozenset(("", "nan", "null", "none", "n/a", "na", "nil", "-", "--", "?"))
_BOOL = {"true": 1.0, "false": 0.0}
_DATE = re.compile(r"(\d{4}-\d\d-\d\d[T ])?\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?")
_COMMENT = re.compile(r"\s*(#|%|//)+\s*")
_WHOLE = "check that the file is complete"
_DAMAGED = (OSError, ValueError, EOFError, LookupError, MemoryError, RuntimeError, zipfile.BadZipFile, zlib.error)
_PICKLE = "a Python pickle, which could run code", "np.savez in the program that wrote it"
_ECHO = (
    "text of `rostopic echo`",
    "rostopic echo -p TOPIC > run.csv, or in ROS 2 a bag: ros2 bag record -s mcap TOPIC",
)
_PAGE = "a web page", "download the file itself"
_OTHERS = {
    b"SQLite format 3\0": (
        "a SQLite bag (.db3)", "ros2 bag convert -i BAG -o out.yaml, with storage_id: mcap in out.yaml"
    ),
    b"#ROSBAG V": (
        "a ROS 1 bag", "rosbags-convert --src run.bag --dst run --dst-storage mcap (pip install rosbags)"
    ),
    b"\x28\xb5\x2f\xfd": ("compressed by zstd", "zstd -d FILE"),
    b"\x1f\x8b": ("compressed by gzip", "gunzip FILE"),
    b"\x89HDF": ("HDF5", "h5py: np.savez('run.npz', **{k: f[k][()] for k in f})"),
    b"MATLAB 5.0": ("a MATLAB file", "scipy: np.savez('run.npz', **scipy.io.loadmat(FILE))"),
    b"MATLAB 7.3": ("a MATLAB file", "MATLAB: save('run.mat', '-v7'), then scipy.io.loadmat and np.savez"),
    b"ULog\x01": ("a PX4 log", "ulog2csv FILE (pip install pyulog)"),
    b"\x93NUMPY": ("a single array without names", "numpy: np.savez('run.npz', t_s=..., q_rad=..., goal_rad=...)"),
    b"MDF ": ("a measurement file (MDF)", "asammdf: MDF(FILE).export('csv', 'run.csv')"),
    b"TDSm": ("a LabVIEW file (TDMS)", "nptdms: TdmsFile.read(FILE).as_dataframe().to_csv('run.csv')"),
    b"BZh": ("compressed by bzip2", "bunzip2 FILE"),
    b"\xfd7zXZ": ("compressed by xz", "unxz FILE"),
    b"header:\n": _ECHO,
    b"layout:\n": _ECHO,
    b"version https://git-lfs": ("a pointer of Git LFS, not the file", "git lfs pull"),
    b"<!DOCTYPE": _PAGE,
    b"<html": _PAGE,
    b"ARROW1": ("an Arrow file", "pandas: pd.read_feather(FILE).to_csv('run.csv', index=False)"),
    b"\x80\x02": _PICKLE,
    b"\x80\x03": _PICKLE,
    b"\x80\x04": _PICKLE,
    b"\x80\x05": _PICKLE,
}  # fmt: skip
"""First bytes -> name of the file format, and the command that converts it."""


@dataclass
class Table:
    """The signals of a recording.

    Attributes:
        path: The file or folder.
        format: ``npz``, ``json``, ``csv``, ``mcap`` or ``lerobot``.
        columns: Name -> values, shape ``(N, ...)``, or ``()`` for a constant: float64, float32 or int64.
        words: Name -> texts, of a signal of words.
        names: Name of a signal with two dimensions -> names of its columns.
        broken: Name -> why the signal cannot be read.
        notes: Sentences on parts that were left out.
        nominal: Names of stamps that were computed from a rate.
        robot: Robot type of a LeRobot data set.
        beside: Further files of the same recording.
        stems: Prefixes ``STEM/`` of signals, if they come from several files.
    """

    path: Path
    format: str
    columns: dict[str, np.ndarray] = field(default_factory=dict)
    words: dict[str, list[str]] = field(default_factory=dict)
    names: dict[str, list[str]] = field(default_factory=dict)
    broken: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    nominal: set[str] = field(default_factory=set)
    robot: str = ""
    beside: tuple[Path, ...] = ()
    stems: tuple[str, ...] = ()

    @property
    def keys(self) -> list[str]:
        """Names of all signals."""
        return [*self.columns, *self.words, *self.broken]

    def cut(self, samples: slice) -> Table:
        """Return a range of samples of all signals with the greatest length."""
        longest = max((len(v) for v in self.columns.values() if v.ndim), default=0)
        columns = {n: v[samples] if v.ndim and len(v) == longest else v for n, v in self.columns.items()}
        return replace(self, columns=columns)

    def add(self, name: str, raw: object) -> None:
        """Add a signal: an array of numbers, dates or words."""
        try:
            values = np.asarray(raw)
            if values.dtype == object:
                values = np.asarray(raw, np.float64)  # JSON has None for a missing number
        except (TypeError, ValueError, OverflowError):
            flat = raw if isinstance(raw, list | np.ndarray) else [raw]
            if all(v is None or isinstance(v, str) for v in flat):
                self.add_texts(name, ["" if v is None else str(v) for v in flat])
            else:
                self.broken[name] = "its samples are not numbers of one shape"
            return
        kind = values.dtype.kind
        if kind == "U" and values.ndim <= 1:
            self.add_texts(name, [str(v) for v in np.atleast_1d(values)])
        elif kind in "Mm":
            nanoseconds = values.astype(f"{kind}8[ns]").astype(np.int64)
            self.columns[name] = (
                np.where(np.isnat(values), np.nan, nanoseconds) if np.isnat(values).any() else nanoseconds
            )
        elif kind in "iu" and not (values.size and values.max() > np.iinfo(np.int64).max):
            self.columns[name] = values.astype(np.int64)  # integers: float64 would round stamps in nanoseconds
        elif kind in "fiub":
            self.columns[name] = values if values.dtype == np.float32 else values.astype(np.float64)
        else:
            self.broken[name] = f"it holds no numbers, but {values.dtype}"

    def add_texts(self, name: str, texts: list[str], lines: Sequence[int] = ()) -> None:
        """Add a signal written as text: numbers, dates or words, at these lines of a file."""
        column = numbers(texts)
        if isinstance(column, str):
            where = f"line {lines[texts.index(column)]}" if lines else "it"
            self.broken[name] = f"{where} has the word {column!r} among its numbers"
        elif column is None:
            self.words[name] = texts
        else:
            self.columns[name] = column

    def signal(self, source: str) -> np.ndarray:
        """Return a signal.

        Args:
            source: Name; ``[:,0]`` or ``[:,1:3]`` after the name selects columns.

        Raises:
            UsageError: The signal or column does not exist, or has values that are no numbers.
        """
        name, chosen = source, None
        match = re.fullmatch(r"(.+)\[\s*:\s*,\s*(-?\d+|-?\d*\s*:\s*-?\d*)\s*\]", source)
        if source not in self.columns and match:
            name = match[1]
            parts = [int(part) if part.strip() else None for part in match[2].split(":")]
            chosen = slice(*parts) if len(parts) > 1 else parts[0]
        if name not in self.columns:
            if name in self.broken or name in self.words:
                raise UsageError(
                    f"{name!r} in {self.path} cannot be read: {self.broken.get(name, 'it holds words')}",
                    hint="correct the file, or choose another source in the mapping",
                )
            close = difflib.get_close_matches(name, self.columns, n=1)
            raise UsageError(
                f"{self.path} has no {name!r}. Available: {', '.join(self.keys[:100]) or 'nothing'}",
                hint=f"did you mean {close[0]}?" if close else "correct the source in the mapping",
            )
        values = self.columns[name]
        if chosen is None or match is None:
            return values
        # numpy would leave out columns that are not there.
        count = values.shape[1] if values.ndim > 1 else 0
        ends = [chosen.start, chosen.stop] if isinstance(chosen, slice) else [chosen if chosen < 0 else chosen + 1]
        if any(abs(end) > count for end in ends if end is not None) or not np.arange(count)[chosen].size:
            raise UsageError(
                f"{name!r} in {self.path} has the shape {values.shape}, which has no column {match[2]}",
                hint="columns are counted from 0",
            )
        return values[:, chosen]


def open_tables(path: Path, episode: int | None = None) -> list[Table]:
    """Read a file of another recorder, or the folder of a ROS 2 bag or a LeRobot data set.

    Args:
        episode: Number of an episode of a LeRobot data set; None: all of them.

    Returns:
        One table; for a LeRobot data set, one for each episode.

    Raises:
        UsageError: The file does not exist, or its content cannot be read; for a container, the error has the command
            that converts it.
    """
    from sim2real.log.importing import bags, lerobot  # imported late: they need their packages

    if path.is_dir():
        return lerobot.read_lerobot(path, episode) if (path / lerobot.INFO).is_file() else [bags.read_bag(path)]
    if not path.is_file():
        why = "it is a pipe or a device" if path.exists() else "there is no such file"
        raise UsageError(f"cannot read {path}: {why}", hint="check its name")
    try:
        with path.open("rb") as stream:
            head = stream.read(1 << 12)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint="check its name") from None
    if head[:4] == b"PAR1":
        return lerobot.read_lerobot(path, episode)
    if episode is not None:
        raise UsageError(f"{path} is no data set of LeRobot: it has no episodes", hint="remove --episode")
    refuse_container(path, head)
    if not head:
        raise UsageError(f"{path} is empty", hint=_WHOLE)
    if head[:5] == b"\x89MCAP":
        return [bags.read_bag(path)]
    if head[:2] == b"PK":
        return [_read_npz(path)]
    if re.search(rb"[\0-\x08\x0e-\x1a]", head):
        odd, even = head[1::2].count(0), head[::2].count(0)
        is_utf_16 = head[:2] in (b"\xff\xfe", b"\xfe\xff") or (odd > len(head) // 4 and even < len(head) // 50)
        raise UsageError(
            f"{path} is {'UTF-16 text' if is_utf_16 else 'binary'}, which import does not read",
            hint="save it as UTF-8 CSV, JSON, npz, Parquet or MCAP",
        )
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:  # such as a degree sign in a Windows encoding
        text = data.decode("cp1252", errors="replace")
    return [_read_json(path, text) if text.lstrip()[:1] in ("{", "[") else _read_csv(path, text)]


def open_table(path: Path, episode: int | None = None) -> Table:
    """Read a file that holds one recording; see ``open_tables``."""
    tables = open_tables(path, episode)
    if len(tables) > 1:
        raise UsageError(f"{path} holds {len(tables)} episodes", hint=f"sim2real import {path} makes logs of them")
    return tables[0]


def refuse_container(path: Path, head: bytes) -> None:
    """Raise an error for a container that is not read, with the command that converts it."""
    for magic, (what, command) in _OTHERS.items():
        if head.startswith(magic):
            raise UsageError(f"{path} is {what}, which import does not read", hint=f"first: {command}")


def _read_npz(path: Path) -> Table:
    table = Table(path, "npz")
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name in arrays.files:
                try:
                    values = arrays[name]
                except _DAMAGED as error:
                    pickled = "it holds Python objects, which are never loaded"
                    table.broken[name] = pickled if "pickle" in str(error) else f"it is damaged ({error})"
                    continue
                if isinstance(values, bytes):
                    continue
                for column in values.dtype.names or ("",):
                    table.add(f"{name}.{column}" if column else name, values[column] if column else values)
    except _DAMAGED as error:
        raise UsageError(f"{path} is no npz, or is cut off: {error}", hint=_WHOLE) from None
    if not table.keys and arrays.files:
        is_book = any(name.startswith("xl/") for name in arrays.files)
        what = "an Excel workbook" if is_book else f"a zip archive of {', '.join(arrays.files[:5])}"
        raise UsageError(
            f"{path} is {what}, which import does not read",
            hint=f"first: {'save the sheet as CSV' if is_book else 'unzip it'}",
        )
    return table


def _read_json(path: Path, text: str) -> Table:
    table = Table(path, "json")
    try:
        try:
            document: Json = json.loads(text)
        except json.JSONDecodeError:
            document = [json.loads(line) for line in text.splitlines() if line.strip()]  # an object on each line
            if all(isinstance(row, dict) and {"topic", "log_time", "data"} <= row.keys() for row in document):
                from sim2real.log.importing import bags  # imported late: it needs a package

                return bags.read_messages(path, document)
        for name, value in _leaves({"": document} if isinstance(document, list) else document, path):
            table.add(name, value)
    except UsageError:
        raise
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path} is no JSON, is cut off, or nested too deeply: {error}", hint=_WHOLE) from None
    if not table.keys:
        raise UsageError(f"{path} holds no signals", hint=_WHOLE)
    return table


def _leaves(value: Json, path: Path, trail: str = "") -> Iterator[tuple[str, Json]]:
    """Yield path and value of all leaves; ``[]`` in a path stands for the objects of a list."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(item, path, f"{trail}.{key}".lstrip("."))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        rows = [dict(_leaves(item, path)) if isinstance(item, dict) else {} for item in value]
        for key in rows[0]:
            if (missing := next((i for i, row in enumerate(rows) if key not in row), None)) is not None:
                text = f"element {missing} of {trail or 'the list'} in {path} has no {key!r}, unlike those before it"
                raise UsageError(text, hint=_WHOLE)
            yield f"{trail}[].{key}", [row[key] for row in rows]
    elif trail:
        yield trail, value


def _read_csv(path: Path, text: str) -> Table:
    """Read a text with separators; the line before the first numbers has the names, even if it is a comment."""
    table = Table(path, "csv")
    lines = [(i, x) for i, x in enumerate(text.splitlines(), 1) if x.strip() and not re.fullmatch("sep=.", x.strip())]
    body = [(i, line) for i, line in lines if not _COMMENT.match(line)]
    separator = _separator([line for _, line in body[:50]])
    rows = [(i, _cells(line, separator)) for i, line in body]
    counts = Counter(len(cells) for _, cells in rows)
    width = counts.most_common(1)[0][0] if counts else 0
    # The data begin at the first row that has the usual width and a number.
    first = next((k for k, (_, c) in enumerate(rows) if len(c) == width and any(map(_is_number, c))), None)
    if first is None:
        raise UsageError(f"{path} holds no line of numbers", hint="it needs a line of names, then lines of numbers")
    data = rows[first:]
    begin = data[0][0]
    names, at = _names([(i, line) for i, line in lines if i < begin], separator, width)
    if why := _is_unclear(data, width, names is None, first > 0):
        raise UsageError(f"line {begin} of {path} {why}", hint="give each column a name in the line before the numbers")
    if names is None:
        table.notes.append(f"{path.name} has no line of names: its columns are numbered from 0")
        names = [str(i) for i in range(width)]
    elif skipped := [i for i, _ in lines if i < at]:
        table.notes.append(f"skipped: {len(skipped)} lines before the names in line {at}")
    if len(data) > 1 and (len(data[-1][1]) < width or not text.endswith(("\n", "\r"))):
        # A file that was cut may end within a number.
        table.notes.append(f"the last line of {path.name} has no end: it is left out")
        data = data[:-1]
    if wrong := next(((i, cells) for i, cells in data if len(cells) != width), None):
        raise UsageError(f"line {wrong[0]} of {path} has {len(wrong[1])} cells, line {begin} has {width}", hint=_WHOLE)
    columns = list(zip(*(cells for _, cells in data), strict=True))
    if len(names) > 1 and not names[-1] and not any(columns[-1]):  # each line ends with a separator
        names, columns = names[:-1], columns[:-1]
    names = [name or f"column {i}" for i, name in enumerate(names)]
    if twice := [name for name, n in Counter(names).items() if n > 1]:
        raise UsageError(f"more than one column of {path} is named {twice[0]!r}", hint="rename one of them")
    comma = separator != "," and any(re.fullmatch(r"[-+]?\d+,\d+(e[-+]?\d+)?", c.strip()) for c in data[0][1])
    for name, cells in zip(names, columns, strict=True):
        texts = [c.replace(",", ".") for c in cells] if comma else list(cells)
        table.add_texts(name, texts, [i for i, _ in data])
    return table


def _is_unclear(data: Sequence[tuple[int, list[str]]], width: int, is_nameless: bool, has_words: bool) -> str:
    """Return why it is unclear whether the first row has names or a sample; empty if it is clear."""
    first, below = data[0][1], [cells for _, cells in data[1:20] if len(cells) == width]
    for i, cell in enumerate(first):
        # A word above numbers is a name; above words, it may be a value.
        is_word = not _is_number(cell) and cell.strip().lower() not in _NULL
        if is_word and below and all(_is_number(cells[i]) for cells in below):
            return f"mixes numbers with {cell.strip()!r}, above numbers: is it a line of names, or a damaged sample?"
    counting = [str(i) for i in range(width)]
    if is_nameless and has_words:
        return f"begins {width} columns of numbers, and the line before it has other names"
    if is_nameless and width > 1 and [c.strip() for c in first] in (counting, ["", *counting[:-1]]):
        return "counts its columns: is it a line of names, or a sample?"
    return ""


def _names(above: Sequence[tuple[int, str]], separator: str | None, width: int) -> tuple[list[str] | None, int]:
    """Return the names of the columns (None without names), and the number of their line.

    Below the names there may be a line of units; above names that repeat, a line of names of groups.
    """
    below, at = list[str](), 0
    for i, line in reversed(above):
        text = _COMMENT.sub("", line, count=1) if _COMMENT.match(line) else line
        # The line of names may have another separator than the numbers.
        split = [[c.strip() for c in _cells(text, by)] for by in (separator, ",", None)]
        cells = next((cells for cells in split if len(cells) == width and any(cells)), None)
        if cells is not None and below:
            return [f"{upper} {lower}".strip() for upper, lower in zip(cells, below, strict=True)], i
        if cells is not None:
            if len({*cells}) == width > 1 and not all(map(is_unit, cells)):
                return cells, i
            below, at = cells, i
        elif not _COMMENT.match(line):  # a line of another width is text: no names stand above it
            break
    return below or None, at


def numbers(texts: Sequence[str]) -> np.ndarray | str | None:
    """Convert texts to numbers, and dates to nanoseconds since 1970; return a word among numbers; None for words."""
    for kind in (int, float):
        try:
            return np.array([kind(t) for t in texts], np.int64 if kind is int else np.float64)
        except (ValueError, OverflowError):
            pass
    stripped = [t.strip().lower() for t in texts]
    is_date = _DATE.fullmatch(next((t.strip() for t in texts if t.strip().lower() not in _NULL), ""))
    values, words = [], []
    for text, word in zip(texts, stripped, strict=True):
        try:
            if is_date:
                values.append(_nanoseconds(text.strip()))
            else:
                values.append(np.nan if word in _NULL else _BOOL[word] if word in _BOOL else float(word))
        except ValueError:
            words.append(text)
    if not words:
        return np.array(values)
    return words[0] if is_date or np.isfinite(values).any() else None


def _nanoseconds(text: str) -> int:
    """Return a date as nanoseconds since 1970; without a zone it is in UTC."""
    moment = datetime.fromisoformat(text if "-" in text[:5] else f"1970-01-01T{text}")
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime(1970, 1, 1, tzinfo=UTC)
    return ((since.days * 86400 + since.seconds) * 1_000_000 + since.microseconds) * 1000


def _is_number(cell: str) -> bool:
    try:
        return np.isfinite(float(cell.strip().replace(",", ".")))
    except ValueError:
        return False


def _separator(lines: Sequence[str]) -> str | None:
    """Return the separator that splits most lines into the same number of cells; None: blanks."""
    best: tuple[int, str | None] = (0, None)
    for separator in (";", "\t", "|", ","):
        counts = Counter(len(_cells(line, separator)) for line in lines)
        (width, times), *_ = counts.most_common(1) or [(1, 0)]
        if width > 1 and times > best[0]:
            best = times, separator
    return best[1] if best[0] > len(lines) // 2 else None


def _cells(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    return next(csv.reader(io.StringIO(line), delimiter=separator, skipinitialspace=True), [])


def joined(tables: Sequence[Table]) -> Table:
    """Join several files of one recording to one table, whose signals are named ``STEM/NAME``.

    Raises:
        UsageError: Two files have the same name.
    """
    if len({t.path.stem for t in tables}) < len(tables):
        raise UsageError(
            "the files of one log need different names, which are part of the signals' names", hint="rename one"
        )
    whole = Table(tables[0].path, tables[0].format, robot=tables[0].robot)
    for table in tables:
        for part in ("columns", "words", "names", "broken"):
            getattr(whole, part).update({f"{table.path.stem}/{k}": v for k, v in getattr(table, part).items()})
        whole.nominal |= {f"{table.path.stem}/{name}" for name in table.nominal}
        whole.notes += table.notes
    whole.beside = tuple(path for t in tables for path in (t.path, *t.beside))[1:]
    whole.stems = tuple(f"{t.path.stem}/" for t in tables)
    return whole
