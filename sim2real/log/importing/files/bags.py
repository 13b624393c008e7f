"""Reads MCAP files of other recorders, ROS 2 bags among them: messages in CDR or JSON become columns by topic."""

from __future__ import annotations

import json
import mmap
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

from sim2real.errors import Sim2RealError, UsageError
from sim2real.log.importing.files.bag_columns import Columns
from sim2real.log.importing.files.budget import MOST_BYTES, MOST_TEXT_BYTES, require_memory, require_signals
from sim2real.log.importing.files.raw_file import RawSignals
from sim2real.log.importing.files.ros_messages import Decode, Undecodable, decoder
from sim2real.log.metadata import SESSION
from sim2real.log.records import BROKEN, Damage, Record, chunk_content, chunk_records, opened, parsed, records

_MESSAGE = struct.Struct("<HIQQ")
_LARGE_BYTES = 64 * 1024
"""A message of joints is smaller [bytes]: this is room for a thousand of them."""
_UNPACKED = 256
"""The chunks of a bag hold at most this multiple of its size, beside the memory of the budget."""
_RELEASED_BYTES = 1 << 24
_JOINTLESS = {
    "tf2_msgs", "diagnostic_msgs", "visualization_msgs", "rcl_interfaces", "rosgraph_msgs", "nav_msgs", "map_msgs",
    "lifecycle_msgs", "stereo_msgs", "shape_msgs", "vision_msgs", "rosbag2_interfaces", "statistics_msgs",
}  # fmt: skip
"""Packages of ROS whose messages hold no joints."""
_JOINTS = ("JointState", "MultiDOFJointState")
"""The messages of sensor_msgs that hold joints."""


@dataclass
class _Topic:
    """The messages of a topic, in the order of the file.

    Attributes:
        name: Its name.
        kind: Type of its messages.
        decode: Decodes one message; None where that is not possible.
        why: Why it is left out; empty where it is read.
        data: The messages.
        log_ns: When the recorder got each [ns].
        count: Number of messages.
    """

    name: str
    kind: str
    decode: Decode | None
    why: str
    data: list[bytes] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    count: int = 0

    def leave_out(self, why: str) -> None:
        """Forget the messages, and say why."""
        self.why, self.data, self.log_ns = why, [], []


_Place = tuple[_Topic, int, "mmap.mmap | bytes", int, int]
"""A message: its topic, its log time [ns], and where its data begins and ends in what."""


def read_bag(paths: Sequence[Path]) -> RawSignals:
    """Read a bag, from one file or from several that continue each other.

    Columns are ``/topic.field.field``; ``/topic.log_time`` is when the recorder got a message [ns], and a header's
    stamp is one number [ns]. Messages keep the order of the file, which no clock changes. Messages with names, such
    as joint states, are sorted by those of the first message. Senders on one topic, each with joints of its own, are
    read as ``/topic#1``, ``/topic#2`` and so on. Topics without joints, and those that cannot be decoded, are left out,
    and the notes say so.

    Raises:
        UsageError: When a file is no MCAP file, is a log of sim2real, is damaged, or has no message that can be read.
    """
    topics, notes = _scan(paths)
    columns: dict[str, Columns] = {}
    for topic in topics.values():
        if not topic.why:
            read = _decoded(topic)
            whole = next(iter(read.values()))
            if len(read) == 1 and whole.broken and not whole.fields:
                topic.leave_out(whole.broken)
            else:
                columns |= read
    reasons = [f"{t.name} ({t.kind}): {t.why}" for t in topics.values() if t.why and t.count]
    if not columns:
        listed = "; ".join(reasons) or "no messages"
        raise UsageError(f"nothing in {paths[0]} can be read: {listed}", hint="record joint states and commands")
    keys = [f"{name}.{key}" for name, read in columns.items() for key in read.offered]
    require_signals(len(keys), paths[0])

    def load(key: str) -> np.ndarray:
        name, _, rest = key.partition(".")
        if name not in columns:
            # A mapping may name a topic that no mapping is proposed from.
            if name not in topics or topics[name].decode is None:
                raise KeyError(key)
            columns.update(_decoded(_scan(paths, name)[0][name]))
            if name not in columns:
                raise UsageError(
                    f"several senders are on {name} in {paths[0]}, each with joints of its own",
                    hint=f"name one of them: {name}#1.{rest}",
                )
        return columns[name].column(rest, f"{name} in {paths[0]}")

    names = {f"{name}.{key}": own for name, read in columns.items() for key, own in read.names.items()}
    clocks = [f"{name}: {read.clock}" for name, read in columns.items() if read.clock]
    clocks += [f"{name} are the messages of {', '.join(sorted(read.joints[0]))}" for name, read in columns.items()
               if "#" in name]  # fmt: skip
    return RawSignals(keys, load, names, (*notes, *(f"left out: {reason}" for reason in reasons), *clocks))


