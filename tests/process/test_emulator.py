"""The emulator's process: ROBOTIS' own SDK speaks to it over the pseudo-terminal; how it begins and ends.

What the servos answer is tested with the same SDK in virtual time, in tests/hardware/test_vendor_sdk.py.
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.process import EmbeddedRobot
from sim2real.errors import HardwareLost
from sim2real.hardware import dynamixel as reg

pytestmark = pytest.mark.process

PLANTS = Path(__file__).parents[1] / "hardware" / "plants.py"


class Patient(PortHandler):
    """A port that waits longer for an answer than the SDK's 34 ms: a busy machine may hold up both processes."""

    def setPacketTimeout(self, packet_length):
        self.setPacketTimeoutMillis(5_000.0)


def test_the_vendors_sdk_reads_and_drives_it(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("open('ran', 'w')")  # nothing is imported from the working directory
    monkeypatch.chdir(tmp_path)
    with EmbeddedRobot(f"{PLANTS}:FirstOrder", EmulatorConfig(), {"ids": [1, 2, 5]}) as robot:
        port, packets = Patient(robot.port), PacketHandler(2.0)
        assert port.openPort()
        assert port.setBaudRate(1_000_000)
        assert packets.ping(port, 5) == (1060, 0, 0)
        writer = GroupSyncWrite(port, packets, reg.PROFILE_VELOCITY.address, 4)
        reader = GroupSyncRead(port, packets, reg.PROFILE_VELOCITY.address, 4)
        for servo_id in (5, 1, 2):
            writer.addParam(servo_id, list(reg.PROFILE_VELOCITY.encode(100 * servo_id)))
            reader.addParam(servo_id)
        assert writer.txPacket() == 0
        assert reader.txRxPacket() == 0
        assert [reader.getData(i, reg.PROFILE_VELOCITY.address, 4) for i in (1, 2, 5)] == [100, 200, 500]
        port.closePort()
        assert robot.running
    assert not (tmp_path / "ran").exists()
    with pytest.raises(HardwareLost, match=r"(?s)has no callable 'Rampp'.*FirstOrder"):
        EmbeddedRobot(f"{PLANTS}:Rampp", EmulatorConfig())


def test_it_goes_when_its_parent_is_killed(tmp_path):
    code = (
        "import time; from sim2real.emulation.process import EmbeddedRobot;"
        "from sim2real.emulation.dynamixel import EmulatorConfig;"
        f"print(EmbeddedRobot({f'{PLANTS}:Ramp'!r}, EmulatorConfig()).pid, flush=True); time.sleep(600)"
    )
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment)
    command_line = Path(f"/proc/{int(parent.stdout.readline())}/cmdline")
    parent.kill()
    parent.wait()
    while command_line.exists() and command_line.read_bytes():  # the limit of all tests ends this one
        time.sleep(0.02)
