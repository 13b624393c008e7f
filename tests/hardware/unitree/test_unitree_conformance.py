"""The legs fulfil the contract of a device."""

import pytest

pytest.importorskip("cyclonedds")
from pipelines.go2.plant import Go2Body
from sim2real.emulation.conformance import DeviceConformance
from sim2real.emulation.legs import UnitreeEmulation
from sim2real.emulation.virtual_legs import VirtualLegs
from sim2real.hardware.unitree.device import UnitreeLegs
from sim2real.hardware.unitree.legs import LegDrive


class TestUnitreeLegs(DeviceConformance):
    patience_s = 2.0
    no_address = "no-such-interface:0"
    silent_after_s = 1.0

    def make_device(self, port):
        return UnitreeLegs(port, drive=LegDrive(lie_s=1.0), silence_s=0.6, max_silence_s=0.5)

    def make_robot(self, truth_path, **settings):
        # Its motors go on when their host dies: the guardian must cope with that.
        return VirtualLegs(Go2Body("floor"), UnitreeEmulation(alone_after_s=None, **settings), truth_path)
