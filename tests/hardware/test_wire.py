"""Timing of the emulated bus in virtual time, where every instant can be told exactly."""

import math
import struct
from types import ModuleType
from typing import NamedTuple

import numpy as np
import pytest

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.feetech import StsEmulation
from sim2real.emulation.truth import Kind
from sim2real.errors import UsageError
from sim2real.hardware import dynamixel as reg
from sim2real.hardware import feetech as sts_reg
from sim2real.hardware.bus.packets import BROADCAST_ID, Instruction, PacketFormat
from sim2real.hardware.device import OperatingMode
from sim2real.hardware.dynamixel import PROTOCOL
from sim2real.hardware.feetech import PROTOCOL as STS_PROTOCOL

MS = 1_000_000
STEP_NS = 500_000
build = PROTOCOL.build
READ_POSITION = build(1, Instruction.READ, b"\x84\x00\x04\x00")


class Line(NamedTuple):
    """What a read of positions names, and where its answer has the id, the position and its end."""

    settings: type
    protocol: PacketFormat
    registers: ModuleType
    position: bytes
    id_at: int
    data: slice
    answer_bytes: int

    def read(self):
        return self.protocol.build(1, Instruction.READ, self.position)

    def goals(self):
        return self.protocol.write_each(self.registers.GOAL_POSITION, {i: 2000 + i for i in (1, 2, 3)})


LINES = [
    pytest.param(Line(EmulatorConfig, PROTOCOL, reg, b"\x84\x00\x04\x00", 4, slice(9, 13), 15), id="DYNAMIXEL"),
    pytest.param(Line(StsEmulation, STS_PROTOCOL, sts_reg, b"\x38\x02", 2, slice(5, 7), 8), id="Feetech"),
]


@pytest.mark.parametrize("baud_rate", [1_000_000, 57_600])
@pytest.mark.parametrize("line", LINES)
def test_an_answer_takes_the_time_of_its_bytes_and_the_return_delay(make_bench, line, baud_rate):
    bench = make_bench("Ramp", line.settings(return_delay_us=100, baud_rate=baud_rate))
    bench.send(50 * MS, line.read())
    bench.run_until(80 * MS)
    ((t_ns, answer),) = bench.sent
    assert len(answer) == line.answer_bytes
    assert t_ns == pytest.approx(50 * MS + (len(line.read()) + len(answer)) * 1e10 / baud_rate + 100_000, abs=2)


@pytest.mark.parametrize("line", LINES)
def test_several_servos_answer_one_after_the_other_in_the_order_asked(make_bench, line):
    bench = make_bench("Ramp", line.settings(return_delay_us=0), ids=[1, 2, 3])
    packet = line.protocol.build(BROADCAST_ID, Instruction.SYNC_READ, line.position + bytes([3, 9, 1]))
    bench.send(50 * MS, packet)
    bench.run_until(60 * MS)
    begin_ns, each_ns = 50 * MS + len(packet) * 10_000, line.answer_bytes * 10_000
    assert [(t_ns, answer[line.id_at]) for t_ns, answer in bench.sent] == [
        (begin_ns + each_ns, 3),
        (begin_ns + 2 * each_ns, 1),
    ]


@pytest.mark.parametrize("latency_s", [0.0, 0.0001, 0.0037, 0.02])
@pytest.mark.parametrize("line", LINES)
def test_a_sample_is_as_old_as_the_sensing_latency(make_bench, line, latency_s):
    bench = make_bench("Ramp", line.settings(return_delay_us=0, sensing_latency_s=latency_s))
    bench.send(3_000 * MS + 123_457, line.read())
    bench.run_until(3_010 * MS)
    (sample,) = bench.truth().of(Kind.SAMPLE)
    assert sample["t_ns"] == 3_000 * MS + 123_457 + len(line.read()) * 10_000 - round(latency_s * 1e9)
    # The plant's position is a ramp: what was read tells when it was sampled.
    shown = line.registers.PRESENT_POSITION.decode(bench.sent[0][1][line.data])
    assert shown == round(0.4 * sample["t_ns"] * 1e-9 / reg.RAD_PER_COUNT)


