import pytest

from sim2real.emulation.feetech import StsEmulation

STS = StsEmulation(return_delay_us=0)


@pytest.fixture
def make_sts(make_bench):
    return lambda plant="Joints", config=STS, **plant_args: make_bench(plant, config, **plant_args)
