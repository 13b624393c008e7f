"""Reads arrays in npz files; their headers are read first, so that an archive unpacks no more than the limit."""

import math
import zipfile
import zlib
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.files.budget import WHOLE, reason_to_skip, require_memory, require_signals
from sim2real.log.importing.files.raw_file import RawSignals

DAMAGED = (OSError, ValueError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error)
"""Exceptions of the libraries for damaged content."""


def read_npz(path: Path) -> RawSignals:
    """Read an archive of arrays.

    Raises:
        UsageError: When the file is no ZIP archive, or has no array of numbers within the limit.
    """
    # NumPy would read any other file as a pickle.
    if not zipfile.is_zipfile(path):
        raise UsageError(f"{path} is no npz file, or is cut off", hint=WHOLE)
    shapes: dict[str, tuple[tuple[int, ...], np.dtype[np.generic]]] = {}
    notes, total = [], 0.0
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            require_signals(len(names), path)
            for name in names:
                key = name.removesuffix(".npy")
                try:
                    shapes[key] = _shape(archive, name)
                except (*DAMAGED, UnicodeError) as error:
                    notes.append(f"skipped: {key!r}: its header is damaged ({str(error)[:80]})")
    except DAMAGED as error:
        if isinstance(error, UsageError):
            raise
        raise UsageError(f"{path} is no npz file, or is damaged: {error}", hint=WHOLE) from None
    keys = []
    for key, (shape, dtype) in shapes.items():
        if why := reason_to_skip(shape, dtype.kind, dtype.itemsize):
            notes.append(f"skipped: {key!r}: {why}")
        else:
            keys.append(key)
            total += 8.0 * math.prod(shape)
    if not keys:
        raise UsageError(f"nothing in {path} can be read: {'; '.join(notes) or 'no arrays'}", hint=WHOLE)
    require_memory(total, str(path))

    def load(name: str) -> np.ndarray:
        if name not in (key.removesuffix(".npy") for key in names):
            raise KeyError(name)
        shape, dtype = shapes.get(name, ((), np.dtype(float)))
        if dtype.hasobject:
            raise UsageError(
                f"{name!r} in {path} holds Python objects, which could run any code when loaded",
                hint="save it again as an array of numbers",
            )
        require_memory(float(math.prod(shape)) * dtype.itemsize, f"{name!r} in {path}")
        # Open the file for each signal, so that a damaged signal does not prevent the reading of others.
        with np.load(path, allow_pickle=False) as data:
            return data[name]

    return RawSignals(keys, load, notes=tuple(notes))


def _shape(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    """Return shape and type of an array in an archive, from its header."""
    with archive.open(name) as stream:
        version = np.lib.format.read_magic(stream)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(stream)
    if any(n < 0 for n in shape):
        raise ValueError("a size below 0")
    return shape, dtype
