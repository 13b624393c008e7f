"""Every device here fulfils the contract of a device, on its emulator in virtual time; an ODrive in tests/plugin."""

from typing import ClassVar

import pytest
from families import ANGLES, LEGS, STS, VOLTS, Family

from sim2real.emulation.conformance import DeviceConformance


class OfFamily(DeviceConformance):
    family: ClassVar[Family]

    def make_device(self, port):
        # Patient with lost answers, which are many here.
        return self.family.make(port, max_silence_s=0.5, silence_s=0.6)

    def make_robot(self, truth_path, **settings):
        place = {"plant": "floor"} if self.family is LEGS else {}
        return self.family.robot(**place, settings=settings, truth_path=truth_path)


class TestDynamixelByVoltage(OfFamily):
    family = VOLTS


class TestDynamixelByAngle(OfFamily):
    family = ANGLES


class TestFeetech(OfFamily):
    family = STS


@pytest.mark.skipif(LEGS is None, reason="the extra unitree")
class TestUnitreeLegs(OfFamily):
    """Its motors go on when their host dies: the guardian must cope with that."""

    family = LEGS
    patience_s = 2.0
    no_address = "no-such-interface:0"
    silent_after_s = 1.0
