"""The legs fulfil the contract of a device."""

import pytest

pytest.importorskip("cyclonedds")
from sim2real.hardware.testing import DeviceConformance


@pytest.mark.night
@pytest.mark.process
class TestUnitreeLegs(DeviceConformance):
    patience_s = 2.0
    no_address = "no-such-interface:0"
    silent_after_s = 3.0

    def make_device(self, port):
        from sim2real.hardware.unitree.device import UnitreeLegs
        from sim2real.hardware.unitree.legs import LegDrive

        # Patient, for the machine may be busy.
        return UnitreeLegs(port, drive=LegDrive(lie_s=1.0), silence_s=0.6, max_silence_s=0.5)

    def make_robot(self, truth_path, **settings):
        from unitree_bench import emulated

        return emulated(truth_path, **settings)
