"""The emulator's process: ROBOTIS' own SDK speaks to it over the pseudo-terminal.

What the servos answer is tested with the same SDK in virtual time, in tests/hardware/test_vendor_sdk.py.
"""

from pathlib import Path

import pytest
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler
from emulator import EmulatedProcess

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.hardware import dynamixel as reg

pytestmark = pytest.mark.process

PLANTS = Path(__file__).parents[1] / "hardware" / "plants.py"


class Patient(PortHandler):
    """A port that waits longer for an answer than the SDK's 34 ms: a busy machine may hold up both processes."""

    def setPacketTimeout(self, packet_length):
        self.setPacketTimeoutMillis(5_000.0)


def test_the_vendors_sdk_reads_and_drives_it(tmp_path):
    with EmulatedProcess(f"{PLANTS}:FirstOrder", EmulatorConfig(), {"ids": [1, 2, 5]}, tmp_path / "truth.bin") as robot:
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
