"""Reads the files of other recorders: npz, JSON, CSV, episodes of LeRobot data sets (Parquet), MCAP and ROS 2 bags."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.files import dates, lerobot
from sim2real.log.importing.files.arrays import DAMAGED, read_npz
from sim2real.log.importing.files.bags import bag_files, read_bag
from sim2real.log.importing.files.budget import (
    MAX_COLUMNS,
    MAX_LEVELS,
    MAX_TEXT_BYTES,
    WHOLE,
    require_signals,
    require_size,
)
from sim2real.log.importing.files.cells import OTHER, NoNumbersError, from_words
from sim2real.log.importing.files.raw_file import RawSignals
from sim2real.log.importing.files.tables import encoding_of, read_csv
from sim2real.log.importing.signal_names import meaning
from sim2real.types import Json

if TYPE_CHECKING:
    import numpy.typing as npt

SUFFIXES = {".npz": "npz", ".json": "json", ".csv": "csv", ".parquet": "lerobot", ".mcap": "mcap"}
"""File suffix -> format, used unless a format is given."""
_COLUMNS = re.compile(r"(.+)\[\s*:\s*,\s*(-?\d+|-?\d*\s*:\s*-?\d*)\s*\]")


@dataclass(frozen=True, kw_only=True)
class ForeignFile(RawSignals):
    """An open file of another recorder, with its signals.

    Attributes:
        path: The file.
        format: One of the values of ``SUFFIXES``.
        beside: Further files of the same recording.
    """

    path: Path
    format: str
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
            UsageError: When the signal or column does not exist, or holds other values than numbers.
        """
        # Split the name into signal and columns, unless the file has a signal of the whole name.
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
                f"{self.path} has no {name!r}. Available: {', '.join(self.keys[:100]) or 'nothing'}",
                hint=f"did you mean {close[0]}?" if close else "correct the source in the mapping",
            ) from None
        except UsageError:
            raise
        except DAMAGED as error:
            raise UsageError(f"{name!r} in {self.path} is damaged: {error}", hint=WHOLE) from None
        # Convert to numbers, then select the columns.
        values = _numbers(raw, f"{name!r} in {self.path}", meaning(name).unit)
        if chosen is None:
            if values.ndim == 2 and values.shape[1] > MAX_COLUMNS:
                raise UsageError(
                    f"{name!r} in {self.path} has {values.shape[1]} columns, as images have; at most {MAX_COLUMNS} "
                    "are read",
                    hint=f"choose some: {name}[:,0:6]",
                )
            return values
        try:
            return values[:, chosen]
        except IndexError:
            raise UsageError(
                f"{name!r} in {self.path} has the shape {values.shape}, which has no column {chosen}",
                hint="columns are counted from 0",
            ) from None


def open_foreign(path: Path, format: str | None = None, episode: int | None = None) -> ForeignFile:
    """Open a file of another recorder, the folder of a ROS 2 bag, or that of a LeRobot data set.

    Args:
        path: The file or folder.
        format: One of the values of ``SUFFIXES``; None: chosen by the file's suffix.
        episode: Number of the episode of a LeRobot data set; None: the only one.

    Raises:
        UsageError: When the file does not exist, is empty, or has another format.
    """
    formats = ", ".join(_FORMATS)
    files = [path]
    # Choose the format: a folder by its content, a file by its suffix.
    if path.is_dir() and (path / lerobot.INFO).is_file():
        files, format = lerobot.files_of(path, episode), "lerobot"
    elif path.is_dir():
        files, format = bag_files(path), "mcap"
    elif format is None:
        format = SUFFIXES.get(path.suffix.lower())
        if format is None:
            raise UsageError(
                f"the format of {path} is unknown: no suffix {path.suffix!r}. Available: {', '.join(SUFFIXES)}",
                hint=f"name it with --format: {formats}",
            )
    if format not in _FORMATS:
        raise UsageError(f"unknown format {format!r}. Available: {formats}", hint="save the file as one of these")
    if episode is not None and format != "lerobot":
        raise UsageError(f"{path} is no data set of LeRobot: it has no episodes", hint="remove --episode")
    # Check the files before their readers open them, so that errors name the cause.
    try:
        if not path.is_dir() and not path.is_file():
            why = "it is a pipe or a device" if path.exists() else "there is no such file"
            raise UsageError(f"cannot read {path}: {why}", hint="check its name")
        if not all(part.stat().st_size for part in files):
            raise UsageError(f"{next(p for p in files if not p.stat().st_size)} is empty", hint=WHOLE)
        if format == "lerobot":
            raw = lerobot.read_lerobot(path, episode)
        else:
            raw = read_bag(files) if format == "mcap" else _READERS[format](path)
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror or error}", hint="check its name") from None
    return ForeignFile(**vars(raw), path=files[0], format=format, beside=tuple(files[1:]))


