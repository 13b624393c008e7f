import pytest
from virtual_bus import PLANTS, VirtualBus

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.emulation.virtual import VirtualRobot
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus


@pytest.fixture
def start_robot(tmp_path):
    """Start an emulated robot in virtual time; stopped at the end of the test."""
    robots = []

    def start(plant="FirstOrder", config=None, **plant_args):
        path = tmp_path / f"truth{len(robots)}.bin"
        robots.append(VirtualRobot(f"{PLANTS}:{plant}", config or EmulatorConfig(), plant_args, path))
        return robots[-1]

    yield start
    for robot in robots:
        robot.stop()


@pytest.fixture
def open_bus():
    """Open a bus to a robot and shake hands with the servos given."""
    buses = []

    def open_(robot, ids=(1,), mode=None, **config):
        bus = ServoBus(BusConfig(robot.port, **{"silence_s": 1.0, **config}))
        buses.append(bus)
        bus.open()
        bus.handshake(dict.fromkeys(ids))
        if mode is not None:
            bus.setup(mode)
            bus.torque(True)
        return bus

    yield open_
    for bus in buses:
        bus.close()


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
