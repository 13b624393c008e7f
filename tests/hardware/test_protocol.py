"""Packets of both families: against the manuals, the vendor's SDK, and garbage between them."""

import itertools

import pytest
from dynamixel_sdk.protocol2_packet_handler import Protocol2PacketHandler
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sim2real.hardware.bus.packets import Instruction, Packet, Parser
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.dynamixel import HEADER, PROTOCOL, crc16
from sim2real.hardware.feetech import HEADER as STS_HEADER
from sim2real.hardware.feetech import PROTOCOL as STS_PROTOCOL
from sim2real.hardware.feetech import TORQUE_ENABLE

build, sts = PROTOCOL.build, STS_PROTOCOL.build

# Bytes that headers and stuffing are made of come often.
tricky = st.lists(st.sampled_from([0xFF, 0xFF, 0xFD, 0, 0x55, 3, 1]) | st.integers(0, 255), max_size=40).map(bytes)
packets = st.builds(Packet, st.integers(0, 252), st.sampled_from(list(Instruction)).map(int), tricky)
FORMATS = pytest.mark.parametrize("form", [PROTOCOL, STS_PROTOCOL], ids=["DYNAMIXEL", "Feetech"])


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


GOAL = b"\x00\x08\x00\x00\xe8\x03"


@pytest.mark.parametrize(
    ("packet", "manual"),
    [
        (build(1, Instruction.PING), "FF FF FD 00 01 03 00 01 19 4E"),
        (PROTOCOL.build_status(1, 0, b"\x06\x04\x26"), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
        (sts(1, Instruction.PING), "FF FF 01 02 01 FB"),
        (sts(1, Instruction.READ, b"\x38\x02"), "FF FF 01 04 02 38 02 BE"),
        (sts(0xFE, Instruction.WRITE, b"\x05\x01"), "FF FF FE 04 03 05 01 F4"),
        (sts(1, Instruction.WRITE, b"\x2a" + GOAL), "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5"),
        (sts(10, 0x04, b"\x2a" + GOAL), "FF FF 0A 09 04 2A 00 08 00 00 E8 03 CB"),
        (sts(0xFE, 0x05), "FF FF FE 02 05 FA"),
        (sts(0xFE, Instruction.SYNC_READ, b"\x38\x08\x01\x02"), "FF FF FE 06 82 38 08 01 02 36"),
        (sts(1, 0, b"\x18\x05"), "FF FF 01 04 00 18 05 DD"),
        (
            STS_PROTOCOL.write_each(
                Register("goal", 0x2A, 6), dict.fromkeys(range(1, 5), int.from_bytes(GOAL, "little"))
            ),
            "FF FF FE 20 83 2A 06 01 00 08 00 00 E8 03 02 00 08 00 00 E8 03 03 00 08 00 00 E8 03 04 00 08 00 00 E8 03"
            "58",
        ),
    ],
)
def test_packets_are_those_of_the_manuals_examples(packet, manual):
    assert packet == bytes.fromhex(manual)
    form = PROTOCOL if packet.startswith(HEADER) else STS_PROTOCOL
    ((found, end),) = Parser(form).feed(packet)
    assert found.intact
    assert end == len(packet)
    assert form.build(found.servo_id, found.code, found.parameters) == packet


SKIPPED = [HEADER + b"\x01" + length.to_bytes(2, "little") for length in (0, 2, 2000, 65535)]


@pytest.mark.parametrize(
    ("form", "junk"),
    [
        *((PROTOCOL, junk) for junk in SKIPPED),
        (PROTOCOL, HEADER + b"\x01\x14\x00"),  # a length that reaches beyond the packets behind it
        (STS_PROTOCOL, b"\xff"),  # a third one is no id
        (STS_PROTOCOL, STS_HEADER + b"\x01\x01"),
    ],
)
def test_lengths_that_cannot_be_swallow_no_packet_behind_them(form, junk):
    stream = junk + form.build(3, Instruction.PING) + form.build(4, Instruction.PING)
    assert [p.servo_id for p, _ in Parser(form).feed(stream) if p.intact] == [3, 4]


def test_every_alarm_can_come_with_torque_off():
    assert STS_PROTOCOL.write_each(TORQUE_ENABLE, {1: 0, 7: 0}) == sts(0xFE, 0x83, b"\x28\x01\x01\x00\x07\x00")
    ((query, answers),) = STS_PROTOCOL.torque_queries(TORQUE_ENABLE, (7,))
    assert query == sts(7, Instruction.READ, b"\x28\x01")
    assert len(set(answers)) == 32
    assert {sts(7, 0, b"\0"), sts(7, 0b100101, b"\0")} <= set(answers)
