"""The ODrive keeps what sim2real asks of a device."""

from turntable.odrive import ODrive, SpeedLoop
from turntable.odrive_emulation import ODriveEmulation
from turntable.plant import Turntable

from sim2real.emulation.conformance import DeviceConformance


class TestODrive(DeviceConformance):
    emulation = ODriveEmulation
    plant = Turntable

    def make_device(self, port):
        return ODrive(port, (0,), SpeedLoop(), baud_rate=115_200, silence_s=0.6)
