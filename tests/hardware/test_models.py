"""What is known about the servos' models stands in the code, in the guide, and in what is said when a bus is opened."""

from pathlib import Path

from sim2real.emulation.dynamixel import EmulatorConfig
from sim2real.hardware import dynamixel, feetech
from sim2real.hardware.bus.registers import reaction_table
from sim2real.hardware.device import Alone

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "safety.md"


def test_the_guide_has_the_table():
    assert reaction_table([*dynamixel.MODELS.values(), *feetech.MODELS.values()]) in GUIDE.read_text()


def test_of_an_unknown_model_the_worst_is_assumed():
    assert dynamixel.model(99).without_host(0.1).does is Alone.GOES_ON
    assert dynamixel.model(99).name == "model 99"
    assert dynamixel.model(1060).without_host(0.0).words == "goes on as commanded last (its bus watchdog is off)"


def test_open_servos_say_what_they_do_alone(start_robot, open_servos):
    robot = start_robot(config=EmulatorConfig(model_number=1200, watchdog_stops=True), ids=[1, 4])
    (said,) = open_servos(robot, (1, 4), torque=False, silence_s=0.1).without_host()
    assert str(said) == "XL330-M288 (servo 1, servo 4) notices after 0.1 s, but goes on as commanded last"
