import plants
import pytest
from virtual_bus import VirtualBus

from sim2real.emulation.bus import VirtualRobot
from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.hardware.bus.port import BusConfig
from sim2real.hardware.bus.servos import VoltageDrive
from sim2real.hardware.dynamixel import DynamixelServos


@pytest.fixture
def start_robot(tmp_path):
    """Start an emulated robot in virtual time; stopped at the end of the test."""
    robots = []

    def start(plant="FirstOrder", config=None, **plant_args):
        path = tmp_path / f"truth{len(robots)}.bin"
        robots.append(VirtualRobot(getattr(plants, plant)(**plant_args), config or EmulatorConfig(), path))
        return robots[-1]

    yield start
    for robot in robots:
        robot.stop()


@pytest.fixture
def open_servos():
    """Open DYNAMIXEL servos of a robot by voltage; with torque unless told otherwise."""
    devices = []

    def open_(robot, ids=(1,), torque=True, drive=None, **config):
        config = BusConfig(robot.port, **{"silence_s": 1.0, **config})
        devices.append(DynamixelServos(config, ids, drive or VoltageDrive(5.0)))
        devices[-1].open()
        if torque:
            devices[-1].enable()
        return devices[-1]

    yield open_
    for device in devices:
        device.close()


@pytest.fixture
def make_bench(tmp_path):
    benches = []

    def make(plant="FirstOrder", config=None, **plant_args):
        config = config or EmulatorConfig(return_delay_us=0)
        benches.append(VirtualBus(tmp_path / "truth.bin", plant, config, **plant_args))
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()
