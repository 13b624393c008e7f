"""Timing of the emulated bus in virtual time, where every instant can be told exactly."""

import math
import struct

import numpy as np
import pytest
from plants import lateness_s, mean_latencies

from sim2real.errors import UsageError
from sim2real.hardware.bus.packets import BROADCAST_ID, Instruction
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.emulation import EmulatorConfig
from sim2real.hardware.dynamixel.protocol import PROTOCOL
from sim2real.hardware.emulation.truth import Kind
from sim2real.hardware.plant import ConfigurablePlant

MS = 1_000_000
STEP_NS = 500_000
build = PROTOCOL.build
READ_POSITION = build(1, Instruction.READ, b"\x84\x00\x04\x00")


def goal_pwm(value, servo_id=1):
    return build(servo_id, Instruction.WRITE, b"\x64\x00" + value.to_bytes(2, "little", signed=True))


def position_rad(answer):
    return int.from_bytes(answer[9:13], "little", signed=True) * reg.RAD_PER_COUNT


def test_read_takes_the_time_of_its_bytes_and_the_return_delay(make_bench):
    bench = make_bench("Ramp", EmulatorConfig(return_delay_us=100))
    bench.send(50 * MS, READ_POSITION)
    bench.run_until(60 * MS)
    ((t_ns, answer),) = bench.sent
    assert len(READ_POSITION) == 14
    assert len(answer) == 15
    assert t_ns == 50 * MS + (14 + 15) * 10_000 + 100_000


def test_baud_rate_stretches_every_byte(make_bench):
    bench = make_bench("Ramp", EmulatorConfig(return_delay_us=0, baud_rate=57_600))
    bench.send(50 * MS, READ_POSITION)
    bench.run_until(80 * MS)
    assert bench.sent[0][0] == pytest.approx(50 * MS + (14 + 15) * 1e10 / 57_600, abs=2)


@pytest.mark.parametrize("latency_s", [0.0, 0.0001, 0.0037, 0.02])
def test_sample_is_as_old_as_the_sensing_latency(make_bench, latency_s):
    bench = make_bench("Ramp", EmulatorConfig(return_delay_us=0, sensing_latency_s=latency_s))
    bench.send(3_000 * MS + 123_457, READ_POSITION)
    bench.run_until(3_010 * MS)
    complete_ns = 3_000 * MS + 123_457 + 14 * 10_000
    (sample,) = bench.truth().of(Kind.SAMPLE)
    assert sample["t_ns"] == complete_ns - round(latency_s * 1e9)
    # The plant's position is a ramp: what was read tells when it was sampled.
    expected_rad = bench.plant.speed_rad_s * sample["t_ns"] * 1e-9
    assert sample["values"][0] == pytest.approx(expected_rad, abs=1e-9)
    assert position_rad(bench.sent[0][1]) == pytest.approx(expected_rad, abs=reg.RAD_PER_COUNT / 2 * 1.001)


@pytest.mark.parametrize("latency_s", [0.0, 0.0049, 0.03])
def test_goal_takes_effect_after_the_actuation_latency(make_bench, latency_s):
    bench = make_bench("FirstOrder", EmulatorConfig(return_delay_us=0, actuation_latency_s=latency_s))
    bench.start_turning(pwm=0)
    sent_ns = [50 * MS + i * 7_123_457 for i in range(40)]
    for i, t_ns in enumerate(sent_ns):
        bench.send(t_ns, goal_pwm(20 * i))
    bench.run_until(sent_ns[-1] + 60 * MS)
    effects = bench.truth().of(Kind.EFFECT)
    planned_ns = np.array(sent_ns) + len(goal_pwm(0)) * 10_000 + round(latency_s * 1e9)
    assert np.array_equal(effects["t_host_ns"], sent_ns)
    assert np.allclose(effects["values"][:, 1], 20 * np.arange(40) / 885)
    assert np.array_equal(effects["t_ns"] - effects["late_ns"], planned_ns)
    assert np.all(effects["t_ns"] % STEP_NS == 0)
    assert np.all(np.abs(effects["late_ns"]) <= STEP_NS / 2)
    assert abs(effects["late_ns"].mean()) < 0.1 * STEP_NS


