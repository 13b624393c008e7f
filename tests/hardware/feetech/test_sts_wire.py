"""The emulated bus and its servos in virtual time, where every instant can be told exactly."""

import math

import pytest

from sim2real.emulation.feetech import StsEmulation
from sim2real.emulation.truth import Kind
from sim2real.errors import UsageError
from sim2real.hardware import feetech as reg
from sim2real.hardware.bus.packets import BROADCAST_ID, Instruction
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.feetech import PROTOCOL

MS = 1_000_000
build = PROTOCOL.build
READ_STATE = build(1, Instruction.READ, b"\x38\x06")
OK = bytes.fromhex("FFFF010200FC")


def write(register, value, servo_id=1):
    return build(servo_id, Instruction.WRITE, bytes((register.address,)) + register.encode(value))


def read(bench, register, servo_id=1):
    answer = bench.ask(build(servo_id, Instruction.READ, bytes((register.address, register.size))))
    return register.decode(answer[5:-1])


def stiffen(bench):
    """Let the plant follow its goals fast."""
    bench.ask(write(reg.P_GAIN, 254))


def at(*counts):
    """Where the joints of the plant must be for their servos to read these counts [rad]."""
    return [count * reg.RAD_PER_COUNT - math.pi for count in counts]


def test_answers_are_those_of_the_manuals_examples(make_sts):
    bench = make_sts(ids=[1, 2], start_rad=at(2048, 2047))
    for servo_id, voltage, temperature in ((1, 0x79, 0x1E), (2, 0x77, 0x23)):
        bench.servos[servo_id].put(reg.PRESENT_VOLTAGE, voltage)
        bench.servos[servo_id].put(reg.PRESENT_TEMPERATURE, temperature)
    assert bench.ask(bytes.fromhex("FFFF010201FB")) == OK
    assert bench.ask(bytes.fromhex("FFFF0109032A00080000E803D5")) == OK
    assert bench.ask(bytes.fromhex("FFFFFE0682380801 0236")) == bytes.fromhex(
        "FFFF010A0000080000 0000791E55 FFFF020A00FF070000 0000772353"
    )


@pytest.mark.parametrize("wakes", [True, False])
def test_torque_and_goals(make_sts, wakes):
    bench = make_sts("Joints", StsEmulation(goal_wakes=wakes), ids=[1], start_rad=at(2000))
    stiffen(bench)
    bench.ask(write(reg.GOAL_POSITION, 2100))
    assert read(bench, reg.TORQUE_ENABLE) == wakes
    bench.ask(write(reg.TORQUE_ENABLE, 1))
    bench.run_until(1_500 * MS)
    assert read(bench, reg.PRESENT_POSITION) == pytest.approx(2100, abs=1)
    bench.ask(write(reg.TORQUE_ENABLE, 0))
    assert bench.truth().of(Kind.EFFECT)[-1]["values"][0] == OperatingMode.OFF


def test_what_is_written_while_the_lock_is_on_is_forgotten_without_power(make_sts):
    bench = make_sts(ids=[1], start_rad=at(2000))
    for lock, p_gain in ((0, 20), (1, 40)):
        bench.ask(write(reg.LOCK, lock))
        bench.ask(write(reg.P_GAIN, p_gain))
        assert read(bench, reg.P_GAIN) == p_gain
    bench.ask(write(reg.GOAL_POSITION, 2000))
    bench.ask(build(1, Instruction.REBOOT))
    assert read(bench, reg.P_GAIN) == 20
    assert read(bench, reg.LOCK) == 1
    assert read(bench, reg.TORQUE_ENABLE) == 0
    assert bench.plant.told[-1][2:4] == (20, 32)


def test_the_offset_moves_what_is_read_and_where_goals_are(make_sts):
    bench = make_sts("Joints", StsEmulation(homing_offset=-500), ids=[1], start_rad=at(1500))
    assert read(bench, reg.PRESENT_POSITION) == 2000
    stiffen(bench)
    bench.ask(write(reg.GOAL_POSITION, 2048))
    bench.run_until(2_000 * MS)
    with pytest.raises(UsageError, match="homing_offset"):
        StsEmulation(homing_offset=3000)
    assert bench.plant.measure(1)[0] / reg.RAD_PER_COUNT == pytest.approx(1548, abs=1)
    assert read(bench, reg.PRESENT_POSITION) == pytest.approx(2048, abs=1)


def test_positions_wrap_unless_turns_are_counted(make_sts):
    bench = make_sts("Joints", StsEmulation(homing_offset=300), ids=[1], start_rad=at(200))
    assert read(bench, reg.PRESENT_POSITION) == 3996
    bench.ask(write(reg.PHASE, reg.PHASE.default | reg.PHASE_FULL_ANGLE))
    assert read(bench, reg.PRESENT_POSITION) == -100


def test_goals_are_cut_to_the_limits_and_bad_values_dropped_without_a_word(make_sts):
    bench = make_sts(ids=[1], start_rad=at(2000))
    stiffen(bench)
    bench.ask(write(reg.MAX_POSITION, 2050))
    assert bench.ask(write(reg.GOAL_POSITION, 3000)) == OK
    for register, value in ((reg.OPERATING_MODE, 9), (reg.PRESENT_POSITION, 5), (reg.ID, 7)):
        assert bench.ask(write(register, value)) == OK
    assert (read(bench, reg.OPERATING_MODE), read(bench, reg.ID)) == (0, 1)
    bench.run_until(2_000 * MS)
    assert read(bench, reg.PRESENT_POSITION) == pytest.approx(2050, abs=1)


def test_the_response_level_and_broken_or_strange_instructions(make_sts):
    bench = make_sts()
    bench.ask(write(reg.RESPONSE_LEVEL, 0))
    assert bench.ask(write(reg.ACCELERATION, 3)) == b""
    assert read(bench, reg.ACCELERATION) == 3
    broken = bytearray(build(2, Instruction.PING))
    broken[-1] ^= 1
    assert bench.ask(bytes(broken)) == b""
    assert bench.ask(build(2, 0x77)) == b""
    assert bench.ask(build(BROADCAST_ID, Instruction.PING)) == b""  # three at once
    assert bench.ask(build(2, Instruction.PING)) == bytes.fromhex("FFFF020200FB")


def test_an_alarm_is_in_every_answer_and_the_motor_off_until_the_servo_restarts(make_sts):
    bench = make_sts("Joints", ids=[1], start_rad=at(2000))
    bench.ask(write(reg.GOAL_POSITION, 2048))
    bench.servos[1].put(reg.STATUS, 0x21)
    answer = bench.ask(READ_STATE)
    assert answer[4] == 0x21
    assert read(bench, reg.TORQUE_ENABLE) == 1
    bench.ask(write(reg.GOAL_POSITION, 2060))
    bench.ask(build(1, Instruction.REBOOT))
    assert bench.ask(READ_STATE)[4] == 0
    modes = bench.truth().of(Kind.EFFECT)["values"][:, 0]
    assert modes.tolist() == [OperatingMode.POSITION] + [OperatingMode.OFF] * 2


def test_wrong_ids_and_cut_answers(make_sts):
    bench = make_sts("Ramp", StsEmulation(wrong_id=0.3, cut=0.3, seed=1))
    answers = [bench.ask(READ_STATE) for _ in range(60)]
    assert 10 < sum(len(answer) == 4 for answer in answers) < 30
    assert 10 < sum(answer[2] == 0x41 for answer in answers) < 30
