"""Reads the files of other recorders: npz, JSON, CSV, episodes of LeRobot data sets (Parquet), MCAP and ROS 2 bags."""

from __future__ import annotations

import csv
import difflib
import json
import re
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.bags import read_bag
from sim2real.log.cells import MISSING, OTHER, NoNumbers, from_words, is_number, number_in

if TYPE_CHECKING:
    import numpy.typing as npt

SUFFIXES = {".npz": "npz", ".json": "json", ".csv": "csv", ".parquet": "lerobot", ".mcap": "mcap"}
"""File suffix -> format, used unless a format is given."""
_COLUMNS = re.compile(r"(.+)\[\s*:\s*,\s*(-?\d+|-?\d*\s*:\s*-?\d*)\s*\]")
# What the libraries raise for damaged content.
_DAMAGED = (OSError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)
_WHOLE = "check that the file is complete, and of the format that its name or --format says"


@dataclass(frozen=True)
class ForeignFile:
    """An open file of another recorder.

    Attributes:
        path: The file.
        format: One of the values of ``SUFFIXES``.
        keys: Names of its signals.
        load: Returns a signal by name; raises KeyError if there is none.
        columns: Names of a signal's columns, where the file has some.
        beside: Further files of the same recording.
    """

    path: Path
    format: str
    keys: Sequence[str]
    load: Callable[[str], Any]
    columns: Mapping[str, Sequence[str]] = field(default_factory=dict)
    beside: tuple[Path, ...] = ()

    def signal(self, source: str, column: int | None = None) -> np.ndarray:
        """Return a signal.

        Args:
            source: Its name; in a JSON file the path to it (``meta.kp``, ``entries[].position``). ``[:,0]`` or
                ``[:,1:3]`` after the name selects columns.
            column: Column of a two-dimensional signal; None: all columns.

        Returns:
            Shape ``(N,)`` or ``(N, ...)``, or ``()`` for a single number: float64, float32, or int64 for integers.

        Raises:
            UsageError: When there is no such signal or column, or it does not consist of numbers.
        """
        chosen: int | slice | None = column
        match = None if source in self.keys else _COLUMNS.fullmatch(source)
        name = source
        if match is not None:
            name, chosen = match[1], _index(match[2])
        try:
            raw = self.load(name)
        except KeyError:
            close = difflib.get_close_matches(name, self.keys, n=1)
            raise UsageError(
                f"{self.path} has no {name!r}. Available: {', '.join(self.keys) or 'nothing'}",
                hint=f"did you mean {close[0]}?" if close else "correct the source in the mapping",
            ) from None
        except UsageError:
            raise
        except _DAMAGED as error:
            raise UsageError(f"{name!r} in {self.path} is damaged: {error}", hint=_WHOLE) from None
        values = _numbers(raw, f"{name!r} in {self.path}")
        if chosen is None:
            return values
        try:
            return values[:, chosen]
        except IndexError:
            raise UsageError(
                f"{name!r} in {self.path} has the shape {values.shape}, which has no column {chosen}",
                hint="columns are counted from 0",
            ) from None


def open_foreign(path: Path, format: str | None = None) -> ForeignFile:
    """Open a file of another recorder.

    Args:
        path: The file.
        format: One of the values of ``SUFFIXES``; None: chosen by the file's suffix.

    Raises:
        UsageError: When the file does not exist, is empty, or does not have this format.
    """
    formats = ", ".join(_READERS)
    if format is None and not path.is_dir():
        format = SUFFIXES.get(path.suffix.lower())
        if format is None:
            raise UsageError(
                f"the format of {path} is unknown: no suffix {path.suffix!r}. Available: {', '.join(SUFFIXES)}",
                hint=f"name it with --format: {formats}",
            )
    if format not in (*_READERS, None):
        raise UsageError(f"unknown format {format!r}. Available: {formats}", hint="save the file as one of these")
    if path.is_dir() and (path / "metadata.yaml").is_file():
        path, format = _bag_file(path), "mcap"
    if path.is_dir():
        hint = "name the files in it; of a LeRobot data set: DIR/data/chunk-*/episode_*.parquet"
        raise UsageError(f"{path} is a folder, not a file", hint=hint)
    try:
        if path.stat().st_size == 0:
            raise UsageError(f"{path} is empty", hint=_WHOLE)
        return _READERS[str(format)](path)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror or error}", hint="check its name") from None


def _bag_file(folder: Path) -> Path:
    """Return the only MCAP file of a ROS 2 bag's folder."""
    found = sorted(folder.glob("*.mcap"))
    if len(found) != 1:
        other = sorted(folder.glob("*.db3"))
        hint = "`ros2 bag convert` makes MCAP of it" if other else "name one of its files"
        raise UsageError(f"{folder} holds {len(found)} MCAP files, and {len(other)} of SQLite", hint=hint)
    return found[0]


