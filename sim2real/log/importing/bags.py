"""Reads MCAP files and the folders of ROS 2 bags: messages in CDR or JSON, up to the end of a cut file."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Channel, Header, Message, Metadata, Schema
from mcap.stream_reader import StreamReader

from sim2real.errors import UsageError
from sim2real.log.importing.readers import Table, refuse_container
from sim2real.log.session import SESSION

_ZSTD = b"\x28\xb5\x2f\xfd"
_IMAGES = ("Image", "PointCloud", "OccupancyGrid", "TFMessage", "CameraInfo", "LaserScan", "Marker")
_MAX_ENTRIES = 1000
_NAMES = ("name", "names", "joint_names")


def is_ours(path: Path) -> bool:
    """Return whether an MCAP file is a log of sim2real."""
    try:
        with path.open("rb") as stream:
            for n, record in enumerate(StreamReader(stream).records):
                if isinstance(record, Metadata):
                    return record.name == SESSION
                if n > 2 or not isinstance(record, Header):
                    return False
    except (OSError, McapError, ValueError, struct.error):  # of a file of fewer than 8 bytes
        pass
    return False


def read_bag(path: Path) -> Table:
    """Read the topics of a bag: ``/topic.field``, ``/topic.header.stamp`` and ``/topic.log_time`` [ns].

    Joints are sorted by the names of the first message. Senders of one topic with other joints become ``/topic#2`` ...

    Raises:
        UsageError: When there is no MCAP file, or its messages cannot be read; a container of another kind is named
            with the command that converts it.
    """
    files = _files(path)
    topics: dict[str, _Topic] = {}
    table = Table(path if path.is_file() else files[0], "mcap", beside=tuple(files[1:]) if path.is_dir() else ())
    for file in files:
        for topic, schema, message, log_ns, encoding in _messages(file, table):
            topics.setdefault(topic, _Topic(topic, schema, encoding)).take(message, log_ns, file)
    for topic in topics.values():
        topic.add_to(table)
    if not table.columns:
        raise UsageError(
            f"nothing in {path} can be read: {'; '.join(table.notes) or 'it has no messages'}",
            hint="topics of joints in CDR (ros2msg) or JSON are read",
        )
    return table


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    files = sorted(path.glob("*.mcap"))
    for other in sorted(p for p in path.iterdir() if p.is_file()) if not files else ():
        with other.open("rb") as stream:
            refuse_container(other, stream.read(64))
    if not files:
        raise UsageError(f"{path} holds no bag and no data set", hint="it has *.mcap, or LeRobot's meta/info.json")
    return files


def _messages(path: Path, table: Table) -> Iterator[tuple[str, Schema | None, bytes, int, str]]:
    """Yield topic, schema, data, log time [ns] and encoding of the messages of a file, up to where it is cut."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    count = 0
    with path.open("rb") as stream:
        refuse_container(path, stream.read(64))
        stream.seek(0)
        try:
            for record in StreamReader(stream).records:
                if isinstance(record, Message) and record.channel_id in channels:
                    channel = channels[record.channel_id]
                    count += 1
                    yield (
                        channel.topic,
                        schemas.get(channel.schema_id),
                        record.data,
                        record.log_time,
                        channel.message_encoding,
                    )
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Metadata) and record.name == SESSION:
                    raise UsageError(
                        f"{path} is a log of sim2real, which needs no import",
                        hint=f"sim2real identify PIPELINE --log {path}",
                    )
        except UsageError:
            raise
        except Exception as error:  # decompressors have their own exceptions, and a cut file raises any of them
            table.notes.append(f"{path.name} is cut or damaged after {count} messages ({error}): the rest is left out")


