"""The messages against the bindings' own encoder, the C layout, and a bit-by-bit CRC."""

import struct
from types import SimpleNamespace

import numpy as np
import pytest

idl = pytest.importorskip("cyclonedds.idl")
from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.internal import InvalidSample  # noqa: E402
from cyclonedds.pub import DataWriter  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402

from sim2real.hardware.unitree.messages import LowCmd, LowState, crc32  # noqa: E402

# Unitree's client packs its messages in these formats before it computes the CRC.
FORMATS = {
    LowCmd: "<4B4IH2x" + "B3x5f3I" * 20 + "4B55Bx2I",
    LowState: "<4B4IH2x13fB3x" + "B3x7fB3x3I" * 20 + "4BiH4B15H8hI41B3xf2B2x2f4H2I",
}
MESSAGES = pytest.mark.parametrize("kind", [LowCmd, LowState])


def filled(kind, seed=1):
    """Return a message with other values in every field."""
    raw = np.random.default_rng(seed).integers(1, 100, kind.layout.itemsize, np.uint8)
    return kind((raw & kind._content).view(kind.layout).reshape(()))


def plain(values):
    """Return a record as the objects that generated code has."""
    if values.ndim:
        return [plain(value) for value in values]
    if values.dtype.names:
        return SimpleNamespace(**{name: plain(values[name]) for name in values.dtype.names})
    return values.item()


def flat(values):
    if isinstance(values, list):
        return [number for value in values for number in flat(value)]
    return [n for v in vars(values).values() for n in flat(v)] if isinstance(values, SimpleNamespace) else [values]


def crc_by_bits(words):
    crc = 0xFFFFFFFF
    for word in words:
        for bit in reversed(range(32)):
            top = crc >> 31 ^ word >> bit & 1
            crc = crc << 1 & 0xFFFFFFFF ^ (0x04C11DB7 if top else 0)
    return crc


@MESSAGES
def test_the_layout_is_that_of_the_c_struct(kind):
    message = filled(kind)
    assert message.record.tobytes() == struct.pack(FORMATS[kind], *flat(plain(message.record)))


@MESSAGES
def test_the_bytes_on_the_wire_are_those_of_the_bindings_encoder(kind):
    message = filled(kind)
    wire = message.to_wire()
    assert wire == kind.__idl__.serialize(plain(message.record), use_version_2=False)
    # Padding has no content, whatever its sender left there.
    noisy = bytearray(wire)
    noisy[26 + 1 if kind is LowCmd else 81 + 1] = 7
    for received in (wire, bytes(noisy)):
        assert kind.from_wire(received).record.tobytes() == message.record.tobytes()


@MESSAGES
def test_the_crc_is_that_of_each_bit_and_changes_with_each_field(kind):
    message = filled(kind)
    words = np.frombuffer(message.record.tobytes(), "<u4").tolist()
    assert crc32(message.record) == crc_by_bits(words[:-1])
    message.sign()
    assert message.intact
    message.record["reserve"] ^= 1
    assert not message.intact


def test_an_empty_command_has_unitrees_crc():
    assert crc32(LowCmd().record) == 1264208000


@pytest.mark.parametrize("wire", [b"", LowCmd().to_wire()[:-4], b"\x00\x07" + LowCmd().to_wire()[2:]])
def test_bytes_of_another_message_are_refused(wire):
    with pytest.raises(ValueError, match="not a LowCmd in XCDR1"):
        LowCmd.from_wire(wire)


@MESSAGES
def test_a_writer_that_leaves_is_noticed(kind):
    participant = DomainParticipant(97)
    topic = Topic(participant, f"rt/{kind.__name__}", kind)
    reader, writer = DataReader(participant, topic), DataWriter(participant, topic)
    writer.write(filled(kind))
    assert reader.take(1)[0].record.tobytes() == filled(kind).record.tobytes()
    writer.dispose(filled(kind))
    assert isinstance(reader.take(1)[0], InvalidSample)
