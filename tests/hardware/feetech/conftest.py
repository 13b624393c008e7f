import pytest
from sts_bench import IDS, PLANTS, Bench

from sim2real.hardware.emulation.virtual import VirtualRobot
from sim2real.hardware.feetech.calibration import CalibratedJoint as Joint
from sim2real.hardware.feetech.device import StsConfig, StsServos
from sim2real.hardware.feetech.emulation import StsEmulation


@pytest.fixture
def serve(tmp_path):
    """Start emulated servos in virtual time; stopped at the end of the test."""
    served = []

    def start(plant="Joints", config=None, **plant_args):
        path = tmp_path / f"truth{len(served)}.bin"
        config = config or StsEmulation(return_delay_us=0)
        served.append(VirtualRobot(f"{PLANTS}:{plant}", config, plant_args, path))
        return served[-1]

    yield start
    for robot in served:
        robot.stop()


@pytest.fixture
def connect():
    """Open a device to emulated servos."""
    devices = []

    def open_(robot, ids=IDS, joints=None, drive=None, **config):
        joints = joints or [Joint(f"joint{i}", i) for i in ids]
        device = StsServos(StsConfig(robot.port, **{"silence_s": 1.0, **config}), joints, drive)
        devices.append(device)
        device.open()
        return device

    yield open_
    for device in devices:
        device.close()


@pytest.fixture
def make_bench(tmp_path):
    benches = []

    def make(plant="Joints", config=None, **plant_args):
        config = config or StsEmulation(return_delay_us=0)
        benches.append(Bench(tmp_path / "truth.bin", plant, config, **plant_args))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()