@pytest.mark.parametrize("latency_s", [0.0, 0.006, 0.03])
@pytest.mark.parametrize("line", LINES)
def test_goals_take_effect_after_the_actuation_latency_at_all_servos_at_once(make_bench, line, latency_s):
    config = line.settings(return_delay_us=0, actuation_latency_s=latency_s, actuation_jitter_s=latency_s / 2, seed=1)
    bench = make_bench("Joints", config)
    for servo in bench.servos.values():
        servo.put(line.registers.TORQUE_ENABLE, 1)
    sent_ns = np.array([50 * MS + i * 47_123_457 for i in range(20)])
    for t_ns in sent_ns.tolist():
        bench.send(t_ns, line.goals())
    bench.run_until(1_100 * MS)
    effects = bench.truth().of(Kind.EFFECT)
    instants_ns = effects["t_ns"].reshape(20, 3)
    assert np.all(instants_ns == instants_ns[:, :1])
    assert effects["values"][:3, 1] / reg.RAD_PER_COUNT == pytest.approx([2001, 2002, 2003])
    assert np.array_equal(effects["t_host_ns"].reshape(20, 3)[:, 0], sent_ns)
    # On the plant's grid, after the bytes and the latency, which is drawn for each instruction.
    assert np.all(effects["t_ns"] % STEP_NS == 0)
    assert np.all(np.abs(effects["late_ns"]) <= STEP_NS / 2)
    took_s = 1e-9 * ((effects["t_ns"] - effects["late_ns"]).reshape(20, 3)[:, 0] - sent_ns - len(line.goals()) * 10_000)
    assert np.all(np.abs(took_s - latency_s) <= latency_s / 2 + 1e-9)
    assert np.ptp(took_s) >= 0.5 * latency_s


def start_turning(bench, servo_id=1, pwm=885, watchdog=0):
    """Put a servo into PWM mode with torque on, past the wire."""
    servo = bench.servos[servo_id]
    servo.put(reg.OPERATING_MODE, OperatingMode.PWM)
    for register, value in ((reg.TORQUE_ENABLE, 1), (reg.BUS_WATCHDOG, watchdog), (reg.GOAL_PWM, pwm)):
        servo.write(register.address, register.encode(value))


