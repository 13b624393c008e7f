"""Feetech servos fulfil the contract of a device."""

from pathlib import Path

from sim2real.emulation.conformance import DeviceConformance
from sim2real.emulation.feetech import StsEmulation
from sim2real.hardware.feetech.calibration import CalibratedJoint as Joint
from sim2real.hardware.feetech.device import StsConfig, StsServos

PLANTS = Path(__file__).parents[1] / "plants.py"


class TestStsServos(DeviceConformance):
    emulation = StsEmulation
    plant = f"{PLANTS}:Joints"

    def make_device(self, port):
        # Patient with lost answers, for the machine may be busy.
        config = StsConfig(port, max_silence_s=0.5, silence_s=0.6)
        return StsServos(config, [Joint(f"joint{i}", i) for i in (1, 2, 3)])
