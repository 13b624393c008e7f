"""Faults of buses in this process: two servos of one id, which both answer and both obey; alarms of DYNAMIXELs."""

import pytest
from families import STS, VOLTS

from sim2real.errors import HardwareLost, SafetyStop
from sim2real.hardware import dynamixel as reg
from sim2real.hardware import feetech as sts


def answer_twice(robot, servo_id, place, join):
    """Let the answers of one id come from two servos; ``place`` is where a packet has its id."""
    send = robot.bus._send

    def sent(answer):
        return send(join(answer) if answer[place] == servo_id else answer)

    robot.bus._send = sent


def one_after_the_other(answer):
    return answer + answer


def at_once(answer):
    """Of two answers on one line every bit is that of either."""
    return answer[:4] + bytes(byte & (37 * i + 11) for i, byte in enumerate(answer[4:]))


@pytest.mark.parametrize(
    ("family", "place", "join", "said"),
    [
        (STS, 2, one_after_the_other, r"have the id 2 \(joint 'joint2'\): both answer[\s\S]*hint: connect one"),
        (STS, 2, at_once, r"servo 2 .* does not answer[\s\S]*two servos of one id garble"),
        (VOLTS, 4, one_after_the_other, r"two servos on .* have the id 2.*both answer, and both would obey"),
    ],
)
def test_two_answers_to_one_ping_are_refused(family, place, join, said):
    robot = family.robot()
    answer_twice(robot, 2, place, join)
    with pytest.raises(HardwareLost, match=said):
        family.device(robot, max_silence_s=0.1).open()


def test_a_late_answer_is_no_second_servo():
    for seed in range(3):
        robot = STS.robot(settings={"return_delay_us": 0, "seed": seed, "late": 0.3, "late_s": 0.012})
        with STS.device(robot, silence_s=1.0):
            pass


ALARMS = {
    VOLTS: ("input voltage", "", "overheating", "motor encoder", "electrical shock", "overload"),
    STS: ("input voltage", "encoder", "overheating", "overcurrent", "", "overload"),
}
CASES = [(family, bit) for family, names in ALARMS.items() for bit, name in enumerate(names) if name]


@pytest.mark.parametrize(("family", "bit"), CASES, ids=[f"{f.name}-{ALARMS[f][bit]}" for f, bit in CASES])
def test_an_alarm_in_motion_is_named_and_torque_ends_off(family, bit):
    """As when the supply breaks down under load."""
    robot = family.robot()
    with family.rig(robot) as rig:
        rig.start()
        rig.command(family.moving, 0.0, 1e-9 * robot.now_ns())
        rig.measure()
        robot.bus.servos[2].put(reg.HARDWARE_ERROR_STATUS if family is VOLTS else sts.STATUS, 1 << bit)
        with pytest.raises(SafetyStop, match=f"servo 2 .*: {ALARMS[family][bit]}"):
            rig.measure()
    assert family.on(robot) == []


def test_a_host_that_dies_while_its_cable_is_out_leaves_the_torque_on():
    """The guardian reaches no servo either, and says so."""
    robot = STS.robot()
    device = STS.device(robot, silence_s=0.1)
    device.open()
    device.enable()
    robot.strike(silent_after_s=0.0)
    robot.kill_host()
    assert STS.on(robot) == [1, 2, 3]
    assert "could NOT be confirmed" in robot.reports[0]


def test_answers_behind_a_lost_one_are_not_late():
    with STS.device(STS.robot(settings={"reply_loss": 0.1, "seed": 1})) as device:
        for _ in range(50):
            device.measure()
        counters = device.counters
    assert counters.lost_replies > 10
    assert counters.late_replies == 0
