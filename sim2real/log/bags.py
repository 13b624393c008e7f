"""Reads MCAP files of other recorders, ROS 2 bags among them: messages in CDR or JSON become columns by topic."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.cdr import ENCAPSULATION

_SIZES = {"bool": "?", "byte": "B", "char": "B", "float32": "f", "float64": "d"} | {
    f"{sign}int{bits}": code if not sign else code.upper()
    for sign in ("", "u") for bits, code in zip((8, 16, 32, 64), "bhiq", strict=True)
}  # fmt: skip
_FIELD = re.compile(r"^\s*([\w/]+)(<=\d+)?(\[(?:<=)?\d*\])?\s+(\w+)\s*(=)?")
Decode = Callable[[bytes], Any]


def read_bag(path: Path) -> tuple[list[str], Callable[[str], Any], dict[str, list[str]]]:
    """Return names of columns, what loads one, and names of the entries of vectors.

    Columns are ``/topic.field.field``; ``/topic.log_time`` is when the recorder got a message [ns], and a header's
    stamp is one number [ns]. Messages with names, such as joint states, are sorted by those of the first message.

    Raises:
        UsageError: When it is no MCAP file, is a log of sim2real, or has no message that can be read.
    """
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    rows: dict[str, list[dict[str, Any]]] = {}
    refused: dict[str, str] = {}
    decoders: dict[int, Decode | None] = {}
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream)
            if any(m.name == "session" for m in reader.iter_metadata()):
                raise UsageError(f"{path} is a log of sim2real already", hint="use it as it is: --log FILE")
            for schema, channel, message in reader.iter_messages():
                if channel.id not in decoders:
                    decoders[channel.id], why = _decoder(channel.message_encoding, schema)
                    if why:
                        refused[channel.topic] = why
                decode = decoders[channel.id]
                if decode is not None:
                    row = {**_flat(decode(message.data)), "log_time": message.log_time}
                    rows.setdefault(channel.topic, []).append(row)
    except (McapError, struct.error, UnicodeDecodeError, json.JSONDecodeError, IndexError, EOFError) as error:
        raise UsageError(f"{path} is no MCAP file, or is damaged: {error}", hint="`mcap doctor` says where") from None
    if not rows:
        listed = "; ".join(f"{topic}: {why}" for topic, why in refused.items()) or "no messages"
        raise UsageError(f"nothing in {path} can be read: {listed}", hint="record joint states and commands")
    found: dict[str, tuple[list[dict[str, Any]], str]] = {}
    names: dict[str, list[str]] = {}
    for topic, messages in rows.items():
        own = messages[0].get("name") or messages[0].get("joint_names")
        for field in messages[0]:
            key = f"{topic}.{field}"
            found[key] = (messages, field)
            size = len(value) if isinstance(value := messages[0][field], list) else 0
            if own and size == len(own) and isinstance(own, list):
                names[key] = [str(n) for n in own]
    return list(found), lambda key: _column(*found[key], path), names


def is_ours(path: Path) -> bool:
    """Return whether an MCAP file is a log of sim2real, as far as it can be read."""
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    try:
        with path.open("rb") as stream:
            return any(m.name == "session" for m in make_reader(stream).iter_metadata())
    except (McapError, OSError, struct.error):
        return True  # a log that was cut: its own reader says more


def _column(messages: list[dict[str, Any]], field: str, path: Path) -> Any:
    """Return one field of all messages, sorted by their names where those differ between messages."""
    first = messages[0].get("name") or messages[0].get("joint_names")
    values = []
    for number, message in enumerate(messages):
        value, names = message.get(field), message.get("name") or message.get("joint_names")
        if isinstance(value, list) and isinstance(names, list) and names != first and len(value) == len(names):
            if sorted(map(str, names)) != sorted(map(str, first or [])):
                raise UsageError(
                    f"message {number} of {field!r} in {path} is of other joints than the first: {', '.join(names)}",
                    hint="record each group of joints on a topic of its own",
                )
            value = [value[names.index(n)] for n in first or []]
        values.append(value)
    sizes = {len(v) if isinstance(v, list) else -1 for v in values}
    if len(sizes) > 1:
        raise UsageError(f"messages of {field!r} in {path} differ in their number of entries", hint="cut the file")
    return values


def _flat(value: Any, trail: str = "") -> dict[str, Any]:
    """Return the leaves of a message: numbers, and lists of numbers or names; of a trajectory the first point."""
    if isinstance(value, Mapping):
        if set(value) in ({"sec", "nanosec"}, {"sec", "nsec"}):
            return {trail: int(value["sec"]) * 10**9 + int(value.get("nanosec", value.get("nsec", 0)))}
        return {k: v for name, item in value.items() for k, v in _flat(item, f"{trail}.{name}".lstrip(".")).items()}
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        return _flat(value[0], trail)
    if isinstance(value, str) and not value:
        return {}
    return {} if isinstance(value, list) and not value else {trail: value}


def _decoder(encoding: str, schema: Any) -> tuple[Decode | None, str]:
    """Return what decodes the messages of a channel, or why nothing does."""
    if encoding == "json":
        return json.loads, ""
    if encoding != "cdr" or schema is None or schema.encoding != "ros2msg":
        kind = f"{encoding} with a schema in {schema.encoding or 'nothing'}" if schema is not None else encoding
        return None, f"messages in {kind}, not in CDR with ros2msg, nor in JSON"
    types = _parse(schema.name, schema.data.decode())

    def decode(data: bytes) -> Any:
        return _Reader(data, types).record(schema.name)

    return decode, ""


def _parse(name: str, text: str) -> dict[str, list[tuple[str, str, str]]]:
    """Return type -> fields (type, array, name) of a ``ros2msg`` schema with the types that it uses."""
    types = {}
    for part in re.split(r"^=+\s*$", text, flags=re.MULTILINE):
        lines = [line.split("#")[0] for line in part.strip().splitlines()]
        if lines and (title := re.match(r"\s*MSG:\s*(\S+)", lines[0])):
            own, lines = title[1], lines[1:]
        else:
            own = name
        package, fields = own.split("/")[0], []
        for line in lines:
            if (found := _FIELD.match(line)) and not found[5]:
                kind = found[1]
                plain = kind in _SIZES or kind in ("string", "wstring")
                fields.append((kind if plain or "/" in kind else f"{package}/{kind}", found[3] or "", found[4]))
        types[_short(own)] = fields
    types.setdefault("builtin_interfaces/Time", [("int32", "", "sec"), ("uint32", "", "nanosec")])
    types.setdefault("builtin_interfaces/Duration", [("int32", "", "sec"), ("uint32", "", "nanosec")])
    return types


def _short(name: str) -> str:
    """Return a type's name without the ``msg`` in its middle."""
    return name.replace("/msg/", "/")