def test_true_speed_answers_from_the_effect_on(make_bench):
    bench = make_bench(config=EmulatorConfig(return_delay_us=0, actuation_latency_s=0.0200))
    bench.start_turning(pwm=0)
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
    bench.start_turning()
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


def test_sync_read_answers_in_the_order_asked_one_after_the_other(make_bench):
    bench = make_bench("Ramp", ids=[1, 2, 3])
    packet = build(BROADCAST_ID, Instruction.SYNC_READ, b"\x84\x00\x04\x00" + bytes([3, 9, 1]))
    bench.send(50 * MS, packet)
    bench.run_until(60 * MS)
    begin_ns = 50 * MS + len(packet) * 10_000
    assert [answer[4] for _, answer in bench.sent] == [3, 1]
    assert [t_ns for t_ns, _ in bench.sent] == [begin_ns + 150_000, begin_ns + 300_000]


def test_bulk_read(make_bench):
    bench = make_bench("Ramp", ids=[1, 2])
    items = b"\x02\x84\x00\x04\x00" + b"\x01\x90\x00\x02\x00"
    bench.send(50 * MS, build(BROADCAST_ID, Instruction.BULK_READ, items))
    bench.run_until(60 * MS)
    assert [(answer[4], len(answer)) for _, answer in bench.sent] == [(2, 15), (1, 13)]


def test_half_duplex_wire_makes_instructions_wait(make_bench):
    bench = make_bench("Ramp")
    bench.send(50 * MS, READ_POSITION)
    bench.run_until(50 * MS + 200_000)  # the answer is on the wire
    bench.send(50 * MS + 200_000, READ_POSITION)
    bench.run_until(60 * MS)
    assert [t_ns for t_ns, _ in bench.sent] == [50 * MS + 290_000, 50 * MS + 580_000]


def test_two_instructions_in_one_chunk_are_complete_one_after_the_other(make_bench):
    bench = make_bench("Ramp")
    bench.send(50 * MS, READ_POSITION, READ_POSITION)
    bench.run_until(60 * MS)
    samples = bench.truth().of(Kind.SAMPLE)
    assert np.diff(samples["t_ns"]).tolist() == [140_000]


def test_watchdog_trips_exactly_when_nothing_was_heard(make_bench):
    bench = make_bench(config=EmulatorConfig(return_delay_us=0, actuation_latency_s=0.01))
    bench.start_turning(watchdog=5)
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


def test_traffic_for_others_does_not_feed_the_watchdog(make_bench):
    bench = make_bench(ids=[1, 2])
    bench.start_turning(watchdog=5)
    for i in range(30):
        bench.send(50 * MS + i * 9 * MS, build(2, Instruction.PING))
    assert [row["servo_id"] for row in bench.truth().of(Kind.WATCHDOG)] == [1]


def test_broadcasts_feed_the_watchdog(make_bench):
    bench = make_bench(ids=[1, 2])
    bench.start_turning(watchdog=5)
    for i in range(30):
        bench.send(50 * MS + i * 9 * MS, build(BROADCAST_ID, Instruction.SYNC_WRITE, b"\x41\x00\x01\x00\x02\x01"))
    assert bench.truth().of(Kind.WATCHDOG).size == 0


def test_watchdog_drops_what_the_host_still_had_on_the_way(make_bench):
    bench = make_bench(config=EmulatorConfig(actuation_latency_s=0.05))
    bench.start_turning(watchdog=1)
    bench.send(10 * MS, goal_pwm(885))
    bench.run_until(200 * MS)
    assert bench.truth().of(Kind.EFFECT)["values"][:, 1].tolist() == [0.0]


def test_a_late_emulator_trips_no_watchdog(make_bench):
    bench = make_bench()
    bench.start_turning(watchdog=5)
    bench.send(50 * MS, goal_pwm(100))
    bench.run_until(60 * MS)
    # The process slept for 200 ms; the bytes found then may have come at any time in between.
    bench.now_ns = 260 * MS
    bench.bus.feed(goal_pwm(200), bench.now_ns)
    bench.bus.run_until(bench.now_ns)
    bench.run_until(300 * MS)
    assert bench.truth().of(Kind.WATCHDOG).size == 0