@pytest.mark.parametrize(
    ("packet", "tripped"),
    [
        (build(2, Instruction.PING), [1]),
        (build(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x41\x00\x01\x00\x02\x01"), []),
    ],
    ids=["for another servo", "broadcast"],
)
def test_traffic_that_feeds_the_watchdog(make_bench, packet, tripped):
    bench = make_bench(ids=[1, 2])
    start_turning(bench, watchdog=5)
    for i in range(30):
        bench.send(50 * MS + i * 9 * MS, packet)
    assert [row["servo_id"] for row in bench.truth().of(Kind.WATCHDOG)] == tripped


def goal_pwm(value, servo_id=1):
    return build(servo_id, Instruction.WRITE, b"\x64\x00" + value.to_bytes(2, "little", signed=True))


def test_true_speed_answers_from_the_effect_on(make_bench):
    bench = make_bench(config=EmulatorConfig(return_delay_us=0, actuation_latency_s=0.0200))
    start_turning(bench, pwm=0)
    bench.send(100 * MS, goal_pwm(885))
    bench.run_until(400 * MS)
    truth = bench.truth()
    t_ns, states = truth.states()
    (effect,) = truth.of(Kind.EFFECT)
    age_s = (t_ns - effect["t_ns"]) * 1e-9
    expected = np.where(age_s > 0, 6.0 * (1.0 - np.exp(-age_s / 0.05)), 0.0)
    assert np.abs(states["dq1"] - expected).max() < 0.02
    assert np.diff(t_ns).tolist() == [5 * MS] * (len(t_ns) - 1)


def test_jitter_is_uniform_and_keeps_the_order(make_bench):
    config = EmulatorConfig(actuation_latency_s=0.01, actuation_jitter_s=0.01, sensing_latency_s=0.004, seed=3)
    bench = make_bench(config=EmulatorConfig(**{**config.__dict__, "sensing_jitter_s": 0.002}))
    start_turning(bench)
    for i in range(300):
        bench.send((50 + 4 * i) * MS, goal_pwm(i), READ_POSITION)
    bench.run_until(1400 * MS)
    truth = bench.truth()
    effects = truth.of(Kind.EFFECT)
    assert np.all(np.diff(effects["t_ns"]) >= 0)
    assert np.allclose(effects["values"][:, 1] * 885, np.arange(300))
    samples = truth.of(Kind.SAMPLE)
    age_s = (samples["t_host_ns"] + 27 * 10_000 - samples["t_ns"]) * 1e-9
    assert age_s.min() == pytest.approx(0.002, abs=1e-4)
    assert age_s.max() == pytest.approx(0.006, abs=1e-4)
    assert age_s.mean() == pytest.approx(0.004, abs=3e-4)


def test_half_duplex_wire_makes_instructions_wait(make_bench):
    bench = make_bench("Ramp")
    bench.send(50 * MS, READ_POSITION)
    bench.run_until(50 * MS + 200_000)  # the answer is on the wire
    bench.send(50 * MS + 200_000, READ_POSITION)
    bench.run_until(60 * MS)
    assert [t_ns for t_ns, _ in bench.sent] == [50 * MS + 290_000, 50 * MS + 580_000]


def test_watchdog_trips_exactly_when_nothing_was_heard(make_bench):
    bench = make_bench(config=EmulatorConfig(return_delay_us=0, actuation_latency_s=0.01))
    start_turning(bench, watchdog=5)
    for i in range(10):
        bench.send((50 + 90 * i) * MS, goal_pwm(100 + i))
    last_ns = (50 + 90 * 9) * MS + len(goal_pwm(0)) * 10_000
    bench.run_until(last_ns + 300 * MS)
    truth = bench.truth()
    assert truth.of(Kind.WATCHDOG)["t_ns"].tolist() == [last_ns + 100 * MS]
    final = truth.of(Kind.EFFECT)[-1]
    assert final["values"][:2].tolist() == [16.0, 0.0]
    assert abs(final["t_ns"] - last_ns - 100 * MS) <= STEP_NS
    assert final["t_host_ns"] == 0


def test_watchdog_drops_what_the_host_still_had_on_the_way(make_bench):
    bench = make_bench(config=EmulatorConfig(actuation_latency_s=0.05))
    start_turning(bench, watchdog=1)
    bench.send(10 * MS, goal_pwm(885))
    bench.run_until(200 * MS)
    assert bench.truth().of(Kind.EFFECT)["values"][:, 1].tolist() == [0.0]


def test_rest_of_a_packet_that_never_comes_is_forgotten(make_bench):
    bench = make_bench("Ramp")
    bench.send(50 * MS, READ_POSITION[:9])
    bench.send(60 * MS, READ_POSITION)
    bench.run_until(70 * MS)
    assert len(bench.sent) == 1


@pytest.mark.parametrize(
    "bad", [{"sensing_jitter_s": 0.001}, {"reply_loss": 1.5}, {"plant_step_s": 0.01}, {"return_delay_us": 600}]
)
def test_configurations_that_make_no_sense(bad):
    with pytest.raises(UsageError, match=next(iter(bad))):
        EmulatorConfig(**bad)


def write(register, value, servo_id=1):
    return build(servo_id, Instruction.WRITE, register.address.to_bytes(2, "little") + register.encode(value))


def sync_write(register, values):
    head = register.address.to_bytes(2, "little") + register.size.to_bytes(2, "little")
    items = b"".join(bytes((servo_id,)) + register.encode(value) for servo_id, value in values.items())
    return build(BROADCAST_ID, Instruction.SYNC_WRITE, head + items)


def test_plants_are_told_of_their_controllers_when_those_change(make_bench):
    bench = make_bench("Joints")
    assert bench.plant.told == [(0.0, i, 640, 4000, math.inf) for i in (1, 2, 3)]
    bench.plant.told.clear()
    bench.send(50 * MS, sync_write(reg.POSITION_P_GAIN, {1: 800, 3: 900}))
    bench.send(60 * MS, write(reg.POSITION_D_GAIN, 0))
    bench.send(70 * MS, write(reg.PROFILE_VELOCITY, 100))
    bench.send(80 * MS, write(reg.PROFILE_VELOCITY, 100), write(reg.LED, 1))
    bench.send(110 * MS, build(1, Instruction.REBOOT))
    bench.run_until(120 * MS)
    speed = reg.RAD_S_PER_COUNT
    assert [told[1:] for told in bench.plant.told] == [
        (1, 800, 4000, math.inf),
        (3, 900, 4000, math.inf),
        (1, 800, 0, math.inf),
        (1, 800, 0, pytest.approx(100 * speed)),
        (1, 640, 4000, math.inf),
    ]
    assert [told[0] for told in bench.plant.told] == pytest.approx([0.05, 0.05, 0.06, 0.07, 0.11], abs=1e-3)


def test_torque_on_in_position_mode_moves_nothing_until_a_goal_comes(make_bench):
    bench = make_bench("Joints")
    for servo_id in (1, 2, 3):
        bench.send((10 + servo_id) * MS, write(reg.TORQUE_ENABLE, 1, servo_id))
    bench.run_until(200 * MS)
    assert [bench.plant.state()[f"q{i}"] for i in (1, 2, 3)] == pytest.approx([0.5, -0.8, 0.3], abs=reg.RAD_PER_COUNT)
    bench.send(210 * MS, sync_write(reg.GOAL_POSITION, {1: 2048, 3: 3000}))
    bench.run_until(1500 * MS)
    counts = [0, -0.8 / reg.RAD_PER_COUNT, 3000 - 2048]
    assert [bench.plant.state()[f"q{i}"] / reg.RAD_PER_COUNT for i in (1, 2, 3)] == pytest.approx(counts, abs=1)
    bench.send(1510 * MS, sync_write(reg.TORQUE_ENABLE, {1: 0, 2: 0, 3: 0}))
    bench.run_until(1520 * MS)
    assert bench.truth().of(Kind.EFFECT)["values"][-3:, 0].tolist() == [0.0] * 3


def read_state(bench, t_ns):
    """Return velocity and position [counts] of servo 1, read at a time, and when the answer came."""
    bench.send(t_ns, build(1, Instruction.READ, bytes((128, 0, 8, 0))))
    bench.run_until(t_ns + 19 * MS)
    ((arrived_ns, answer),) = [bench.sent.pop() for _ in range(len(bench.sent))]
    return *struct.unpack("<ii", answer[9:17]), arrived_ns


def test_late_answers_come_in_order(make_bench):
    bench = make_bench("Ramp", EmulatorConfig(return_delay_us=0, late=0.3, late_s=0.009))
    arrived_ms = np.array([read_state(bench, 20 * i * MS)[2] / MS - 20 * i for i in range(1, 30)])
    late = arrived_ms > 8.0
    assert 3 < late.sum() < 20
    assert np.ptp(arrived_ms[~late]) < 0.01
    np.testing.assert_allclose(arrived_ms[late] - arrived_ms[~late].mean(), 9.0, atol=0.01)
    for i in range(6):
        bench.send((700 + i) * MS, build(1, Instruction.PING))
    bench.run_until(900 * MS)
    assert np.all(np.diff([t_ns for t_ns, _ in bench.sent]) >= 0)
