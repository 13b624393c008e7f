"""Reads MCAP files and the folders of ROS 2 bags: messages in CDR or JSON, up to the end of a cut file."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from sim2real.errors import UsageError
from sim2real.log.importing.readers import Table, refuse_container
from sim2real.log.session import SESSION
from sim2real.log.writer import LIBRARY

_ZSTD = b"\x28\xb5\x2f\xfd"
_IMAGES = ("Image", "PointCloud", "OccupancyGrid", "TFMessage", "CameraInfo", "LaserScan", "Marker")
_MAX_ENTRIES = 1000


def is_ours(path: Path) -> bool:
    """Return whether an MCAP file is a log of sim2real, by the library in its header."""
    try:
        with path.open("rb") as stream:
            head = stream.read(64)
    except OSError:
        return False
    return head.startswith(MCAP0_MAGIC) and b"".join((struct.pack("<I", len(LIBRARY)), LIBRARY.encode())) in head


def read_bag(path: Path) -> Table:
    """Read the topics of a bag: ``/topic.field``, ``/topic.header.stamp`` and ``/topic.log_time`` [ns].

    Joints have the order of the first message. A sender on the same topic with other joints becomes ``/topic#2`` ...

    Raises:
        UsageError: There is no MCAP file, or its messages cannot be read; for other containers the error has the
            command that converts them.
    """
    files = _files(path)
    topics: dict[str, _Topic] = {}
    table = Table(path if path.is_file() else files[0], "mcap", beside=tuple(files[1:]) if path.is_dir() else ())
    for file in files:
        for channel, schema, message in _messages(file, table):
            if channel.message_encoding == "cdr" and message.data[:4] == _ZSTD:
                raise UsageError(
                    f"each message of {file} is compressed by zstd, which import does not read",
                    hint="convert it: ros2 bag convert -i BAG -o out.yaml, with compression_mode: '' in out.yaml",
                )
            if channel.topic not in topics:
                topics[channel.topic] = _Topic(channel.topic, schema, channel.message_encoding, file)
            topics[channel.topic].take(message.data, message.log_time)
    for topic in topics.values():
        topic.add_to(table)
    if not table.columns:
        raise UsageError(
            f"nothing in {path} can be read: {'; '.join(table.notes) or 'it has no messages'}",
            hint="topics of joints in CDR (ros2msg) or JSON are read",
        )
    return table


def read_messages(path: Path, rows: Sequence[Mapping[str, Any]]) -> Table:
    """Read the messages that ``mcap cat --json`` writes, with ``log_time`` in seconds; see ``read_bag``."""
    topics: dict[str, _Topic] = {}
    for row in rows:
        topic = topics.setdefault(row["topic"], _Topic(row["topic"], None, "json", path))
        seconds = float(row["log_time"])
        topic.take(json.dumps(row["data"]).encode(), round(seconds * (1e9 if seconds < 1e11 else 1.0)))
    table = Table(path, "mcap")
    for topic in topics.values():
        topic.add_to(table)
    return table


def _files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    parts = lambda file: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", file.name)]  # noqa: E731
    files = sorted(path.glob("*.mcap"), key=parts)  # bag_2 comes before bag_10
    for other in sorted(p for p in path.iterdir() if p.is_file()) if not files else ():
        with other.open("rb") as stream:
            refuse_container(other, stream.read(64))
    if not files:
        raise UsageError(f"{path} holds no bag and no data set", hint="it has *.mcap, or LeRobot's meta/info.json")
    return files


def _messages(path: Path, table: Table) -> Iterator[tuple[Channel, Schema | None, Message]]:
    """Yield the messages of a file, up to where it is cut."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    count = 0
    with path.open("rb") as stream:
        refuse_container(path, stream.read(64))
        stream.seek(0)
        records = iter(StreamReader(stream).records)
        while True:
            try:
                record = next(records, None)
            except Exception as error:  # decompressors raise their own exceptions, a cut file raises any of them
                table.notes.append(
                    f"{path.name} is cut or damaged after {count} messages ({error}): the rest is left out"
                )
                return
            match record:
                case None:
                    return
                case Schema():
                    schemas[record.id] = record
                case Channel():
                    channels[record.id] = record
                case Message() if record.channel_id in channels:
                    count += 1
                    channel = channels[record.channel_id]
                    yield channel, schemas.get(channel.schema_id), record
                case Metadata(name=name) if name == SESSION:
                    raise UsageError(
                        f"{path} is a log of sim2real, which needs no import",
                        hint=f"sim2real identify PIPELINE --log {path}",
                    )


