import itertools

import pytest
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sim2real.hardware.bus.packets import Instruction, Packet, Parser
from sim2real.hardware.dynamixel import HEADER, PROTOCOL, crc16
from sim2real.hardware.feetech import PROTOCOL as STS_PROTOCOL

build = PROTOCOL.build

# Bytes that headers and stuffing are made of come often.
tricky = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0, 0x55, 3, 1]) | st.integers(0, 255), max_size=40).map(bytes)
packets = st.builds(Packet, st.integers(0, 252), st.sampled_from(list(Instruction)).map(int), tricky)
FORMATS = pytest.mark.parametrize("form", [PROTOCOL, STS_PROTOCOL], ids=["DYNAMIXEL", "Feetech"])


def test_crc_of_the_manuals_example():
    # e-Manual, Protocol 2.0, "Ping": ID 1.
    assert build(1, Instruction.PING) == bytes.fromhex("FFFFFD00 01 0300 01 194E")


@given(packets)
@settings(max_examples=100, deadline=None)
def test_packets_are_those_of_the_sdk(packet):
    sdk = Protocol2PacketHandler()
    body = [packet.code, *packet.parameters]
    plain = [*HEADER, packet.servo_id, (len(body) + 2) & 0xFF, (len(body) + 2) >> 8, *body, 0, 0]
    stuffed = bytes(sdk.addStuffing(plain))[:-2]
    expected = stuffed + sdk.updateCRC(0, list(stuffed), len(stuffed)).to_bytes(2, "little")
    assert build(packet.servo_id, packet.code, packet.parameters) == expected
    assert crc16(stuffed) == sdk.updateCRC(0, list(stuffed), len(stuffed))


@pytest.mark.parametrize("length", [0, 2, 2000, 65535])
def test_impossible_length_is_skipped(length):
    stream = HEADER + b"\x01" + length.to_bytes(2, "little") + build(3, Instruction.PING)
    assert [p.servo_id for p, _ in Parser(PROTOCOL).feed(stream)] == [3]


def test_broken_length_does_not_swallow_the_packets_behind_it():
    stream = HEADER + b"\x01\x14\x00" + build(3, Instruction.PING) + build(4, Instruction.PING)
    found = [p for p, _ in Parser(PROTOCOL).feed(stream)]
    assert [p.servo_id for p in found if p.intact] == [3, 4]


def test_status_packet():
    assert Parser(PROTOCOL).feed(PROTOCOL.build_status(7, 6, b"\xff\xff\xfd"))[0][0] == Packet(
        7, 0x55, b"\x06\xff\xff\xfd"
    )


@FORMATS
@given(st.lists(st.tuples(tricky, packets), min_size=1, max_size=5), st.data())
@settings(max_examples=100, deadline=None)
def test_packets_are_found_in_any_chunks_between_any_garbage(form, pairs, data):
    # Garbage that begins a header, or ends as one, would be the begin of another packet.
    header = HEADER if form is PROTOCOL else b"\xff"
    pairs = [(junk.replace(header, b""), packet) for junk, packet in pairs]
    assume(not any(header in junk for junk, _ in pairs))
    wholes = [junk + form.build(p.servo_id, p.code, p.parameters) for junk, p in pairs]
    stream = b"".join(wholes)
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)), max_size=8)) | {0, len(stream)})
    parser = Parser(form)
    found = [
        (packet, begin + at) for begin, end in itertools.pairwise(cuts) for packet, at in parser.feed(stream[begin:end])
    ]
    ends = itertools.accumulate(len(whole) for whole in wholes)
    assert found == [(packet, end) for (_, packet), end in zip(pairs, ends, strict=True)]


@FORMATS
def test_a_flipped_bit_is_reported_and_the_next_packet_found(form):
    broken = bytearray(form.build(1, Instruction.READ, b"\x84\x00\x04\x00"))
    broken[-3] ^= 1
    found = [packet for packet, _ in Parser(form).feed(bytes(broken) + form.build(2, Instruction.PING))]
    assert [(p.servo_id, p.intact) for p in found] == [(1, False), (2, True)]
