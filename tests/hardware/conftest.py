import pytest
from virtual_bus import VirtualBus

from sim2real.emulation.dynamixel import EmulatorConfig


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
