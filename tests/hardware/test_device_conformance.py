"""Every device here fulfils the contract of a device, on its emulator in virtual time."""

import pytest
from plants import FirstOrder, Joints
from turntable.odrive import ODrive, SpeedLoop
from turntable.odrive_emulation import ODriveEmulation
from turntable.plant import Turntable

from pipelines.go2.plant import Go2Body
from sim2real.emulation.conformance import DeviceConformance
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.feetech import StsEmulation
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import PositionDrive, ServoJoint, VoltageDrive
from sim2real.hardware.dynamixel import DynamixelServos
from sim2real.hardware.feetech import StsServos


class TestOneServoByVoltage(DeviceConformance):
    emulation = EmulatorConfig
    plant = FirstOrder

    def make_device(self, port):
        # Patient with lost answers, which are many here.
        return DynamixelServos(BusConfig(port, max_silence_s=0.5, silence_s=0.6), [1], VoltageDrive(5.0))


class TestThreeServosByAngle(DeviceConformance):
    emulation = EmulatorConfig
    plant = Joints

    def make_device(self, port):
        bus = BusConfig(port, max_silence_s=0.5, silence_s=0.6)
        return DynamixelServos(bus, (1, 2, 3), PositionDrive(800, 20.0))


class TestFeetech(DeviceConformance):
    emulation = StsEmulation
    plant = Joints

    def make_device(self, port):
        joints = [ServoJoint(f"joint{i}", i) for i in (1, 2, 3)]
        return StsServos(BusConfig(port, max_silence_s=0.5, silence_s=0.6), joints)


class TestODrive(DeviceConformance):
    """The plug-in's own tests are these, in the package that is installed: tests/process/test_plugin.py."""

    emulation = ODriveEmulation
    plant = Turntable

    def make_device(self, port):
        return ODrive(port, (0,), SpeedLoop(), baud_rate=115_200, silence_s=0.6)


class TestUnitreeLegs(DeviceConformance):
    patience_s = 2.0
    no_address = "no-such-interface:0"
    silent_after_s = 1.0

    def make_device(self, port):
        pytest.importorskip("cyclonedds")
        from sim2real.hardware.unitree.device import UnitreeLegs
        from sim2real.hardware.unitree.legs import LegDrive

        return UnitreeLegs(port, drive=LegDrive(lie_s=1.0), silence_s=0.6, max_silence_s=0.5)

    def make_robot(self, truth_path, **settings):
        pytest.importorskip("cyclonedds")
        from sim2real.emulation.legs import UnitreeEmulation, VirtualLegs

        # Its motors go on when their host dies: the guardian must cope with that.
        return VirtualLegs(Go2Body("floor"), UnitreeEmulation(**settings), truth_path)
