"""The emulator's process, spoken to by ROBOTIS' own SDK over the pseudo-terminal."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from dynamixel_sdk import GroupBulkRead, GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler
from plants import mean_latencies

from sim2real.emulation import process as emulator
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.plant import load_plant
from sim2real.emulation.process import EmbeddedRobot
from sim2real.emulation.truth import Kind, TruthLog, read_truth
from sim2real.errors import HardwareLost, Sim2RealError, UsageError
from sim2real.hardware.bus.packets import Instruction, Parser
from sim2real.hardware.dynamixel import registers as reg
from sim2real.hardware.dynamixel.protocol import PROTOCOL, StatusError

pytestmark = pytest.mark.process

PLANTS = Path(__file__).parents[1] / "hardware" / "plants.py"
OK = 0


class Patient(PortHandler):
    """A port that waits longer for an answer than the SDK's 34 ms: a busy machine may hold up both processes."""

    def setPacketTimeout(self, packet_length):
        self.setPacketTimeoutMillis(300.0)


class Sdk:
    """A host that uses the SDK as its documentation shows."""

    def __init__(self, port):
        self.port = Patient(port)
        assert self.port.openPort()
        assert self.port.setBaudRate(1_000_000)
        self.packets = PacketHandler(2.0)

    def write(self, servo_id, register, value):
        method = getattr(self.packets, f"write{register.size}ByteTxRx")
        return method(self.port, servo_id, register.address, value & (1 << 8 * register.size) - 1)

    def read(self, servo_id, register):
        value, result, error = getattr(self.packets, f"read{register.size}ByteTxRx")(
            self.port, servo_id, register.address
        )
        return register.decode(value.to_bytes(register.size, "little")), result, error

    def raw(self, packet, patience_s=2.0):
        self.port.clearPort()
        self.port.writePort(packet)
        parser, end_s = Parser(PROTOCOL), time.monotonic() + patience_s
        while time.monotonic() < end_s:
            if answers := [found for found, _ in parser.feed(bytes(self.port.readPort(1000)))]:
                return answers
            time.sleep(0.005)
        return []


@pytest.fixture(scope="module")
def robot_of_this_module():
    with EmbeddedRobot(f"{PLANTS}:FirstOrder", EmulatorConfig(), {"ids": [1, 2, 5]}) as robot:
        yield robot


@pytest.fixture
def sdk(robot_of_this_module):
    host = Sdk(robot_of_this_module.port)
    for servo_id in (1, 2, 5):
        host.packets.reboot(host.port, servo_id)
        for register in (reg.OPERATING_MODE, reg.PWM_LIMIT, reg.HOMING_OFFSET):
            assert host.write(servo_id, register, register.default) == (OK, 0)
    yield host
    host.port.closePort()


def test_ping(sdk):
    assert sdk.packets.ping(sdk.port, 5) == (1060, OK, 0)


def test_ping_of_a_servo_that_is_not_there(sdk):
    assert sdk.packets.ping(sdk.port, 9)[1] != OK


def test_broadcast_ping(sdk):
    found, result = sdk.packets.broadcastPing(sdk.port)
    assert (sorted(found), result) == ([1, 2, 5], OK)
    assert found[2] == [1060, 47]


@pytest.mark.parametrize(
    ("register", "value"), [(reg.LED, 1), (reg.POSITION_P_GAIN, 1234), (reg.PROFILE_VELOCITY, 300), (reg.GOAL_PWM, -3)]
)
def test_write_then_read(sdk, register, value):
    assert sdk.write(1, register, value) == (OK, 0)
    assert sdk.read(1, register) == (value, OK, 0)


def test_values_that_need_byte_stuffing(sdk):
    assert reg.HOMING_OFFSET.encode(-131073) == bytes.fromhex("FFFFFDFF")
    sdk.write(1, reg.HOMING_OFFSET, -131073)
    assert sdk.read(1, reg.HOMING_OFFSET) == (-131073, OK, 0)