def test_lost_answers_are_logged_and_instructions_still_work(make_bench):
    bench = make_bench(config=EmulatorConfig(reply_loss=0.5, seed=1))
    bench.start_turning()
    for i in range(200):
        bench.send((50 + i) * MS, goal_pwm(i))
    bench.run_until(300 * MS)
    truth = bench.truth()
    assert 70 < truth.of(Kind.LOSS).size < 130
    assert truth.of(Kind.REPLY).size + truth.of(Kind.LOSS).size == 200
    assert truth.of(Kind.EFFECT).size == 200


def test_silent_servos_hear_nothing(make_bench):
    bench = make_bench(config=EmulatorConfig(silent_after_s=0.1))
    bench.start_turning(watchdog=5)
    bench.send(50 * MS, goal_pwm(100))
    bench.run_until(90 * MS)
    bench.send(110 * MS, goal_pwm(200))
    bench.run_until(400 * MS)
    assert len(bench.sent) == 1
    assert bench.truth().of(Kind.WATCHDOG).size == 1


def test_rest_of_a_packet_that_never_comes_is_forgotten(make_bench):
    bench = make_bench("Ramp")
    bench.send(50 * MS, READ_POSITION[:9])
    bench.send(60 * MS, READ_POSITION)
    bench.run_until(70 * MS)
    assert len(bench.sent) == 1


def test_status_return_level(make_bench):
    bench = make_bench()
    bench.servos[1].put(reg.STATUS_RETURN_LEVEL, 1)
    bench.send(50 * MS, goal_pwm(1))
    bench.send(60 * MS, READ_POSITION)
    bench.run_until(65 * MS)
    bench.servos[1].put(reg.STATUS_RETURN_LEVEL, 0)
    bench.send(70 * MS, READ_POSITION)
    bench.send(80 * MS, build(1, Instruction.PING))
    bench.run_until(90 * MS)
    assert [len(answer) for _, answer in bench.sent] == [15, 14]


def test_truth_lateness_is_against_the_plan(make_bench):
    bench = make_bench("Ramp")
    bench.send(50 * MS, READ_POSITION)
    bench.now_ns = 53 * MS  # the process came around late
    bench.bus.run_until(bench.now_ns)
    truth = bench.truth()
    assert lateness_s(truth).tolist() == pytest.approx([0.003 - 290e-6])
    assert mean_latencies(truth)["sensing_s"] == pytest.approx(0.003 - 140e-6)


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
    assert isinstance(bench.plant, ConfigurablePlant)
    assert bench.plant.told == [(0.0, i, 640, 4000, math.inf) for i in (1, 2, 3)]
    bench.plant.told.clear()
    bench.send(50 * MS, sync_write(reg.POSITION_P_GAIN, {1: 800, 3: 900}))
    bench.send(60 * MS, write(reg.POSITION_D_GAIN, 0))
    bench.send(70 * MS, write(reg.PROFILE_VELOCITY, 100))
    bench.send(80 * MS, write(reg.PROFILE_VELOCITY, 100), write(reg.LED, 1))
    bench.send(90 * MS, build(1, Instruction.REG_WRITE, b"\x70\x00" + reg.PROFILE_VELOCITY.encode(50)))
    bench.send(100 * MS, build(1, Instruction.ACTION))
    bench.send(110 * MS, build(1, Instruction.REBOOT))
    bench.run_until(120 * MS)
    speed = reg.RAD_S_PER_COUNT
    assert [told[1:] for told in bench.plant.told] == [
        (1, 800, 4000, math.inf),
        (3, 900, 4000, math.inf),
        (1, 800, 0, math.inf),
        (1, 800, 0, pytest.approx(100 * speed)),
        (1, 800, 0, pytest.approx(50 * speed)),
        (1, 640, 4000, math.inf),
    ]
    assert [told[0] for told in bench.plant.told] == pytest.approx([0.05, 0.05, 0.06, 0.07, 0.1, 0.11], abs=1e-3)


def test_plants_need_not_care_for_controllers(make_bench):
    bench = make_bench("FirstOrder")
    assert not isinstance(bench.plant, ConfigurablePlant)
    bench.send(50 * MS, write(reg.POSITION_P_GAIN, 1))
    bench.run_until(60 * MS)
    assert len(bench.sent) == 1


