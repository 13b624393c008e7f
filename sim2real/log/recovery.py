"""Copies the readable records of a damaged MCAP file into a new one."""

import mmap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from sim2real.errors import Sim2RealError
from sim2real.log.records import Damage, Record, chunk_content, chunk_records, opened, parsed, records, stream_of

# Size of a message record's content before the message's own data: channel, sequence and two times.
_MESSAGE_BYTES = 22


@dataclass(frozen=True)
class Recovery:
    """The result of ``recover``.

    Attributes:
        messages: Topic -> number of messages written.
        skipped: Descriptions of the unreadable places.
        cut: Whether the source ends before the end of its data section.
    """

    messages: Mapping[str, int]
    skipped: tuple[str, ...]
    cut: bool


def recover(source: str | Path, target: str | Path) -> Recovery:
    """Copy the readable records of a damaged MCAP file into a new one that every MCAP reader opens.

    The new file has a ``session_end`` only if the old one has: a crashed session stays crashed.

    Args:
        target: The new file; it must not exist.

    Raises:
        Sim2RealError: When the source is missing or not an MCAP file, or the target exists.
    """
    damage = Damage()
    if Path(target).exists():
        raise Sim2RealError(f"{target} exists already", hint="choose another name")
    with opened(source) as data:
        # Collect all definitions first, as a damaged file can hold them after their messages.
        definitions = _definitions(data)
        # Copy record by record; a failure leaves no file.
        try:
            with open(target, "xb") as stream:
                copier = _Copier(Writer(stream, chunk_size=64 * 1024, compression=CompressionType.LZ4), definitions)
                for record in records(data, damage):
                    copier.take(data, record, damage)
                copier.finish()
        except OSError as error:
            Path(target).unlink(missing_ok=True)
            raise Sim2RealError(f"cannot write {target}: {error.strerror}", hint="name another with --out") from error
        except BaseException:
            Path(target).unlink(missing_ok=True)
            raise
    return Recovery(copier.counts, tuple(damage.skipped), damage.cut)


@dataclass
class _Definitions:
    """The schemas and channels of a file.

    Attributes:
        schemas: Number -> schema.
        channels: Number -> channel.
        checked: Numbers of the channels that a chunk defines; chunks have checksums, other definitions can be damaged.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    checked: set[int] = field(default_factory=set)


def _definitions(data: mmap.mmap) -> _Definitions:
    """Collect a file's schemas and channels; definitions in chunks take precedence, as chunks have checksums."""
    loose, checked = _Definitions(), _Definitions()
    ignored = Damage()  # the copy of the records reports the damage

    def take(definitions: _Definitions, source: mmap.mmap | bytes, record: Record) -> None:
        if record.opcode == Opcode.SCHEMA and (schema := parsed(Schema, source, record, ignored)) is not None:
            definitions.schemas[schema.id] = schema
        elif record.opcode == Opcode.CHANNEL and (channel := parsed(Channel, source, record, ignored)) is not None:
            definitions.channels[channel.id] = channel

    # Definitions outside of chunks have no checksum, so chunks win.
    for record in records(data, ignored):
        if record.opcode != Opcode.CHUNK:
            take(loose, data, record)
            continue
        content = chunk_content(data, record, ignored)
        for inner in _whole(content):
            take(checked, content, inner)
    return _Definitions(loose.schemas | checked.schemas, loose.channels | checked.channels, set(checked.channels))


def _whole(content: bytes, damage: Damage | None = None) -> list[Record]:
    """Return the records in a chunk's content; none if their lengths do not add up."""
    try:
        return [Record(*record_fields) for record_fields in chunk_records(content)]
    except ValueError as error:
        if damage is not None:
            damage.skip(str(error))
        return []


class _Copier:
    """Copies the records of a file into another; schemas and channels get new numbers."""

    def __init__(self, writer: Writer, definitions: _Definitions) -> None:
        self.counts: dict[str, int] = {}
        self._writer = writer
        self._definitions = definitions
        self._header = Header(profile="", library="")
        self._started = False
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}

    def take(self, data: mmap.mmap, record: Record, damage: Damage) -> None:
        """Copy a record of the data section."""
        # Messages can be inside of chunks, or outside.
        if record.opcode == Opcode.HEADER:
            self._header = parsed(Header, data, record, damage) or self._header
        elif record.opcode == Opcode.CHUNK:
            content = chunk_content(data, record, damage)
            for inner in _whole(content, damage):
                if inner.opcode == Opcode.MESSAGE:
                    self._message(content, inner, damage)
        elif record.opcode == Opcode.MESSAGE:
            self._message(data, record, damage)
        elif record.opcode == Opcode.METADATA and (entry := parsed(Metadata, data, record, damage)) is not None:
            self._begin()
            self._writer.add_metadata(entry.name, entry.metadata)
        elif record.opcode == Opcode.ATTACHMENT and (file := parsed(Attachment, data, record, damage)) is not None:
            self._begin()
            self._writer.add_attachment(file.create_time, file.log_time, file.name, file.media_type, file.data)

    def finish(self) -> None:
        """Write the channels without messages, and the index."""
        self._begin()
        # If chunks define channels, one that is defined only elsewhere is a damaged copy of one of those.
        for number in sorted(self._definitions.checked or self._definitions.channels):
            self._channel(number)
        self._writer.finish()

    def _begin(self) -> None:
        if not self._started:
            self._started = True
            self._writer.start(profile=self._header.profile, library=self._header.library)

    def _message(self, source: mmap.mmap | bytes, record: Record, damage: Damage) -> None:
        message = None
        if record.end - record.start >= _MESSAGE_BYTES:
            message = Message.read(stream_of(source, record), record.end - record.start)
        if message is None or message.channel_id not in self._definitions.channels:
            damage.skip(f"a message at {record.start}, of no known channel")
            return
        self._begin()
        channel, topic = self._channel(message.channel_id), self._definitions.channels[message.channel_id].topic
        self._writer.add_message(channel, message.log_time, message.data, message.publish_time, message.sequence)
        self.counts[topic] = self.counts.get(topic, 0) + 1

    def _channel(self, number: int) -> int:
        if number not in self._channels:
            channel = self._definitions.channels[number]
            self._channels[number] = self._writer.register_channel(
                channel.topic, channel.message_encoding, self._schema(channel.schema_id), channel.metadata
            )
        return self._channels[number]

    def _schema(self, number: int) -> int:
        """Return a schema's new number; 0, MCAP's number for no schema, if it is lost."""
        if number not in self._schemas:
            schema = self._definitions.schemas.get(number)
            new = 0 if schema is None else self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._schemas[number] = new
        return self._schemas[number]