def _read_json(path: Path) -> RawSignals:
    # Check the size before parsing, as the parsed document takes ten times the memory.
    require_size(path, MAX_TEXT_BYTES)
    encoding = encoding_of(path, "JSON")
    try:
        document = json.loads(path.read_text(encoding=encoding))
        keys = _paths(document)
    except (ValueError, RecursionError) as error:  # a decoder's errors are ValueErrors
        if isinstance(error, UsageError):
            raise
        deep = f"it is nested deeper than {MAX_LEVELS} levels"
        why = deep if isinstance(error, RecursionError) else error
        raise UsageError(f"{path} is no JSON, or is cut off: {why}", hint=WHOLE) from None
    if not isinstance(document, dict | list):
        raise UsageError(f"{path} holds a single value, no signals", hint=WHOLE)
    require_signals(len(keys), path)

    # A name is a key, or a path with dots and brackets.
    def load(name: str) -> Json:
        if isinstance(document, dict) and name in document:
            return document[name]
        return _walk(document, [p for p in re.split(r"\.|(?=\[\])", name) if p], path)

    return RawSignals(keys, load, notes=(f"{path.name} is no UTF-8: it is read as latin-1",) * (encoding == "latin-1"))


def joined(files: Sequence[ForeignFile]) -> ForeignFile:
    """Return several files of one recording as one, whose signals are named ``STEM/NAME``.

    Raises:
        UsageError: When two files have the same name.
    """
    by_stem = {f.path.stem: f for f in files}
    if len(by_stem) < len(files):
        raise UsageError(
            "the files of one log need different names, which are part of the signals' names", hint="rename one"
        )

    def split(name: str) -> tuple[ForeignFile, str]:
        stem, _, rest = name.partition("/")
        if stem not in by_stem:
            raise KeyError(name)
        return by_stem[stem], rest

    def load(name: str) -> Json:
        file, rest = split(name)
        return file.load(rest)

    # The joined file has the signals of all files, with the stem before each name.
    keys = [f"{stem}/{key}" for stem, file in by_stem.items() for key in file.keys]
    columns = {f"{stem}/{key}": names for stem, file in by_stem.items() for key, names in file.columns.items()}
    beside = tuple(path for f in files for path in (f.path, *f.beside))[1:]
    notes = tuple(note for f in files for note in f.notes)
    nominal = frozenset(f"{stem}/{name}" for stem, file in by_stem.items() for name in file.nominal)
    first = files[0]
    signals = RawSignals(keys, load, columns, notes, nominal, first.facts)
    return ForeignFile(**vars(signals), path=first.path, format=first.format, beside=beside)


_READERS: dict[str, Callable[[Path], RawSignals]] = {"npz": read_npz, "json": _read_json, "csv": read_csv}
_FORMATS = (*_READERS, "lerobot", "mcap")


def _numbers(raw: npt.ArrayLike, what: str, unit: str) -> np.ndarray:
    """Return a value as an array of float64, float32 or int64; dates as nanoseconds since 1970, or in ``unit``."""
    try:
        # Dates become nanoseconds; words and missing values become numbers or NaN.
        values = np.asarray(raw)
        if (
            values.dtype.kind in "UO"
            and values.ndim == 1
            and dates.are_dates([v for v in values[:1] if isinstance(v, str)])
        ):
            values = dates.parsed([str(v) for v in values], unit if unit in ("s", "ms", "us", "ns") else "")
        elif values.dtype.kind in "Mm":
            missing, values = np.isnat(values), values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64)
            values = np.where(missing, np.nan, values) if missing.any() else values
        if values.dtype == object and values.ndim == 1 and any(isinstance(v, str) for v in values):
            values = np.array(["" if v is None else v for v in values], dtype=str)  # words among numbers
        elif values.dtype == object:  # JSON and Parquet have None for a missing value, which becomes NaN
            values = np.asarray(raw, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{what} is no array of numbers", hint="all samples must be numbers, in one shape") from None
    if values.dtype.kind in "US":
        values = from_words(values, what)
    # Keep integers exact, as float64 would round stamps in nanoseconds.
    if values.dtype.kind in "iu" and not (values.size and values.max() > np.iinfo(np.int64).max):
        return values.astype(np.int64)
    if values.dtype.kind not in "fiub":
        raise NoNumbersError(f"{what} holds no numbers, but {values.dtype}", hint=OTHER)
    return values if values.dtype == np.float32 else values.astype(np.float64)


def _index(text: str) -> int | slice:
    if ":" not in text:
        return int(text)
    return slice(*(int(part) if part.strip() else None for part in text.split(":")))


def _walk(value: object, parts: Sequence[str], path: Path) -> Json:
    """Return the value at a path in a JSON document; ``[]`` collects the value of each element of a list."""
    if not parts:
        return value
    head, rest = parts[0], parts[1:]
    if head == "[]" and isinstance(value, list):
        values = []
        for i, item in enumerate(value):
            try:
                values.append(_walk(item, rest, path))
            except KeyError:
                if not i:
                    raise
                raise UsageError(
                    f"element {i} of a list in {path} has no {'.'.join(rest)!r}, unlike those before it", hint=WHOLE
                ) from None
        return values
    if isinstance(value, dict) and head in value:
        return _walk(value[head], rest, path)
    raise KeyError(head)


def _paths(value: object, trail: str = "", level: int = 0) -> list[str]:
    """Return the paths to all values of a JSON document; of a list of objects, the paths in the first object."""
    if level > MAX_LEVELS:
        raise ValueError(f"it is nested deeper than {MAX_LEVELS} levels")
    if isinstance(value, dict):
        return [p for key, item in value.items() for p in _paths(item, f"{trail}.{key}".lstrip("."), level + 1)]
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return _paths(value[0], f"{trail}[]", level + 1)
    return [trail] if trail else []