def test_goals_of_one_instruction_take_effect_at_one_instant(make_bench):
    bench = make_bench("Joints", EmulatorConfig(actuation_latency_s=0.01, actuation_jitter_s=0.008, seed=1))
    bench.send(20 * MS, sync_write(reg.TORQUE_ENABLE, {1: 1, 2: 1, 3: 1}))
    for i in range(20):
        bench.send((50 + 20 * i) * MS, sync_write(reg.GOAL_POSITION, {1: 2048 + i, 2: 2000, 3: 2100}))
    bench.run_until(500 * MS)
    effects = bench.truth().of(Kind.EFFECT)
    instants_ns = effects["t_ns"].reshape(21, 3)
    assert np.all(instants_ns == instants_ns[:, :1])
    assert np.ptp(instants_ns[1:, 0] - effects["t_host_ns"][3::3]) > 5 * MS


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


def test_watchdog_stops_position_servos_and_refuses_goals_without_a_word(make_bench):
    bench = make_bench("Joints")
    bench.send(10 * MS, sync_write(reg.TORQUE_ENABLE, {1: 1, 2: 1}))
    bench.send(20 * MS, sync_write(reg.BUS_WATCHDOG, {1: 5, 2: 5}))
    bench.send(30 * MS, sync_write(reg.GOAL_POSITION, {1: 0, 2: 4095}))
    bench.run_until(200 * MS)
    stopped = bench.plant.state()
    assert [stopped["dq1"], stopped["dq2"]] == [0.0, 0.0]
    bench.send(210 * MS, sync_write(reg.GOAL_POSITION, {1: 0, 2: 4095}))
    bench.run_until(300 * MS)
    assert bench.plant.state() == stopped
    assert bench.sent == []
    truth = bench.truth()
    assert truth.of(Kind.WATCHDOG)["servo_id"].tolist() == [1, 2]
    assert truth.of(Kind.EFFECT)["values"][-2:, :2].tolist() == [[16.0, 0.0]] * 2


def read_state(bench, t_ns):
    """Return velocity and position [counts] of servo 1, read at a time, and when the answer came."""
    bench.send(t_ns, build(1, Instruction.READ, bytes((128, 0, 8, 0))))
    bench.run_until(t_ns + 19 * MS)
    ((arrived_ns, answer),) = [bench.sent.pop() for _ in range(len(bench.sent))]
    return *struct.unpack("<ii", answer[9:17]), arrived_ns


def test_an_encoder_stands_still_while_the_plant_goes_on(make_bench):
    bench = make_bench("Ramp", EmulatorConfig(frozen_after_s=0.1))
    before, at, after = (read_state(bench, t * MS) for t in (60, 120, 300))
    assert 0 < before[1] < at[1] == after[1]
    assert before[0] > 0 == at[0] == after[0]
    assert bench.truth().of(Kind.SAMPLE)["values"][-1, 0] == pytest.approx(0.4 * 0.3, abs=1e-3)


def test_wild_positions_have_a_good_checksum_and_no_motor_reaches_them(make_bench):
    bench = make_bench("Ramp", EmulatorConfig(wild=0.5))
    counts = np.array([read_state(bench, 20 * i * MS)[1] for i in range(1, 30)])
    wild = np.abs(counts * reg.RAD_PER_COUNT) > 10_000.0
    assert 5 < wild.sum() < 25
    assert np.all(np.abs(counts[~wild]) < 1000)


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


def test_faults_wait_for_their_signal(make_bench):
    bench = make_bench("Ramp", EmulatorConfig(wild=1.0, unplugged_after_s=0.2, on_signal=True))
    counts = [read_state(bench, t * MS)[1] for t in (60, 120, 180)]
    assert counts == sorted({*counts}), "not ill yet"
    assert not bench.bus.unplugged(10_000 * MS)
    bench.bus.begin_faults(200 * MS)
    assert abs(read_state(bench, 220 * MS)[1] * reg.RAD_PER_COUNT) > 10_000.0
    assert not bench.bus.unplugged(399 * MS)
    assert bench.bus.unplugged(400 * MS)