def _read_npz(path: Path) -> ForeignFile:
    # numpy would try to read anything but a ZIP archive as a pickle.
    if not zipfile.is_zipfile(path):
        raise UsageError(f"{path} is no npz file, or is cut off", hint=_WHOLE)

    def load(name: str) -> Any:
        # Opened again for each signal, so that one with Python objects does not prevent reading the others.
        try:
            with np.load(path, allow_pickle=False) as data:
                return data[name]
        except ValueError as error:
            if "pickle" not in str(error):
                raise
            raise UsageError(
                f"{name!r} in {path} holds Python objects, which could run any code when loaded",
                hint="save it again as an array of numbers",
            ) from None

    try:
        with zipfile.ZipFile(path) as archive:
            keys = [name.removesuffix(".npy") for name in archive.namelist()]
    except _DAMAGED as error:
        raise UsageError(f"{path} is no npz file, or is damaged: {error}", hint=_WHOLE) from None
    return ForeignFile(path, "npz", keys, load)


def _read_json(path: Path) -> ForeignFile:
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        keys = _paths(document)
    except (ValueError, RecursionError) as error:  # a decoder's errors are ValueErrors
        raise UsageError(f"{path} is no JSON, or is cut off: {error}", hint=_WHOLE) from None
    if not isinstance(document, dict | list):
        raise UsageError(f"{path} holds a single value, no signals", hint=_WHOLE)

    def load(name: str) -> Any:
        if isinstance(document, dict) and name in document:
            return document[name]
        return _walk(document, [p for p in re.split(r"\.|(?=\[\])", name) if p], path)

    return ForeignFile(path, "json", keys, load)


def _read_csv(path: Path) -> ForeignFile:
    try:
        text = path.read_text(encoding="utf-8-sig")
        first = text.partition("\n")[0]
        lines = csv.reader(text.splitlines(), delimiter=max(",;\t", key=first.count), skipinitialspace=True)
        rows = [(lines.line_num, row) for row in lines if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path} is no CSV: {error}", hint=_WHOLE) from None
    if not rows:
        raise UsageError(f"{path} is empty", hint=_WHOLE)
    header = [name.strip() for name in rows.pop(0)[1]]
    # A comma at the end of lines is no column.
    while header and not header[-1] and all(len(row) < len(header) for _, row in rows):
        header.pop()
    rows = [(n, row if "".join(row[len(header) :]).strip() else row[: len(header)]) for n, row in rows]
    if twice := {name for name in header if name and header.count(name) > 1}:
        raise UsageError(f"{path} has more than one column {sorted(twice)[0]!r}", hint="rename one of them")
    if all(is_number(name) for name in header):
        raise UsageError(f"the first line of {path} holds numbers, not names", hint="put the columns' names there")
    for number, row in rows:
        if len(row) != len(header):
            raise UsageError(f"line {number} of {path} has {len(row)} cells, the first has {len(header)}", hint=_WHOLE)

    def load(name: str) -> Any:
        if name not in header:
            raise KeyError(name)
        index = header.index(name)
        if rows and rows[0][1][index].startswith("["):
            return [_list(row[index], f"line {n} of {path}, column {name!r}") for n, row in rows]
        try:
            return np.array([int(row[index]) for _, row in rows], np.int64)
        except (ValueError, OverflowError):
            cells = [row[index].strip() for _, row in rows]
        if not any(is_number(cell) or cell.lower() in MISSING for cell in cells):
            raise NoNumbers(f"column {name!r} of {path} holds no numbers: {cells[0]!r}", hint=OTHER)
        return np.array(
            [number_in(c, f"line {n} of {path}, column {name!r}") for (n, _), c in zip(rows, cells, strict=True)]
        )

    return ForeignFile(path, "csv", [name for name in header if name], load)


def _read_lerobot(path: Path) -> ForeignFile:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise UsageError(
            f"{path} is a Parquet file, which needs pyarrow", hint="pip install 'sim2real[parquet]'"
        ) from None
    try:
        file = pyarrow.parquet.ParquetFile(path)
    except (pyarrow.ArrowException, *_DAMAGED) as error:
        raise UsageError(f"{path} is no Parquet file, or is cut off: {error}", hint=_WHOLE) from None
    columns = list(file.schema_arrow.names)
    # For DIR/data/chunk-000/episode_000000.parquet, DIR/meta/info.json has what all episodes share.
    infos = [folder / "meta" / "info.json" for folder in path.absolute().parents[2:3]]
    facts = [_read_json(info) for info in infos if info.is_file()]

    def load(name: str) -> Any:
        if name not in columns:
            if not facts:
                raise KeyError(name)
            return facts[0].load(name)
        return file.read(columns=[name]).column(0).to_pylist()

    named = _feature_names(infos[0]) if facts else {}
    found = ForeignFile(path, "lerobot", [*columns, *(["fps"] if facts else [])], load, named)
    if "episode_index" in columns and len(np.unique(found.signal("episode_index"))) > 1:
        raise UsageError(
            f"{path} holds more than one episode", hint="import data sets of LeRobot v2, where a file is an episode"
        )
    return found