class _Topic:
    """The messages of one topic, flattened, by the set of their joints."""

    def __init__(self, name: str, schema: Schema | None, encoding: str, path: Path) -> None:
        self.name, self.why = name, ""
        self.rows: dict[tuple[str, ...], list[dict[str, Any]]] = {}
        self._decode: Callable[[bytes], Any] = json.loads
        kind = "" if schema is None else schema.name
        if any(word in kind for word in _IMAGES):
            self.why = f"{kind} has no joints"
        elif encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
            from mcap_ros2.decoder import DecoderFactory

            try:
                self._decode = DecoderFactory().decoder_for("cdr", schema) or json.loads
            except Exception as error:  # the message definition is incomplete
                self.why = f"its type {kind} cannot be read ({error})"
        elif encoding == "cdr":
            self.why = f"its schema is in {'' if schema is None else schema.encoding!r}, not in ros2msg"
        elif encoding != "json":
            to_json = "convert it to JSON or CSV, such as with `mcap cat FILE --json --topics TOPIC > run.json`"
            raise UsageError(
                f"{name} in {path} is in {encoding}, which import does not read",
                hint=to_json if encoding == "protobuf" else "record it in ROS 2's CDR or in JSON",
            )

    def take(self, data: bytes, log_ns: int) -> None:
        """Decode and flatten a message."""
        if self.why:
            return
        row: dict[str, Any] = {}
        try:
            _flatten(self._decode(data), "", row)
        except Exception as error:  # decoders raise their own exceptions
            self.why = f"a message cannot be decoded ({type(error).__name__}: {error})"
            return
        row["log_time"] = log_ns
        self.rows.setdefault(tuple(sorted(_names(row))), []).append(row)

    def add_to(self, table: Table) -> None:
        """Add the signals of the topic to a table."""
        if self.why:
            table.notes.append(f"skipped: {self.name}: {self.why}")
            return
        for n, rows in enumerate(self.rows.values(), 1):
            topic, names = self.name, _names(rows[0])
            if len(self.rows) > 1:
                topic = f"{self.name}#{n}"
                table.notes.append(f"{self.name} has several senders: {topic} has {', '.join(names) or 'no names'}")
            for key, value in rows[0].items():
                # Texts, such as frames and names.
                if not isinstance(value[0] if isinstance(value, list) and value else value, str):
                    _add(table, f"{topic}.{key}", key, rows, names)


def _names(row: Mapping[str, Any]) -> list[str]:
    """Return the names of the joints of a flattened message."""
    return next(
        (row[key] for key in ("name", "names", "joint_names", "joints.name") if isinstance(row.get(key), list)), []
    )


def _add(table: Table, name: str, key: str, rows: Sequence[Mapping[str, Any]], names: list[str]) -> None:
    """Add one field of all messages; entries of joints are in the order of the first message."""
    values = [row.get(key) for row in rows]
    lengths = {len(v) if isinstance(v, list) else None for v in values}
    if lengths == {0}:
        return
    if None in values or len(lengths) > 1:
        table.broken[name] = "its length differs between messages" if len(lengths) > 1 else "some messages lack it"
    elif (count := lengths.pop()) is not None and count > _MAX_ENTRIES:
        table.notes.append(f"skipped: {name} has {count} entries")
    else:
        if count == len(names) > 0:
            table.names[name] = list(names)
            if any(_names(row) != names for row in rows):
                values = [_sorted(v, _names(row), names) for v, row in zip(values, rows, strict=True)]
        table.add(name, values)


def _sorted(values: Any, own: list[str], names: list[str]) -> list[Any]:
    place = {name: i for i, name in enumerate(own)}
    return [values[place[name]] for name in names]


def _flatten(value: Any, trail: str, row: dict[str, Any]) -> None:
    """Put the numbers of a message into a row, by path; stamps become nanoseconds."""
    fields = value if isinstance(value, dict) else {k: getattr(value, k) for k in getattr(value, "__slots__", ())}
    for sec, nanosec in (("sec", "nanosec"), ("secs", "nsecs")):  # JSON has them in any order
        if set(fields) == {sec, nanosec}:
            row[trail] = int(fields[sec]) * 1_000_000_000 + int(fields[nanosec])
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
