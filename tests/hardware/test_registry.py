"""Devices by name: sim2real's own, and those of packages that declare an entry point."""

import pytest

from sim2real.errors import UsageError
from sim2real.hardware.registry import available, load_device

PACKAGE = """
class Odd:
    def __init__(self, port, ids, drive, *, baud_rate, silence_s):
        self.port, self.motors = port, tuple(f"motor {i}" for i in ids)

NUMBER = 3
"""


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A package with devices, as pip would install it."""
    (tmp_path / "odd_motors.py").write_text(PACKAGE)
    info = tmp_path / "odd_motors-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd-motors\nVersion: 1.0\n")
    entries = {"odd": "odd_motors:Odd", "number": "odd_motors:NUMBER", "gone": "odd_motors:Gone"}
    lines = [f"{name} = {value}" for name, value in entries.items()]
    (info / "entry_points.txt").write_text("\n".join(["[sim2real.devices]", *lines, ""]))
    monkeypatch.syspath_prepend(tmp_path)


def test_a_package_brings_a_device_by_an_entry_point(installed):
    assert {"dynamixel", "odd"} <= set(available())
    device = load_device("odd")("can0", [1, 2], None, baud_rate=1, silence_s=0.1)
    assert device.motors == ("motor 1", "motor 2")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("od", r"unknown device 'od'\. Available: .*dynamixel.*odd(.|\n)*entry point group 'sim2real.devices'"),
        ("number", r"'number' \(odd_motors:NUMBER\) is int, not a callable"),
        ("gone", r"device 'gone' \(odd_motors:Gone\) cannot be imported"),
    ],
)
def test_names_that_make_no_device_are_refused(installed, name, message):
    with pytest.raises(UsageError, match=message):
        load_device(name)
