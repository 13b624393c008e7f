"""JSON and array files of artifacts, read into typed dataclasses, with errors that name the file."""

from __future__ import annotations

import dataclasses
import math
import os
import zipfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec

from sim2real.errors import Sim2RealError
from sim2real.later import Later
from sim2real.types import Json

if TYPE_CHECKING:
    import numpy as np
else:
    np = Later("numpy")  # imported late: a manifest, which `--help` of a stage reads, has no arrays

T = TypeVar("T")

_FOREIGN = (ValueError, KeyError, TypeError, AttributeError, IndexError, OSError)
"""Exceptions that a malformed file may cause."""


@contextmanager
def malformed(path: Path, again: str) -> Iterator[None]:
    """Convert the exceptions that a malformed file causes to an error that names the file.

    Args:
        again: The hint of the error, such as the command that makes the file again.
    """
    try:
        yield
    except Sim2RealError:
        raise
    except _FOREIGN as error:
        reason = f"no entry {error}" if isinstance(error, KeyError) else str(error)
        if isinstance(error, OSError):
            raise Sim2RealError(f"cannot read {path}: {error.strerror or error}", hint=again) from error
        raise Sim2RealError(f"{path} is malformed: {reason}", hint=again) from error


def make_folder(folder: Path | str) -> Path:
    """Return a folder's path, and create the folder if it is missing."""
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    return path


def check(good: bool, reason: str) -> None:
    """Raise ValueError unless ``good``; inside ``malformed`` it becomes an error that names the file."""
    if not good:
        raise ValueError(reason)


def read_json(path: Path, kind: type[T]) -> T:
    """Return the document in a JSON file as a dataclass; unknown entries are ignored.

    Args:
        kind: A dataclass. Lists of numbers become arrays in fields that are arrays; null becomes NaN in numbers.

    Raises:
        ValueError: The file is no JSON, or an entry is missing or of another type; the message names the entry.
    """
    try:
        document = _numbers(kind, msgspec.json.decode(path.read_bytes()))
        return msgspec.convert(document, kind, dec_hook=_array)
    except msgspec.MsgspecError as error:
        raise ValueError(str(error)) from error


def read_versioned(path: Path, kind: type[T], again: str, *formats: int) -> T:
    """Return the document in a JSON file as ``read_json`` does.

    Raises:
        Sim2RealError: When the file is missing, malformed, or of none of the formats; ``again`` is the hint.
    """
    with malformed(path, again):
        document = read_json(path, kind)
    if (version := vars(document)["format"]) not in formats:
        raise Sim2RealError(f"{path} has format {version}, this version reads {formats[-1]}", hint=again)
    return document