def _feature_names(info: Path) -> dict[str, list[str]]:
    """Return the names of the entries of a LeRobot data set's columns, as ``meta/info.json`` has them."""
    found = {}
    for key, feature in json.loads(info.read_text(encoding="utf-8")).get("features", {}).items():
        names = feature.get("names") if isinstance(feature, dict) else None
        names = next(iter(names.values())) if isinstance(names, dict) and len(names) == 1 else names
        if isinstance(names, list) and all(isinstance(n, str) for n in names):
            found[key] = names
    return found


def _read_mcap(path: Path) -> ForeignFile:
    keys, load, columns = read_bag(path)
    return ForeignFile(path, "mcap", keys, load, columns)


def joined(files: Sequence[ForeignFile]) -> ForeignFile:
    """Return several files of one recording as one, whose signals are named ``STEM/NAME``.

    Raises:
        UsageError: When two files have the same name.
    """
    own = {f.path.stem: f for f in files}
    if len(own) < len(files):
        raise UsageError("files of one log need different names: their signals go by them", hint="rename one")

    def split(name: str) -> tuple[ForeignFile, str]:
        stem, _, rest = name.partition("/")
        if stem not in own:
            raise KeyError(name)
        return own[stem], rest

    def load(name: str) -> Any:
        file, rest = split(name)
        return file.load(rest)

    keys = [f"{stem}/{key}" for stem, file in own.items() for key in file.keys]
    columns = {f"{stem}/{key}": names for stem, file in own.items() for key, names in file.columns.items()}
    return ForeignFile(files[0].path, files[0].format, keys, load, columns, tuple(f.path for f in files[1:]))


_READERS: dict[str, Callable[[Path], ForeignFile]] = {
    "npz": _read_npz,
    "json": _read_json,
    "csv": _read_csv,
    "lerobot": _read_lerobot,
    "mcap": _read_mcap,
}


def _numbers(raw: npt.ArrayLike, what: str) -> np.ndarray:
    """Return a value as an array of float64, float32 or int64."""
    try:
        values = np.asarray(raw)
        if values.dtype == object:  # JSON and Parquet have None for a missing value, which becomes NaN
            values = np.asarray(raw, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{what} is no array of numbers", hint="all samples must be numbers, in one shape") from None
    if values.dtype.kind in "US":
        values = from_words(values, what)
    if values.dtype.kind in "iu" and not (values.size and values.max() > np.iinfo(np.int64).max):
        return values.astype(np.int64)
    if values.dtype.kind not in "fiub":
        raise NoNumbers(f"{what} holds no numbers, but {values.dtype}", hint=OTHER)
    return values if values.dtype == np.float32 else values.astype(np.float64)


def _index(text: str) -> int | slice:
    if ":" not in text:
        return int(text)
    return slice(*(int(part) if part.strip() else None for part in text.split(":")))


def _walk(value: object, parts: Sequence[str], path: Path) -> Any:
    """Return the value at a path in a JSON document; ``[]`` collects it from all elements of a list."""
    if not parts:
        return value
    head, rest = parts[0], parts[1:]
    if head == "[]" and isinstance(value, list):
        found = []
        for i, item in enumerate(value):
            try:
                found.append(_walk(item, rest, path))
            except KeyError:
                if not i:
                    raise
                raise UsageError(
                    f"element {i} of a list in {path} has no {'.'.join(rest)!r}, unlike those before it", hint=_WHOLE
                ) from None
        return found
    if isinstance(value, dict) and head in value:
        return _walk(value[head], rest, path)
    raise KeyError(head)


def _paths(value: object, trail: str = "") -> list[str]:
    """Return the paths to all values of a JSON document; for a list of objects, those of the first object."""
    if isinstance(value, dict):
        return [p for key, item in value.items() for p in _paths(item, f"{trail}.{key}".lstrip("."))]
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return _paths(value[0], f"{trail}[]")
    return [trail] if trail else []


def _list(text: str, where: str) -> Any:
    """Return the list in a CSV cell, as ``[0.1, 0.2]`` or ``[0.1 0.2]``."""
    try:
        return json.loads(text) if "," in text else [float(x) for x in text.strip("[] ").split()]
    except ValueError:
        raise UsageError(f"{where} holds {text!r}, no list of numbers", hint=_WHOLE) from None
