"""Feetech servos fulfil the contract of a device."""

from pathlib import Path

from sim2real.hardware.feetech.calibration import CalibratedJoint as Joint
from sim2real.hardware.feetech.device import StsConfig, StsServos
from sim2real.hardware.feetech.emulation import StsEmulation
from sim2real.hardware.testing import DeviceConformance

PLANTS = Path(__file__).parents[1] / "plants.py"


class TestStsServos(DeviceConformance):
    emulation = StsEmulation
    plant = f"{PLANTS}:Joints"

    def make_device(self, port):
        # Patient with lost answers, for the machine may be busy.
        config = StsConfig(port, max_silence_s=0.5, silence_s=0.6)
        return StsServos(config, [Joint(f"joint{i}", i) for i in (1, 2, 3)])
