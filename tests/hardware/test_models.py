"""What is known about the servos' models stands in the code, in the guide, and in what is said when a bus is opened."""

from pathlib import Path

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.hardware.bus import models
from sim2real.hardware.device import Alone
from sim2real.hardware.dynamixel import models as dynamixel
from sim2real.hardware.dynamixel.bus import BusConfig, ServoBus
from sim2real.hardware.feetech import device as feetech

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "safety.md"


def test_the_guide_has_the_table():
    assert models.table([*dynamixel.MODELS.values(), *feetech.MODELS.values()]) in GUIDE.read_text()


def test_of_an_unknown_model_the_worst_is_assumed():
    assert dynamixel.model(99).without_host(0.1).does is Alone.GOES_ON
    assert dynamixel.model(99).name == "model 99"
    assert dynamixel.model(1060).without_host(0.0).words == "goes on as commanded last (its bus watchdog is off)"


def test_an_open_bus_says_what_its_servos_do_alone(start_robot):
    robot = start_robot(config=EmulatorConfig(model_number=1200, watchdog_stops=True), ids=[1, 4])
    with ServoBus(BusConfig(robot.port)) as bus:
        bus.handshake({1: None, 4: None})
        (said,) = bus.without_host()
    assert str(said) == "XL330-M288 (servo 1, servo 4) notices after 0.1 s, but goes on as commanded last"
