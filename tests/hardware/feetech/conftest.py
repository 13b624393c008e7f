import pytest
from families import IDS

from sim2real.emulation.feetech import StsEmulation
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import ServoJoint as Joint
from sim2real.hardware.feetech import LEROBOT, StsServos

STS = StsEmulation(return_delay_us=0)


@pytest.fixture
def serve(start_robot):
    """Start emulated servos in virtual time; stopped at the end of the test."""
    return lambda plant="Joints", config=STS, **plant_args: start_robot(plant, config, **plant_args)


@pytest.fixture
def connect():
    """Open a device to emulated servos."""
    devices = []

    def open_(robot, ids=IDS, joints=None, drive=LEROBOT, **config):
        joints = joints or [Joint(f"joint{i}", i) for i in ids]
        device = StsServos(BusConfig(robot.port, **{"silence_s": 1.0, **config}), joints, drive)
        devices.append(device)
        device.open()
        return device

    yield open_
    for device in devices:
        device.close()


@pytest.fixture
def make_sts(make_bench):
    return lambda plant="Joints", config=STS, **plant_args: make_bench(plant, config, **plant_args)
