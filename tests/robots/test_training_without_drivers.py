"""Loading a robot and preparing its training imports no driver: a machine for training needs no pyserial."""

import json
import subprocess
import sys

import pytest

SCRIPT = """
import json, sys
sys.modules["serial"] = None  # an import of pyserial fails
from sim2real.stages.config import TrainConfig
from sim2real.stages.load import load_robot
from sim2real.stages.train import stage
from sim2real.stages.train.setup import prepare
pipeline = load_robot(sys.argv[1])
prepare(pipeline, TrainConfig(model="nominal", episode_s=0.5, timelines=1), None)
print(json.dumps([n for n in sys.modules if n.startswith("sim2real.hardware.") and n.endswith((".device", ".drive"))]))
"""

TABLES = (
    "",
    ".safety",
    ".safety.gate",
    ".device",  # the interface of a device
    ".bus",
    ".bus.registers",
    *(f".{f}{m}" for f in ("dynamixel", "feetech") for m in ("", ".registers")),
)


@pytest.mark.parametrize("name", ["pendulum", *(pytest.param(n, marks=pytest.mark.night) for n in ("arm", "so101"))])
def test_training_imports_no_driver_and_no_pyserial(name):
    done = subprocess.run([sys.executable, "-c", SCRIPT, name], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    # Limits, tables of registers and the interface of a device are no drivers.
    assert set(json.loads(done.stdout.splitlines()[-1])) <= {f"sim2real.hardware{name}" for name in TABLES}