def is_ours(path: Path) -> bool:
    """Return whether an MCAP file is a log of sim2real, as far as it can be read."""
    try:
        with opened(path) as data:
            for record in records(data, damage := Damage()):
                if record.opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                    return False
                if record.opcode == Opcode.METADATA:
                    entry = parsed(Metadata, data, record, damage)
                    if entry is not None and entry.name == SESSION:
                        return True
    except (Sim2RealError, OSError):
        pass
    return True  # a log that was cut before its data: its own reader says more


def bag_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a ROS 2 bag's folder, in the order in which they continue each other.

    Raises:
        UsageError: When there are none, one is missing, or they are not of one bag.
    """
    there = {p.name: p for p in folder.glob("*.mcap")}
    about = folder / "metadata.yaml"
    if not there:
        packed, other = sorted(folder.glob("*.mcap.zst*")), sorted(folder.glob("*.db3"))
        if not (packed or other or about.is_file()):
            hint = "name the files in it, or the folder of a ROS 2 bag or of a LeRobot data set (with meta/info.json)"
            raise UsageError(f"{folder} is a folder, not a file", hint=hint)
        hint = "`ros2 bag convert` makes MCAP of it" if other else "name one of its files"
        hint = f"unpack it first: zstd -d {packed[0].name}" if packed else hint
        raise UsageError(f"{folder} holds 0 MCAP files, and {len(other)} of SQLite", hint=hint)
    listed: list[str] = []
    if about.is_file():
        text = about.read_text(encoding="utf-8", errors="replace")[:MOST_TEXT_BYTES]
        named = re.findall(r"^\s*-\s+[\"']?([^\s\"']+\.mcap)[\"']?\s*$", text, re.MULTILINE)
        listed = list(dict.fromkeys(Path(name).name for name in named))
    if lost := [name for name in listed if name not in there]:
        raise UsageError(
            f"{lost[0]}, which metadata.yaml names, is not in {folder}",
            hint="copy it there, or name the files that are",
        )
    if listed:
        return [there[name] for name in listed]
    parts = {name: re.fullmatch(r"(.*?)_?(\d+)\.mcap", name) for name in there}
    order = sorted(there, key=lambda name: int(found[2]) if (found := parts[name]) else -1)
    numbers = [int(found[2]) for name in order if (found := parts[name])]
    one_bag = len({found[1] for found in parts.values() if found}) == 1 and len(numbers) == len(there)
    if len(there) > 1 and not (one_bag and numbers == list(range(numbers[0], numbers[0] + len(numbers)))):
        raise UsageError(
            f"{folder} has no metadata.yaml, and its files are not numbered one after another: {', '.join(order[:6])}",
            hint="name one of them: each becomes a log",
        )
    return [there[name] for name in order]


def _scan(paths: Sequence[Path], only: str | None = None) -> tuple[dict[str, _Topic], list[str]]:
    """Return the topics of a bag with the messages that are read, and what to say of the files.

    Args:
        paths: The files, in their order.
        only: The topic that is read, whatever it holds; None: all topics that may hold joints.
    """
    topics: dict[str, _Topic] = {}
    notes, kept = [], 0
    for path in paths:
        damage = Damage()
        try:
            for topic, log_ns, source, start, end in _messages(path, topics, damage):
                topic.count += 1
                if topic.why if only is None else topic.name != only:
                    continue
                if end - start > _LARGE_BYTES and only is None:
                    topic.leave_out(f"messages of {(end - start) / 1000:.0f} kB, too large for joints")
                    continue
                kept += end - start
                require_memory(kept, f"{path}: the messages of joints")
                topic.data.append(source[start:end])
                topic.log_ns.append(log_ns)
        except UsageError:
            raise
        except (Sim2RealError, OSError) as error:
            raise UsageError(
                f"{path} is no MCAP file, or is damaged: {error}", hint="`mcap doctor` says where"
            ) from None
        if damage.skipped:
            raise UsageError(
                f"{path} is damaged: {damage.skipped[0]} cannot be read",
                hint="`sim2real log recover` copies what is readable into a new file, with gaps",
            )
        if damage.cut:
            notes.append(f"{path.name} was cut: it is read up to its end")
    return topics, notes


def _messages(path: Path, topics: dict[str, _Topic], damage: Damage) -> Iterator[_Place]:
    """Yield the messages of a file in its order; topics are added as they appear."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, _Topic] = {}

    def take(source: mmap.mmap | bytes, record: Record) -> _Place | None:
        if record.opcode == Opcode.MESSAGE:
            whole = record.end - record.start >= _MESSAGE.size
            number, _, log_ns, _ = _MESSAGE.unpack_from(source, record.start) if whole else (-1, 0, 0, 0)
            if number not in channels:
                damage.skip(f"a message at {record.start}, of no known channel,")
                return None
            return channels[number], log_ns, source, record.start + _MESSAGE.size, record.end
        if record.opcode == Opcode.SCHEMA and (schema := parsed(Schema, source, record, damage)) is not None:
            schemas[schema.id] = schema
        elif record.opcode == Opcode.CHANNEL and (channel := parsed(Channel, source, record, damage)) is not None:
            found = _topic(channel, schemas.get(channel.schema_id))
            known = topics.setdefault(channel.topic, found)
            # Two types on one topic are two signals; the second has no name of its own.
            other = known.kind != found.kind
            channels[channel.id] = topics.setdefault(f"{channel.topic} ({found.kind})", found) if other else known
            if other:
                found.leave_out(f"other messages of this topic are {known.kind}")
        return None

    unpacked, released, begun = 0, 0, False
    with opened(path) as data:
        most = _UNPACKED * len(data) + MOST_BYTES
        for record in records(data, damage):
            begun = True
            if record.start - released > _RELEASED_BYTES:
                # What was read leaves the memory: a bag with images may be larger than that.
                data.madvise(mmap.MADV_DONTNEED, released, _RELEASED_BYTES)
                released += _RELEASED_BYTES
            if record.opcode == Opcode.METADATA:
                entry = parsed(Metadata, data, record, damage)
                if entry is not None and entry.name == SESSION:
                    raise UsageError(f"{path} is a log of sim2real already", hint="use it as it is: --log FILE")
            elif record.opcode != Opcode.CHUNK:
                if (found := take(data, record)) is not None:
                    yield found
            else:
                content = chunk_content(data, record, damage)
                unpacked += len(content)
                if unpacked > most:
                    raise UsageError(f"{path} unpacks to more than {most >> 20} MiB: no recorder wrote it")
                try:
                    for part in chunk_records(content):
                        if (found := take(content, Record(*part))) is not None:
                            yield found
                except ValueError as error:
                    damage.skip(str(error))
        if not begun:
            raise UsageError(
                f"{path} is no MCAP file, or is damaged from its beginning", hint="`mcap doctor` says where"
            )


