"""ROBOTIS' own SDK speaks to the emulated servos, over a port in virtual time."""

import pytest
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler
from plants import FirstOrder

from sim2real.emulation.bus import VirtualRobot
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.hardware import dynamixel as reg
from sim2real.hardware.bus.packets import Instruction, Parser
from sim2real.hardware.bus.port import open_port
from sim2real.hardware.dynamixel import PROTOCOL, StatusError

OK = 0


class VirtualPort(PortHandler):
    """The SDK's port, with the robot's time."""

    def __init__(self, robot):
        super().__init__(robot.port)
        self.is_using, self._robot, self._bytes, self._end_ns = False, robot, b"", 0
        self._port = open_port(robot.port, 1_000_000)

    def clearPort(self):
        self._bytes = b""
        self._port.flush()

    def writePort(self, packet):
        self._port.write(bytes(packet))
        return len(packet)

    def readPort(self, length):
        self._bytes += self._port.read(self._end_ns)
        data, self._bytes = self._bytes[:length], self._bytes[length:]
        return data

    def setPacketTimeout(self, packet_length):
        self.setPacketTimeoutMillis(34.0)

    def setPacketTimeoutMillis(self, msec):
        self._end_ns = self._robot.now_ns() + round(1e6 * msec)

    def isPacketTimeout(self):
        return self._robot.now_ns() >= self._end_ns


class Sdk:
    """A host that uses the SDK as its documentation shows."""

    def __init__(self, robot):
        self.robot, self.port, self.packets = robot, VirtualPort(robot), PacketHandler(2.0)

    def write(self, servo_id, register, value):
        method = getattr(self.packets, f"write{register.size}ByteTxRx")
        return method(self.port, servo_id, register.address, value & (1 << 8 * register.size) - 1)

    def read(self, servo_id, register):
        value, *status = getattr(self.packets, f"read{register.size}ByteTxRx")(self.port, servo_id, register.address)
        return register.decode(value.to_bytes(register.size, "little")), *status

    def ask(self, packet):
        """Return the error of the answer to a packet that the SDK does not make."""
        self.port.clearPort()
        self.port.writePort(packet)
        self.port.setPacketTimeoutMillis(20.0)
        ((answer, _),) = Parser(PROTOCOL).feed(self.port.readPort(1000))
        return answer.parameters[0]


@pytest.fixture
def sdk():
    robot = VirtualRobot(FirstOrder([1, 2, 5]), EmulatorConfig())
    yield Sdk(robot)
    robot.stop()


def test_pings(sdk):
    assert sdk.packets.ping(sdk.port, 5) == (1060, OK, 0)
    assert sdk.packets.ping(sdk.port, 9)[1] != OK
    assert sdk.packets.broadcastPing(sdk.port) == ({1: [1060, 47], 2: [1060, 47], 5: [1060, 47]}, OK)


@pytest.mark.parametrize(
    ("register", "value"),
    [
        (reg.LED, 1),
        (reg.POSITION_P_GAIN, 1234),
        (reg.PROFILE_VELOCITY, 300),
        (reg.GOAL_PWM, -3),
        (reg.HOMING_OFFSET, -131073),  # FF FF FD FF: needs byte stuffing
    ],
)
def test_write_then_read_until_a_reboot(sdk, register, value):
    assert sdk.write(1, register, value) == (OK, 0)
    assert sdk.read(1, register) == (value, OK, 0)
    assert sdk.packets.reboot(sdk.port, 1) == (OK, 0)
    assert sdk.read(1, register) == (value if register is reg.HOMING_OFFSET else register.default, OK, 0)


def test_errors_as_the_sdk_reports_them(sdk):
    assert sdk.write(1, reg.PRESENT_POSITION, 0) == (OK, StatusError.ACCESS)
    assert sdk.write(1, reg.GOAL_PWM, 886) == (OK, StatusError.DATA_RANGE)
    sdk.write(1, reg.PWM_LIMIT, 500)
    assert sdk.write(1, reg.GOAL_PWM, 501) == (OK, StatusError.DATA_LIMIT)
    assert sdk.packets.write1ByteTxRx(sdk.port, 1, reg.GOAL_PWM.address, 3) == (OK, StatusError.DATA_LENGTH)
    packet = bytearray(PROTOCOL.build(1, Instruction.PING))
    packet[-1] ^= 1
    assert sdk.ask(bytes(packet)) == StatusError.CRC
    assert sdk.ask(PROTOCOL.build(1, 0x77)) == StatusError.INSTRUCTION


def test_several_servos_at_once(sdk):
    writer = GroupSyncWrite(sdk.port, sdk.packets, reg.PROFILE_VELOCITY.address, 4)
    reader = GroupSyncRead(sdk.port, sdk.packets, reg.PROFILE_VELOCITY.address, 4)
    for servo_id in (5, 1, 2):
        writer.addParam(servo_id, list(reg.PROFILE_VELOCITY.encode(100 * servo_id)))
        reader.addParam(servo_id)
    assert (writer.txPacket(), reader.txRxPacket()) == (OK, OK)
    assert [reader.getData(i, reg.PROFILE_VELOCITY.address, 4) for i in (1, 2, 5)] == [100, 200, 500]


def test_a_motor_turns_only_with_torque(sdk):
    sdk.write(1, reg.OPERATING_MODE, 16)
    sdk.write(1, reg.GOAL_PWM, 400)
    sdk.robot.sleep(0.1)
    assert sdk.read(1, reg.PRESENT_VELOCITY)[0] == 0
    sdk.write(1, reg.TORQUE_ENABLE, 1)
    assert sdk.write(1, reg.OPERATING_MODE, 3) == (OK, StatusError.ACCESS)
    sdk.write(1, reg.GOAL_PWM, 400)
    sdk.robot.sleep(0.3)
    speed_rad_s = reg.RAD_S_PER_COUNT * sdk.read(1, reg.PRESENT_VELOCITY)[0]
    assert speed_rad_s == pytest.approx(6.0 * 400 / 885, rel=0.01)
    sdk.write(1, reg.TORQUE_ENABLE, 0)
    sdk.robot.sleep(0.4)
    assert sdk.read(1, reg.PRESENT_VELOCITY)[0] == 0