def write_json(path: Path, document: object, without: Collection[str] = ()) -> None:
    """Write a document as JSON; a reader finds the old file or the new one, never a part.

    Args:
        document: A dataclass, or a dict of its fields; infinite numbers and NaN, which JSON lacks, become null.
        without: Names of fields of a dataclass that are stored in other files.

    Raises:
        Sim2RealError: A text is not valid Unicode, as names of files may be.
    """
    if without:
        document = {n: v for n, v in vars(document).items() if n not in without}
    text = to_json(document)
    with replacing(path) as stream:
        stream.write(text)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a stream whose bytes replace a file atomically when the block ends; after an error the file stays."""
    draft = path.with_name(f".{path.name}.tmp")
    try:
        # Overwrite reserved bytes, which needs no new space on a full disk, then cut the file to its length.
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT, 0o666), "wb") as stream:
            yield stream
            stream.truncate()
            stream.flush()
            os.fsync(stream.fileno())
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    os.replace(draft, path)


def to_json(document: object) -> bytes:
    """Return a document as JSON: dataclasses as objects, arrays as lists, infinite numbers and NaN as null.

    Raises:
        TypeError: A value has no form in JSON.
        Sim2RealError: A text is not valid Unicode.
    """
    try:
        return msgspec.json.format(msgspec.json.encode(document, enc_hook=_encoded), indent=1)
    except UnicodeEncodeError as error:
        raise Sim2RealError(f"{error.object!r} cannot be written: it has bytes that are no text") from None


def plain(value: object) -> Json:
    """Return a value as dicts, lists, texts, numbers and None, like a JSON file; see ``to_json``."""
    return msgspec.json.decode(to_json(value))


def _numbers(kind: Any, value: Json) -> Json:
    """Return a document with NaN for null in entries that are numbers."""
    inner = get_args(kind)
    # A null in the place of a number is NaN.
    if kind is float:
        return math.nan if value is None else value
    # For a union, take the first type that can hold the value.
    if isinstance(kind, UnionType) or get_origin(kind) is Union:
        fitting = [k for k in inner if k is not NoneType and (k is float) != isinstance(value, dict | list)]
        return value if value is None or not fitting else _numbers(fitting[0], value)
    # Convert the entries of dataclasses, dictionaries and lists by their types.
    if isinstance(value, dict):
        if dataclasses.is_dataclass(kind):
            hints = get_type_hints(kind)
            return {name: _numbers(hints.get(name), v) for name, v in value.items()}
        return {name: _numbers(inner[-1] if inner else None, v) for name, v in value.items()}
    if isinstance(value, list) and inner:
        kinds = [inner[0]] * len(value) if len(inner) == 1 or inner[-1] is Ellipsis else inner
        return [_numbers(k, v) for k, v in zip(kinds, value, strict=False)] + value[len(kinds) :]
    return value


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file.

    Raises:
        ValueError: It is no npz file.
        OSError: It cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (zipfile.BadZipFile, EOFError) as error:
        raise ValueError(str(error)) from error


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to a compressed npz file; a reader finds the old file or the new one, never a part.

    Raises:
        Sim2RealError: A name has a null character, at which a zip file would cut it off.
    """
    if invalid := [name for name in arrays if "\0" in name]:
        raise Sim2RealError(f"{path} cannot be written: the name {invalid[0]!r} has a null character")
    # numpy.savez_compressed would do the same, but cannot write an array called "file".
    with replacing(path) as stream, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(values), allow_pickle=False)


def _array(kind: type, value: Json) -> Json:
    if kind is not np.ndarray:
        raise NotImplementedError(f"no {kind.__name__} in a file")

    def flat(entry: Json) -> Json:
        return [flat(e) for e in entry] if isinstance(entry, list) else math.nan if entry is None else float(entry)

    return np.array(flat(value), np.float64)


def write_grouped(path: Path, document: object, kinds: Sequence[str]) -> None:
    """Write the fields of a dataclass that are dicts of arrays, as arrays ``FIELD/NAME`` of one npz file."""
    write_arrays(path, {f"{kind}/{n}": v for kind in kinds for n, v in getattr(document, kind).items()})


def read_grouped(path: Path, kinds: Sequence[str]) -> dict[str, dict[str, np.ndarray]]:
    """Read a file of ``write_grouped``: field -> name -> numbers ``(N,)``.

    Raises:
        ValueError: The file has another content.
    """
    groups: dict[str, dict[str, np.ndarray]] = {kind: {} for kind in kinds}
    for name, values in read_arrays(path).items():
        kind, _, owner = name.partition("/")
        check(kind in groups and values.ndim == 1 and values.dtype.kind == "f", f"{name} is no list of numbers")
        groups[kind][owner] = values
    return groups


def number(value: float | None, missing: float = math.nan) -> float:
    """Return a number of a document, or ``missing`` for null."""
    return missing if value is None else value


def _encoded(value: object) -> Json:
    """Convert a value to a type that JSON has: paths to texts, arrays to lists."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Integral | Real):
        return int(value) if isinstance(value, Integral) else float(value)
    array = np.asarray(value)
    if array.dtype == object:
        raise TypeError(f"{type(value).__name__} has no form in JSON: {value!r}")
    return array.tolist()
