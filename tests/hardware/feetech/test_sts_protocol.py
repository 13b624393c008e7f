import pytest

from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.packets import Instruction, Parser
from sim2real.hardware.bus.registers import Register
from sim2real.hardware.feetech import HEADER, PROTOCOL

build = PROTOCOL.build

GOAL = b"\x00\x08\x00\x00\xe8\x03"


@pytest.mark.parametrize(
    ("packet", "manual"),
    [
        (build(1, Instruction.PING), "FF FF 01 02 01 FB"),
        (build(1, Instruction.READ, b"\x38\x02"), "FF FF 01 04 02 38 02 BE"),
        (build(0xFE, Instruction.WRITE, b"\x05\x01"), "FF FF FE 04 03 05 01 F4"),
        (build(1, Instruction.WRITE, b"\x2a" + GOAL), "FF FF 01 09 03 2A 00 08 00 00 E8 03 D5"),
        (build(10, 0x04, b"\x2a" + GOAL), "FF FF 0A 09 04 2A 00 08 00 00 E8 03 CB"),
        (build(0xFE, 0x05), "FF FF FE 02 05 FA"),
        (build(0xFE, Instruction.SYNC_READ, b"\x38\x08\x01\x02"), "FF FF FE 06 82 38 08 01 02 36"),
        (build(1, 0, b"\x18\x05"), "FF FF 01 04 00 18 05 DD"),
        (
            PROTOCOL.write_each(Register("goal", 0x2A, 6), dict.fromkeys(range(1, 5), int.from_bytes(GOAL, "little"))),
            "FF FF FE 20 83 2A 06 01 00 08 00 00 E8 03 02 00 08 00 00 E8 03 03 00 08 00 00 E8 03 04 00 08 00 00 E8 03"
            "58",
        ),
    ],
)
def test_packets_are_those_of_the_manuals_examples(packet, manual):
    assert packet == bytes.fromhex(manual)
    ((found, end),) = Parser(PROTOCOL).feed(packet)
    assert found.intact
    assert end == len(packet)
    assert build(found.servo_id, found.code, found.parameters) == packet


def test_a_third_ff_is_no_id_and_a_length_below_2_no_packet():
    stream = b"\xff" + build(3, Instruction.PING) + HEADER + b"\x01\x01" + build(4, Instruction.PING)
    assert [p.servo_id for p, _ in Parser(PROTOCOL).feed(stream)] == [3, 4]


def test_every_alarm_can_come_with_torque_off():
    assert PROTOCOL.write_each(reg.TORQUE_ENABLE, {1: 0, 7: 0}) == build(0xFE, 0x83, b"\x28\x01\x01\x00\x07\x00")
    ((query, answers),) = PROTOCOL.torque_queries(reg.TORQUE_ENABLE, (7,))
    assert query == build(7, Instruction.READ, b"\x28\x01")
    assert len(set(answers)) == 32
    assert {build(7, 0, b"\0"), build(7, 0b100101, b"\0")} <= set(answers)