class _Reader:
    """Reads one CDR message (XCDR1), of either byte order."""

    def __init__(self, data: bytes, types: Mapping[str, list[tuple[str, str, str]]]) -> None:
        self._data, self._types, self._at = data, types, len(ENCAPSULATION)
        self._order = "<" if data[1] & 1 else ">"

    def record(self, name: str) -> dict[str, Any]:
        """Read the fields of a type."""
        found = {}
        for kind, array, field in self._types[_short(name)]:
            found[field] = self._array(kind, array) if array else self._value(kind)
        return found

    def _array(self, kind: str, array: str) -> list[Any]:
        bounds = array.strip("[]")
        count = int(bounds) if bounds.isdigit() else self._number("I")
        if kind in _SIZES and count:
            code = np.dtype(self._order + _SIZES[kind] if kind != "bool" else "?")
            self._align(code.itemsize)
            values = np.frombuffer(self._data, code, count, self._at)
            self._at += count * code.itemsize
            return values.tolist()
        return [self._value(kind) for _ in range(count)]

    def _value(self, kind: str) -> Any:
        if kind in _SIZES:
            return self._number(_SIZES[kind])
        if kind == "string":
            count = self._number("I")
            self._at += count
            return self._data[self._at - count : self._at - 1].decode()
        return self.record(kind)

    def _number(self, code: str) -> Any:
        size = struct.calcsize(code)
        self._align(size)
        (value,) = struct.unpack_from(self._order + code, self._data, self._at)
        self._at += size
        return value

    def _align(self, size: int) -> None:
        self._at += -(self._at - len(ENCAPSULATION)) % size