def test_errors_as_the_sdk_reports_them(sdk):
    assert sdk.write(1, reg.PRESENT_POSITION, 0) == (OK, StatusError.ACCESS)
    assert sdk.write(1, reg.GOAL_PWM, 886) == (OK, StatusError.DATA_RANGE)
    sdk.write(1, reg.PWM_LIMIT, 500)
    assert sdk.write(1, reg.GOAL_PWM, 501) == (OK, StatusError.DATA_LIMIT)
    assert sdk.packets.write1ByteTxRx(sdk.port, 1, reg.GOAL_PWM.address, 3) == (OK, StatusError.DATA_LENGTH)


def test_broken_checksum_and_unknown_instruction(sdk):
    packet = bytearray(PROTOCOL.build(1, Instruction.PING))
    packet[-1] ^= 1
    (answer,) = sdk.raw(bytes(packet))
    assert answer.parameters[0] == StatusError.CRC
    (answer,) = sdk.raw(PROTOCOL.build(1, 0x77))
    assert answer.parameters[0] == StatusError.INSTRUCTION
    assert sdk.raw(PROTOCOL.build(1, Instruction.ACTION))[0].parameters[0] == StatusError.INSTRUCTION


def test_sync_write_and_sync_read(sdk):
    writer = GroupSyncWrite(sdk.port, sdk.packets, reg.PROFILE_VELOCITY.address, 4)
    reader = GroupSyncRead(sdk.port, sdk.packets, reg.PROFILE_VELOCITY.address, 4)
    for servo_id in (5, 1, 2):
        writer.addParam(servo_id, list(reg.PROFILE_VELOCITY.encode(100 * servo_id)))
        reader.addParam(servo_id)
    assert writer.txPacket() == OK
    assert reader.txRxPacket() == OK
    assert [reader.getData(i, reg.PROFILE_VELOCITY.address, 4) for i in (1, 2, 5)] == [100, 200, 500]


def test_bulk_read(sdk):
    reader = GroupBulkRead(sdk.port, sdk.packets)
    reader.addParam(1, reg.PRESENT_INPUT_VOLTAGE.address, 2)
    reader.addParam(2, reg.POSITION_D_GAIN.address, 2)
    assert reader.txRxPacket() == OK
    assert reader.getData(1, reg.PRESENT_INPUT_VOLTAGE.address, 2) == 120
    assert reader.getData(2, reg.POSITION_D_GAIN.address, 2) == 4000


def test_registered_write_waits_for_action(sdk):
    assert sdk.packets.regWriteTxRx(sdk.port, 1, reg.LED.address, 1, [1]) == (OK, 0)
    assert sdk.read(1, reg.LED)[0] == 0
    assert sdk.packets.action(sdk.port, 1) == OK
    until_s = time.monotonic() + 2.0  # on a busy machine the emulator gets to it late
    while sdk.read(1, reg.LED)[0] == 0 and time.monotonic() < until_s:
        time.sleep(0.02)
    assert sdk.read(1, reg.LED)[0] == 1


def test_reboot(sdk):
    sdk.write(1, reg.LED, 1)
    assert sdk.packets.reboot(sdk.port, 1) == (OK, 0)
    assert sdk.read(1, reg.LED)[0] == 0


def test_motor_turns_only_with_torque(sdk):
    sdk.write(1, reg.OPERATING_MODE, 16)
    sdk.write(1, reg.GOAL_PWM, 400)
    time.sleep(0.1)
    assert sdk.read(1, reg.PRESENT_VELOCITY)[0] == 0
    sdk.write(1, reg.TORQUE_ENABLE, 1)
    assert sdk.write(1, reg.OPERATING_MODE, 3) == (OK, StatusError.ACCESS)
    sdk.write(1, reg.GOAL_PWM, 400)
    time.sleep(0.3)
    speed_rad_s = reg.rad_s_from_count(sdk.read(1, reg.PRESENT_VELOCITY)[0])
    assert speed_rad_s == pytest.approx(6.0 * 400 / 885, rel=0.03)
    sdk.write(1, reg.TORQUE_ENABLE, 0)
    time.sleep(0.4)
    assert sdk.read(1, reg.PRESENT_VELOCITY)[0] == 0


def test_position_mode(sdk):
    sdk.write(2, reg.TORQUE_ENABLE, 1)
    assert sdk.write(2, reg.GOAL_POSITION, 5000) == (OK, StatusError.DATA_LIMIT)
    sdk.write(2, reg.GOAL_POSITION, 400)
    time.sleep(0.8)
    assert sdk.read(2, reg.PRESENT_POSITION)[0] == pytest.approx(400, abs=3)


