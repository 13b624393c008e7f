"""What is known about the servos' models stands in the code, in the guide, and in what is said when a bus is opened."""

from pathlib import Path

from sim2real.hardware import dynamixel, feetech

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "safety.md"


def test_the_guide_has_the_table():
    cells = [line.strip("| ").split(" | ") for line in GUIDE.read_text().splitlines() if line.startswith("| ")]
    rows = {name: rest for names, *rest in cells for name in names.split(", ")}
    for model in [*dynamixel.MODELS.values(), *feetech.MODELS.values()]:
        words = model.without_host(0.1).replace("after 0.1 s", "after `servo_watchdog_s`")
        assert rows[model.name] == [words, model.source]


def test_of_an_unknown_model_the_worst_is_assumed():
    assert "goes on" in dynamixel.model(99).without_host(0.1)
    assert dynamixel.model(99).name == "model 99"
    assert dynamixel.model(1060).without_host(0.0) == "goes on as commanded last (its bus watchdog is off)"
