"""DYNAMIXEL servos fulfil the contract of a device, driven by voltage and by angle."""

from pathlib import Path

from sim2real.emulation.conformance import DeviceConformance
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.hardware.dynamixel.bus import BusConfig
from sim2real.hardware.dynamixel.device import DynamixelServos
from sim2real.hardware.dynamixel.drive import PositionDrive, VoltageDrive

PLANTS = Path(__file__).parent / "plants.py"


class TestOneServoByVoltage(DeviceConformance):
    emulation = EmulatorConfig
    plant = f"{PLANTS}:FirstOrder"

    def make_device(self, port):
        # Patient with lost answers, for the machine may be busy.
        return DynamixelServos(BusConfig(port, max_silence_s=0.5, silence_s=0.6), [1], VoltageDrive(5.0))


class TestThreeServosByAngle(DeviceConformance):
    emulation = EmulatorConfig
    plant = f"{PLANTS}:Joints"

    def make_device(self, port):
        bus = BusConfig(port, max_silence_s=0.5, silence_s=0.6)
        return DynamixelServos(bus, (1, 2, 3), PositionDrive(p_gain=800, profile_velocity_rad_s=20.0))
