import itertools

import pytest
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from hypothesis import given, settings
from hypothesis import strategies as st

from sim2real.hardware.bus.packets import Instruction, Packet, Parser
from sim2real.hardware.dynamixel.protocol import HEADER, PROTOCOL, crc16

build = PROTOCOL.build

# Bytes that headers and stuffing are made of come often.
tricky = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0x00, 0x55, 0x03]) | st.integers(0, 255), max_size=40).map(bytes)
packets = st.builds(Packet, st.integers(0, 252), st.sampled_from(list(Instruction)).map(int), tricky)
garbage = tricky.filter(lambda data: HEADER not in data)


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


@given(st.lists(st.tuples(garbage, packets), min_size=1, max_size=5), st.data())
@settings(max_examples=150, deadline=None)
def test_packets_are_found_in_any_chunks_between_any_garbage(pairs, data):
    stream = b"".join(junk + build(p.servo_id, p.code, p.parameters) for junk, p in pairs)
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)), max_size=8)) | {0, len(stream)})
    parser = Parser(PROTOCOL)
    found, ends = [], []
    for begin, end in itertools.pairwise(cuts):
        for packet, at in parser.feed(stream[begin:end]):
            found.append(packet)
            ends.append(begin + at)
    assert found == [packet for _, packet in pairs]
    expected, position = [], 0
    for junk, packet in pairs:
        position += len(junk) + len(build(packet.servo_id, packet.code, packet.parameters))
        expected.append(position)
    assert ends == expected


def test_flipped_bit_is_reported_and_the_next_packet_found():
    broken = bytearray(build(1, Instruction.READ, b"\x84\x00\x04\x00"))
    broken[9] ^= 1
    found = [packet for packet, _ in Parser(PROTOCOL).feed(bytes(broken) + build(2, Instruction.PING))]
    assert [(p.servo_id, p.intact) for p in found] == [(1, False), (2, True)]


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