def test_latencies_are_the_configured_ones_within_the_logged_lateness(start_robot):
    config = EmulatorConfig(return_delay_us=0, sensing_latency_s=0.004, actuation_latency_s=0.006)
    robot = start_robot("Ramp", config)
    host = Sdk(robot.port)
    host.write(1, reg.OPERATING_MODE, 16)
    host.write(1, reg.TORQUE_ENABLE, 1)
    time.sleep(0.01)
    reads = []
    for i in range(60):
        sent_ns = time.monotonic_ns()
        count, result, _ = host.read(1, reg.PRESENT_POSITION)
        reads.append((sent_ns, time.monotonic_ns(), count))
        assert result == OK
        host.write(1, reg.GOAL_PWM, i)
        time.sleep(0.004)
    time.sleep(0.02)
    robot.stop()
    host.port.closePort()
    truth = robot.truth()
    samples = truth.of(Kind.SAMPLE)
    sent_ns, got_ns, counts = np.array(reads).T
    # The order of the instants as both processes saw them, on the clock that they share.
    assert np.all(sent_ns <= samples["t_host_ns"])
    assert np.all(samples["t_done_ns"] - samples["late_ns"] == samples["t_host_ns"] + (14 + 15) * 10_000)
    assert np.all(samples["t_done_ns"] <= got_ns + 1_000_000)
    assert np.all(samples["t_ns"] == samples["t_host_ns"] + 140_000 - 4_000_000)
    assert np.all(samples["late_ns"] >= 0)
    true_rad = 0.4 * (samples["t_ns"] - truth.header["start_ns"]) * 1e-9
    assert np.abs(counts * reg.RAD_PER_COUNT - true_rad).max() < 0.51 * reg.RAD_PER_COUNT
    effects = truth.of(Kind.EFFECT)[-60:]
    assert np.all(effects["t_ns"] - effects["late_ns"] == effects["t_host_ns"] + 140_000 + 6_000_000)
    assert np.all(np.abs(effects["late_ns"]) <= 250_000)
    means = mean_latencies(truth)
    assert means["actuation_s"] == pytest.approx(0.00614, abs=0.0003)
    assert means["sensing_s"] == pytest.approx(0.00415 + samples["late_ns"].mean() * 1e-9, abs=1e-5)


def test_truth_file_can_be_read_at_any_time_and_cut_anywhere(start_robot, tmp_path):
    robot = start_robot(ids=[1, 2], time_constant_s=0.03)
    time.sleep(0.8)
    os.kill(robot.pid, signal.SIGKILL)
    truth = robot.truth()
    assert robot.reveal() == {"time_constant_s": 0.03, "top_speed_rad_s": 6.0}
    assert truth.header["config"]["baud_rate"] == 1_000_000
    t_ns, states = truth.states()
    assert list(states) == ["q1", "dq1", "q2", "dq2"]
    assert (t_ns[-1] - t_ns[0]) * 1e-9 > 0.4
    whole = robot.truth_path.read_bytes()
    cut = tmp_path / "cut.bin"
    cut.write_bytes(whole[:-13])
    assert len(read_truth(cut).rows) == len(truth.rows) - 1
    cut.write_bytes(whole[:10])
    with pytest.raises(Sim2RealError, match="no header"):
        read_truth(cut)
    with pytest.raises(Sim2RealError, match="no truth file"):
        read_truth(tmp_path / "none.bin")


def test_first_line_is_the_port_and_sigterm_ends_cleanly(tmp_path):
    command = [sys.executable, "-m", "sim2real.emulation.process", "--plant", f"{PLANTS}:Ramp"]
    command += ["--emulation", "sim2real.emulation.dynamixel:EmulatorConfig"]
    began_s = time.monotonic()
    process = subprocess.Popen(
        [*command, "--truth", tmp_path / "t.bin", "--plant-args", '{"ids": [4]}'], stdout=subprocess.PIPE
    )
    ready = json.loads(process.stdout.readline())
    assert time.monotonic() - began_s < 3.0
    assert ready["pid"] == process.pid
    assert "parameters" not in ready
    assert Path(ready["port"]).exists()
    process.terminate()
    assert process.wait(3.0) == 0
    assert process.stdout.read() == b""
    assert read_truth(tmp_path / "t.bin").header["servo_ids"] == [4]


