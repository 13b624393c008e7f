import pytest
from sts_bench import IDS, PLANTS, Bench, Served

from sim2real.hardware.feetech.calibration import CalibratedJoint as Joint
from sim2real.hardware.feetech.device import StsConfig, StsServos
from sim2real.hardware.feetech.emulation import StsEmulation
from sim2real.hardware.plant import load_plant


@pytest.fixture
def serve(tmp_path):
    """Start emulated servos; stopped at the end of the test."""
    served = []

    def start(plant="Joints", config=None, **plant_args):
        path = tmp_path / f"truth{len(served)}.bin"
        made = load_plant(f"{PLANTS}:{plant}", plant_args)
        served.append(Served(path, made, config or StsEmulation(return_delay_us=0)))
        return served[-1]

    yield start
    for robot in served:
        robot.stop()


@pytest.fixture
def connect():
    """Open a device to emulated servos; patient, for the machine may be busy."""
    devices = []

    def open_(robot, ids=IDS, joints=None, drive=None, **config):
        patience = {"max_silence_s": 1.0, "silence_s": 1.0}
        joints = joints or [Joint(f"joint{i}", i) for i in ids]
        device = StsServos(StsConfig(robot.port, **{**patience, **config}), joints, drive)
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
