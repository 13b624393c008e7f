"""Reads MCAP files of other recorders, ROS 2 bags among them: messages in CDR or JSON become columns by topic."""

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
from sim2real.log.importing.files.budget import MAX_BYTES, MAX_TEXT_BYTES, require_memory, require_signals
from sim2real.log.importing.files.raw_file import RawSignals
from sim2real.log.importing.files.records import (
    BROKEN,
    Damage,
    Record,
    chunk_content,
    chunk_records,
    opened,
    parsed,
    records,
)
from sim2real.log.importing.files.ros_messages import Decode, UndecodableError, decoder
from sim2real.log.session import SESSION

_MESSAGE = struct.Struct("<HIQQ")
_MAX_MESSAGE_BYTES = 64 * 1024
"""Larger messages hold no joints [bytes]: this is room for a thousand joints."""
_MAX_UNPACKED_RATIO = 256
"""The content of a bag's chunks has at most this multiple of the file's size, plus ``MAX_BYTES``."""
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
        kind: Type of the messages.
        decode: Decodes one message; None if that is not possible.
        why: Reason to skip the topic; empty if it is read.
        data: The encoded messages.
        log_ns: Time at which the recorder received each message [ns].
        count: Number of messages.
    """

    name: str
    kind: str
    decode: Decode | None
    why: str
    data: list[bytes] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    count: int = 0

    def skip(self, why: str) -> None:
        """Drop the messages, and store the reason."""
        self.why, self.data, self.log_ns = why, [], []


_Place = tuple[_Topic, int, "mmap.mmap | bytes", int, int]
"""A message: its topic, its log time [ns], the source of its data, and start and end of the data in it."""


def read_bag(paths: Sequence[Path]) -> RawSignals:
    """Read a bag, from one file or from several that continue each other.

    Columns are ``/topic.field.field``; ``/topic.log_time`` is the time at which the recorder received a message [ns],
    and a header's stamp is one number [ns]. Messages stay in the order of the file. Messages with names, such as joint
    states, are sorted by the names of the first message. If several senders use one topic for different joints, they
    are ``/topic#1``, ``/topic#2`` and so on. Topics without joints, and undecodable topics, are skipped with a note.

    Raises:
        UsageError: When a file is no MCAP file, is a log of sim2real, is damaged, or has no readable message.
    """
    topics, notes = _scan(paths)
    columns: dict[str, Columns] = {}
    for topic in topics.values():
        if not topic.why:
            decoded = _decoded(topic)
            first = next(iter(decoded.values()))
            if len(decoded) == 1 and first.broken and not first.fields:
                topic.skip(first.broken)
            else:
                columns |= decoded
    reasons = [f"{t.name} ({t.kind}): {t.why}" for t in topics.values() if t.why and t.count]
    if not columns:
        listed = "; ".join(reasons) or "no messages"
        raise UsageError(f"nothing in {paths[0]} can be read: {listed}", hint="record joint states and commands")
    keys = [f"{name}.{key}" for name, decoded in columns.items() for key in decoded.offered]
    require_signals(len(keys), paths[0])

    def load(key: str) -> np.ndarray:
        name, _, rest = key.partition(".")
        if name not in columns:
            # A mapping can name a topic that the proposal skips: read the file again for it.
            if name not in topics or topics[name].decode is None:
                raise KeyError(key)
            columns.update(_decoded(_scan(paths, name)[0][name]))
            if name not in columns:
                raise UsageError(
                    f"several senders are on {name} in {paths[0]}, each with its own joints",
                    hint=f"name one of them: {name}#1.{rest}",
                )
        return columns[name].column(rest, f"{name} in {paths[0]}")

    names = {
        f"{name}.{key}": field_names for name, decoded in columns.items() for key, field_names in decoded.names.items()
    }
    clocks = [f"{name}: {decoded.clock}" for name, decoded in columns.items() if decoded.clock]
    clocks += [f"{name} are the messages of {', '.join(sorted(decoded.joints[0]))}" for name, decoded in columns.items()
               if "#" in name]  # fmt: skip
    return RawSignals(keys, load, names, (*notes, *(f"skipped: {reason}" for reason in reasons), *clocks))


def is_ours(path: Path) -> bool:
    """Return whether an MCAP file is a log of sim2real; True for an unreadable file."""
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
    return True  # a log that was cut before its data: the reader of logs raises the better error


def bag_files(folder: Path) -> list[Path]:
    """Return the MCAP files of a ROS 2 bag's folder, in the order in which they continue each other.

    Raises:
        UsageError: When there are none, one is missing, or they are not of one bag.
    """
    files = {p.name: p for p in folder.glob("*.mcap")}
    metadata_file = folder / "metadata.yaml"
    # Explain a folder without MCAP files by its other content.
    if not files:
        compressed, other = sorted(folder.glob("*.mcap.zst*")), sorted(folder.glob("*.db3"))
        if not (compressed or other or metadata_file.is_file()):
            hint = "name the files in it, or the folder of a ROS 2 bag or of a LeRobot data set (with meta/info.json)"
            raise UsageError(f"{folder} is a folder, not a file", hint=hint)
        hint = "`ros2 bag convert` makes MCAP of it" if other else "name one of its files"
        hint = f"unpack it first: zstd -d {compressed[0].name}" if compressed else hint
        raise UsageError(f"{folder} holds 0 MCAP files, and {len(other)} of SQLite", hint=hint)
    # Take the order from metadata.yaml, which the recorder wrote.
    listed: list[str] = []
    if metadata_file.is_file():
        text = metadata_file.read_text(encoding="utf-8", errors="replace")[:MAX_TEXT_BYTES]
        names = re.findall(r"^\s*-\s+[\"']?([^\s\"']+\.mcap)[\"']?\s*$", text, re.MULTILINE)
        listed = list(dict.fromkeys(Path(name).name for name in names))
    if missing := [name for name in listed if name not in files]:
        raise UsageError(
            f"{missing[0]}, which metadata.yaml names, is not in {folder}",
            hint="copy it there, or name the files that are",
        )
    if listed:
        return [files[name] for name in listed]
    # Without it, the numbers in the names must be consecutive.
    parts = {name: re.fullmatch(r"(.*?)_?(\d+)\.mcap", name) for name in files}
    order = sorted(files, key=lambda name: int(part[2]) if (part := parts[name]) else -1)
    numbers = [int(part[2]) for name in order if (part := parts[name])]
    one_bag = len({part[1] for part in parts.values() if part}) == 1 and len(numbers) == len(files)
    if len(files) > 1 and not (one_bag and numbers == list(range(numbers[0], numbers[0] + len(numbers)))):
        raise UsageError(
            f"{folder} has no metadata.yaml, and its files are not numbered one after another: {', '.join(order[:6])}",
            hint="name one of them: each becomes a log",
        )
    return [files[name] for name in order]


def _scan(paths: Sequence[Path], only: str | None = None) -> tuple[dict[str, _Topic], list[str]]:
    """Return the topics of a bag with their messages, and notes on the files.

    Args:
        paths: The files, in their order.
        only: The topic to read, with any content; None: all topics that can hold joints.
    """
    topics: dict[str, _Topic] = {}
    notes, selected_bytes = [], 0
    for path in paths:
        damage = Damage()
        try:
            # Collect the messages of topics that can hold joints, within the limits of memory.
            for topic, log_ns, source, start, end in _messages(path, topics, damage):
                topic.count += 1
                if topic.why if only is None else topic.name != only:
                    continue
                if end - start > _MAX_MESSAGE_BYTES and only is None:
                    topic.skip(f"messages of {(end - start) / 1000:.0f} kB, too large for joints")
                    continue
                selected_bytes += end - start
                require_memory(selected_bytes, f"{path}: the messages of joints")
                topic.data.append(source[start:end])
                topic.log_ns.append(log_ns)
        except UsageError:
            raise
        except (Sim2RealError, OSError) as error:
            raise UsageError(
                f"{path} is no MCAP file, or is damaged: {error}", hint="`mcap doctor` names the place"
            ) from None
        # Refuse a damaged file, as its messages could be wrong, but accept a file that was cut.
        if damage.skipped:
            raise UsageError(
                f"{path} is damaged: {damage.skipped[0]} cannot be read",
                hint="`sim2real log recover` copies the readable part into a new file, with gaps",
            )
        if damage.cut:
            notes.append(f"{path.name} was cut: it is read up to its end")
    return topics, notes


def _messages(path: Path, topics: dict[str, _Topic], damage: Damage) -> Iterator[_Place]:
    """Yield the messages of a file in its order, and add new topics."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, _Topic] = {}

    def read_record(source: mmap.mmap | bytes, record: Record) -> _Place | None:
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
            topic = _topic(channel, schemas.get(channel.schema_id))
            first = topics.setdefault(channel.topic, topic)
            # Two types on one topic are two signals; the second signal is skipped.
            second_type = first.kind != topic.kind
            channels[channel.id] = topics.setdefault(f"{channel.topic} ({topic.kind})", topic) if second_type else first
            if second_type:
                topic.skip(f"other messages of this topic are {first.kind}")
        return None

    unpacked_bytes, released, has_records = 0, 0, False
    with opened(path) as data:
        max_unpacked = _MAX_UNPACKED_RATIO * len(data) + MAX_BYTES
        for record in records(data, damage):
            has_records = True
            if record.start - released > _RELEASED_BYTES:
                # Release the pages that were read, as a bag with images can be larger than the memory.
                data.madvise(mmap.MADV_DONTNEED, released, _RELEASED_BYTES)
                released += _RELEASED_BYTES
            if record.opcode == Opcode.METADATA:
                entry = parsed(Metadata, data, record, damage)
                if entry is not None and entry.name == SESSION:
                    raise UsageError(f"{path} is a log of sim2real already", hint="use it as it is: --log FILE")
            elif record.opcode != Opcode.CHUNK:
                if (place := read_record(data, record)) is not None:
                    yield place
            else:
                content = chunk_content(data, record, damage)
                unpacked_bytes += len(content)
                if unpacked_bytes > max_unpacked:
                    raise UsageError(f"{path} unpacks to more than {max_unpacked >> 20} MiB, which no recorder writes")
                try:
                    for part in chunk_records(content):
                        if (place := read_record(content, Record(*part))) is not None:
                            yield place
                except ValueError as error:
                    damage.skip(str(error))
        if not has_records:
            raise UsageError(
                f"{path} is no MCAP file, or is damaged from its beginning", hint="`mcap doctor` names the place"
            )