def test_robot_goes_when_its_parent_is_killed(tmp_path):
    code = (
        "import time; from sim2real.emulation.process import EmbeddedRobot;"
        "from sim2real.emulation.dynamixel import EmulatorConfig;"
        f"print(EmbeddedRobot({f'{PLANTS}:Ramp'!r}, EmulatorConfig()).pid, flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=_env(tmp_path))
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline_s = time.monotonic() + 3.0
    while Path(f"/proc/{pid}/cmdline").exists() and Path(f"/proc/{pid}/cmdline").read_bytes():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def _env(tmp_path):
    return {**os.environ, "TMPDIR": str(tmp_path)}


def test_import_is_light():
    code = (
        "import sys, sim2real.emulation.process;"
        "import sim2real.hardware.safety.gate;"
        "print([m for m in ('jax', 'mujoco', 'serial', 'sim2real.graph', 'sim2real.log') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_a_plant_that_does_not_start_says_why():
    with pytest.raises(HardwareLost, match=r"(?s)has no callable 'Rampp'.*FirstOrder"):
        EmbeddedRobot(f"{PLANTS}:Rampp", EmulatorConfig())


@pytest.mark.parametrize(("name", "message"), [("EmulatorConfigg", "has no callable"), ("Plant", "class of settings")])
def test_an_emulation_that_is_none_says_so(capsys, name, message):
    module = "sim2real.emulation.plant" if name == "Plant" else "sim2real.emulation.dynamixel"
    assert emulator.main(["--emulation", f"{module}:{name}", "--plant", f"{PLANTS}:Ramp", "--truth", "t.bin"]) == 2
    assert message in capsys.readouterr().err


def test_plants_may_be_dataclasses():
    assert load_plant(f"{PLANTS}:Still", {"servo_ids": (3,)}).servo_ids == (3,)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("plants.py", "MODULE_OR_FILE:NAME"),
        ("none.py:Plant", "no plant file"),
        ("no_such_module:P", "cannot be imported"),
    ],
)
def test_plants_that_cannot_be_found(spec, message):
    with pytest.raises(UsageError, match=message):
        load_plant(spec)


def test_an_account_that_cannot_be_written_does_not_stop_the_robot(tmp_path):
    log = TruthLog(tmp_path / "truth.bin", {"state_names": ["q"]})
    log.write(Kind.STATE, 0, 0, 1, 0, 0, (1.0,))
    path, empty = tmp_path / "truth.bin", (tmp_path / "truth.bin").stat().st_size
    log.flush_if_due(10**9)
    while path.stat().st_size == empty:
        time.sleep(0.001)
    log._file.close()
    log._file = open("/dev/full", "wb")  # noqa: SIM115 - the log closes it
    for second in range(2, 5):
        log.write(Kind.STATE, 0, 0, second, 0, 0, (1.0,))
        log.flush_if_due(second * 10**9)
    log.close()
    assert read_truth(path).rows["t_ns"].tolist() == [1]


def test_a_disk_that_is_busy_holds_up_nobody(tmp_path):
    log = TruthLog(tmp_path / "truth.bin", {"state_names": ["q"]})
    written, disk = threading.Event(), log._file

    class Slow:
        def write(self, data):
            assert written.wait(20.0)
            return disk.write(data)

        def __getattr__(self, name):
            return getattr(disk, name)

    log._file = Slow()
    for second in range(1, 4):
        log.write(Kind.STATE, 0, 0, second, 0, 0, (1.0,))
        log.flush_if_due(second * 10**9)  # returns, though nothing has been written
    written.set()
    log.close()
    assert read_truth(tmp_path / "truth.bin").rows["t_ns"].tolist() == [1, 2, 3]


def test_the_embedded_robot_imports_nothing_from_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("open('ran', 'w')")
    monkeypatch.chdir(tmp_path)
    with EmbeddedRobot(f"{PLANTS}:Ramp", EmulatorConfig()) as robot:
        assert robot.running
    assert not (tmp_path / "ran").exists()
