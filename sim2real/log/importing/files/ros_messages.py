"""Decodes ROS 2 messages in CDR by their definition in the bag; docs/reference/choices.md compares other readers."""

import re
import struct
from collections.abc import Callable, Mapping

import numpy as np

from sim2real.log.cdr import ENCAPSULATION
from sim2real.log.importing.files.budget import MAX_COLUMNS, MAX_LEVELS
from sim2real.types import Json

_SIZES = {"bool": "?", "byte": "B", "char": "B", "float32": "f", "float64": "d"} | {
    f"{sign}int{bits}": code if not sign else code.upper()
    for sign in ("", "u") for bits, code in zip((8, 16, 32, 64), "bhiq", strict=True)
}  # fmt: skip
_FIELD = re.compile(r"^\s*([\w/]+)(<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=)?")
_ZSTD = b"\x28\xb5\x2f\xfd"
_PLAIN = {*_SIZES, "string", "wstring"}
_Types = Mapping[str, list[tuple[str, str, str]]]
Decode = Callable[[bytes], Json]


class UndecodableError(Exception):
    """The reason why messages of a type cannot be decoded."""


def decoder(name: str, definition: str) -> Decode:
    """Return the decoder of a message type.

    Args:
        definition: Definition of the type, then those of the types inside it (``ros2msg``).

    Raises:
        UndecodableError: When a definition is missing, uses itself, or has a ``wstring``.
    """
    types = _parse(name, definition)
    _require_whole(_short(name), types, ())
    return lambda data: _Reader(data, types).record(name)


def _parse(name: str, text: str) -> _Types:
    """Return type -> fields (type, array, name) of a ``ros2msg`` schema."""
    types = {}
    # Each part defines one type; the first one has no title.
    for part in re.split(r"^=+\s*$", text, flags=re.MULTILINE):
        lines = [line.split("#")[0] for line in part.strip().splitlines()]
        if lines and (title := re.match(r"\s*MSG:\s*(\S+)", lines[0])):
            type_name, lines = title[1], lines[1:]
        else:
            type_name = name
        package, fields = type_name.split("/")[0], []
        for line in lines:
            if (field := _FIELD.match(line)) and not field[5]:
                kind = field[1]
                full = kind if kind in _PLAIN or "/" in kind else f"{package}/{kind}"
                fields.append((full, field[3] or "", field[4]))
        types[_short(type_name)] = fields
    types.setdefault("builtin_interfaces/Time", [("int32", "", "sec"), ("uint32", "", "nanosec")])
    types.setdefault("builtin_interfaces/Duration", [("int32", "", "sec"), ("uint32", "", "nanosec")])
    return types


def _require_whole(name: str, types: _Types, inside: tuple[str, ...]) -> None:
    """Check that all types inside a type are defined."""
    if name not in types:
        raise UndecodableError(f"its definition lacks the type {name}")
    if name in inside or len(inside) > MAX_LEVELS:
        raise UndecodableError(f"its definition of {name} uses itself")
    for kind in {kind for kind, _, _ in types[name]}:
        if kind == "wstring":
            # Fast CDR writes 4 bytes a character, its second version 2 bytes, and the message does not say which.
            raise UndecodableError("it has a wstring, whose size in CDR differs between middlewares")
        if kind not in _PLAIN:
            _require_whole(_short(kind), types, (*inside, name))


def _short(name: str) -> str:
    """Return a type's name without the ``msg`` in its middle."""
    return name.replace("/msg/", "/")


class _Reader:
    """Reads one CDR message (XCDR1), of either byte order."""

    def __init__(self, data: bytes, types: _Types) -> None:
        if data[:4] == _ZSTD:
            raise ValueError("its recorder compressed it with zstd: `ros2 bag convert` writes it plain")
        if len(data) < len(ENCAPSULATION) or data[0] or data[1] > 1:
            raise ValueError(f"its encapsulation is {data[:4].hex(' ') or 'missing'}, not that of plain CDR")
        self._data, self._types, self._at = data, types, len(ENCAPSULATION)
        self._order = "<" if data[1] & 1 else ">"

    def record(self, name: str) -> dict[str, Json]:
        """Read the fields of a type."""
        values = {}
        fields = self._types[_short(name)]
        self._at += not fields  # a type without fields takes one byte
        for kind, array, field in fields:
            values[field] = self._array(kind, array) if array else self._value(kind)
        return values

    def _array(self, kind: str, array: str) -> list[Json]:
        """Read an array; an array that is too long for joints is skipped, and returned empty."""
        bounds = array.strip("[]")
        count = int(bounds) if bounds.isdigit() else self._number("I")
        if count > len(self._data) - self._at:  # each element takes a byte or more
            raise ValueError(f"an array of {count} {kind} is longer than the message")
        if kind in _SIZES and count:
            code = np.dtype(self._order + _SIZES[kind] if kind != "bool" else "?")
            self._align(code.itemsize)
            values = np.frombuffer(self._data, code, count, self._at)
            self._at += count * code.itemsize
            return values.tolist() if count <= MAX_COLUMNS else []
        return [self._value(kind) for _ in range(count)]

    def _value(self, kind: str) -> Json:
        if kind in _SIZES:
            return self._number(_SIZES[kind])
        if kind == "string":
            count = self._number("I")
            self._at += count
            if self._at > len(self._data):
                raise ValueError(f"a string of {count} bytes is longer than the message")
            return self._data[self._at - count : self._at - 1].decode(errors="replace")
        return self.record(kind)

    def _number(self, code: str) -> Json:
        size = struct.calcsize(code)
        self._align(size)
        (value,) = struct.unpack_from(self._order + code, self._data, self._at)
        self._at += size
        return value

    def _align(self, size: int) -> None:
        self._at += -(self._at - len(ENCAPSULATION)) % size