def _topic(channel: Channel, schema: Schema | None) -> _Topic:
    """Return an empty topic, with its decoder or the reason to skip it."""
    kind = schema.name if schema is not None else channel.message_encoding
    # Choose the decoder by the encoding.
    if channel.message_encoding == "json":
        return _Topic(channel.topic, kind, json.loads, "")
    if channel.message_encoding != "cdr" or schema is None or schema.encoding != "ros2msg":
        encoding = channel.message_encoding
        encoding += f" with a schema in {schema.encoding or 'nothing'}" if schema is not None else ""
        return _Topic(channel.topic, kind, None, f"messages in {encoding}, not in CDR with ros2msg, nor in JSON")
    try:
        decode = decoder(schema.name, schema.data.decode())
    except (UndecodableError, ValueError) as error:
        return _Topic(channel.topic, kind, None, str(error))
    # Skip types without joints, as images and transforms.
    package, name = kind.split("/")[0], kind.split("/")[-1]
    jointless = package in _JOINTLESS or (package == "sensor_msgs" and name not in _JOINTS)
    return _Topic(channel.topic, kind, decode, "messages of this type hold no joints" if jointless else "")


def _decoded(topic: _Topic) -> dict[str, Columns]:
    """Return the columns of a topic by its name, and drop its messages.

    If several senders use the topic for different joints, they are ``/topic#1``, ``/topic#2`` and so on.
    """
    columns = _columns(topic, topic.log_ns, topic.data)
    by_name = {topic.name: columns}
    if not columns.broken and (groups := columns.groups()):
        by_name = {}
        for number, joints in enumerate(groups, 1):
            rows = [i for i, message_joints in enumerate(columns.joints) if message_joints == joints]
            by_name[f"{topic.name}#{number}"] = _columns(
                topic, [topic.log_ns[i] for i in rows], [topic.data[i] for i in rows]
            )
    topic.data, topic.log_ns = [], []
    return by_name


def _columns(topic: _Topic, logs_ns: Sequence[int], messages: Sequence[bytes]) -> Columns:
    """Return the columns of messages of a topic."""
    columns = Columns()
    for log_ns, data in zip(logs_ns, messages, strict=True):
        try:
            message = topic.decode(data) if topic.decode else None
            if not isinstance(message, Mapping):
                raise ValueError("it has no named values")
            columns.add(message, log_ns)
        except (*BROKEN, UnicodeDecodeError) as error:
            columns.broken = f"message {columns.count} cannot be decoded: {error}"
            break
    columns.finish()
    return columns