class _Topic:
    """The messages of one topic, flattened, by the set of their joints."""

    def __init__(self, name: str, schema: Schema | None, encoding: str) -> None:
        self.name, self.encoding = name, encoding
        self.kind = "" if schema is None else schema.name
        self.why = ""
        self.rows: dict[tuple[str, ...], list[dict[str, Any]]] = {}
        self._decode: Callable[[bytes], Any] | None = None
        if any(word in self.kind for word in _IMAGES):
            self.why = f"{self.kind} has no joints"
            return
        if encoding == "json":
            self._decode = json.loads
        elif encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
            from mcap_ros2.decoder import DecoderFactory

            try:
                self._decode = DecoderFactory().decoder_for("cdr", schema)
            except Exception as error:  # of a definition that is incomplete
                self.why = f"its type {self.kind} cannot be read ({error})"
        elif encoding == "cdr":
            self.why = f"its schema is in {'' if schema is None else schema.encoding!r}, not in ros2msg"
        else:
            self.why = f"its messages are in {encoding}, which import does not read"

    def take(self, data: bytes, log_ns: int, path: Path) -> None:
        """Decode and flatten a message."""
        if self.encoding == "cdr" and data[:4] == _ZSTD:
            raise UsageError(
                f"each message of {path} is compressed by zstd, which import does not read",
                hint="convert it: ros2 bag convert -i BAG -o out.yaml, with compression_mode: '' in out.yaml",
            )
        if self.encoding not in ("cdr", "json") and not self.why.startswith("skip"):
            raise (
                UsageError(
                    f"{self.name} in {path} is in {self.encoding}, which import does not read",
                    hint="convert it to JSON or CSV, such as with `mcap cat FILE --json --topics TOPIC > run.json`",
                )
                if self.encoding == "protobuf"
                else UsageError(
                    f"{self.name} in {path} is in {self.encoding}, which import does not read",
                    hint="record it in ROS 2's CDR or in JSON",
                )
            )
        if self._decode is None or self.why:
            return
        row: dict[str, Any] = {}
        try:
            _flatten(self._decode(data), "", row)
        except Exception as error:  # decoders have their own exceptions
            self.why = f"a message cannot be decoded ({type(error).__name__}: {error})"
            return
        row["log_time"] = log_ns
        names = next((row[key] for key in _NAMES if isinstance(row.get(key), list)), [])
        self.rows.setdefault(tuple(sorted(names)), []).append(row)

    def add_to(self, table: Table) -> None:
        """Add the signals of the topic to a table."""
        if self.why:
            table.notes.append(f"skipped: {self.name}: {self.why}")
            return
        several = len(self.rows) > 1
        for n, rows in enumerate(self.rows.values(), 1):
            topic = f"{self.name}#{n}" if several else self.name
            if several:
                listed = ", ".join(next((rows[0][k] for k in _NAMES if k in rows[0]), [])) or "no names"
                table.notes.append(f"{self.name} has several senders: {topic} has {listed}")
            self._add(table, topic, rows)

    def _add(self, table: Table, topic: str, rows: list[dict[str, Any]]) -> None:
        first = rows[0]
        key_of_names = next((k for k in _NAMES if isinstance(first.get(k), list)), None)
        names: list[str] = first[key_of_names] if key_of_names else []
        moved = any(row.get(key_of_names) != names for row in rows) if key_of_names else False
        for key, value in first.items():
            values = [row.get(key) for row in rows]
            if isinstance(value, str) or (isinstance(value, list) and value and isinstance(value[0], str)):
                continue  # frames and names
            if isinstance(value, list):
                lengths = {len(v) if isinstance(v, list) else -1 for v in values}
                if lengths == {0}:
                    continue
                if len(lengths) > 1 or -1 in lengths:
                    table.broken[f"{topic}.{key}"] = "its length differs between messages"
                    continue
                if len(value) > _MAX_ENTRIES:
                    table.notes.append(f"skipped: {topic}.{key} has {len(value)} entries")
                    continue
                if moved and key_of_names and len(value) == len(names):
                    values = [_sorted(v, row[key_of_names], names) for v, row in zip(values, rows, strict=True)]
            elif any(v is None or isinstance(v, list) for v in values):
                table.broken[f"{topic}.{key}"] = "some messages lack it"
                continue
            table.add(f"{topic}.{key}", values)
            if isinstance(value, list) and len(value) == len(names):
                table.names[f"{topic}.{key}"] = list(names)


def _sorted(values: Any, own: list[str], names: list[str]) -> list[Any]:
    place = {name: i for i, name in enumerate(own)}
    return [values[place[name]] for name in names]


def _flatten(value: Any, trail: str, row: dict[str, Any]) -> None:
    """Put the numbers of a message into a row by path; stamps become nanoseconds."""
    fields = value if isinstance(value, dict) else {k: getattr(value, k) for k in getattr(value, "__slots__", ())}
    if set(fields) in ({"sec", "nanosec"}, {"secs", "nsecs"}):
        sec, nanosec = fields.values()
        row[trail] = int(sec) * 1_000_000_000 + int(nanosec)
        return
    for key, item in fields.items():
        path = f"{trail}.{key}" if trail else key
        if isinstance(item, bool | int | float | str):
            row[path] = item
        elif isinstance(item, bytes | bytearray):
            row[path] = list(item) if len(item) <= _MAX_ENTRIES else "bytes"
        elif isinstance(item, list | tuple | np.ndarray):
            items = list(item)
            if items and not isinstance(items[0], bool | int | float | str | np.generic):
                parts: list[dict[str, Any]] = []
                for entry in items[:_MAX_ENTRIES]:
                    part: dict[str, Any] = {}
                    _flatten(entry, "", part)
                    parts.append(part)
                for name, first in parts[0].items():
                    if isinstance(first, list):
                        row[f"{path}.{name}"] = first if len(parts) == 1 else "nested"
                    else:
                        row[f"{path}.{name}"] = [part.get(name) for part in parts]
            else:
                row[path] = [x.item() if isinstance(x, np.generic) else x for x in items]
        elif item is None:
            row[path] = float("nan")
        else:
            _flatten(item, path, row)