def _topic(channel: Channel, schema: Schema | None) -> _Topic:
    """Return an empty topic, with what decodes its messages or why they are left out."""
    kind = schema.name if schema is not None else channel.message_encoding
    if channel.message_encoding == "json":
        return _Topic(channel.topic, kind, json.loads, "")
    if channel.message_encoding != "cdr" or schema is None or schema.encoding != "ros2msg":
        encoding = channel.message_encoding
        encoding += f" with a schema in {schema.encoding or 'nothing'}" if schema is not None else ""
        return _Topic(channel.topic, kind, None, f"messages in {encoding}, not in CDR with ros2msg, nor in JSON")
    try:
        decode = decoder(schema.name, schema.data.decode())
    except (Undecodable, ValueError) as error:
        return _Topic(channel.topic, kind, None, str(error))
    package, name = kind.split("/")[0], kind.split("/")[-1]
    jointless = package in _JOINTLESS or (package == "sensor_msgs" and name not in _JOINTS)
    return _Topic(channel.topic, kind, decode, "messages of this type hold no joints" if jointless else "")


def _decoded(topic: _Topic) -> dict[str, Columns]:
    """Return the columns of a topic by its name; the messages are forgotten.

    Where several senders are on it, each with joints of its own, they are ``/topic#1``, ``/topic#2`` and so on.
    """
    whole = _columns(topic, topic.log_ns, topic.data)
    found = {topic.name: whole}
    if not whole.broken and (groups := whole.groups()):
        found = {}
        for number, joints in enumerate(groups, 1):
            rows = [i for i, own in enumerate(whole.joints) if own == joints]
            found[f"{topic.name}#{number}"] = _columns(
                topic, [topic.log_ns[i] for i in rows], [topic.data[i] for i in rows]
            )
    topic.data, topic.log_ns = [], []
    return found


def _columns(topic: _Topic, logs_ns: Sequence[int], messages: Sequence[bytes]) -> Columns:
    """Return the columns of some messages of a topic."""
    found = Columns()
    for log_ns, data in zip(logs_ns, messages, strict=True):
        try:
            message = topic.decode(data) if topic.decode else None
            if not isinstance(message, Mapping):
                raise ValueError("it is no record of named values")
            found.add(message, log_ns)
        except (*BROKEN, UnicodeDecodeError) as error:
            found.broken = f"message {found.count} cannot be decoded: {error}"
            break
    found.finish()
    return found
