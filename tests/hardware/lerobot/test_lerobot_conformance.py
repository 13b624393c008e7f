"""LeRobot's own follower class drives the emulated servos: the suite of devices runs where LeRobot is importable."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.night, pytest.mark.process]

ROOT = Path(__file__).resolve().parents[3]
SUITE = Path(__file__).with_name("lerobot_suite.py")
VERSION = "0.4.4"
NEEDED = (
    *(
        f"lerobot=={VERSION}",
        "feetech-servo-sdk==1.0.0",
        "draccus==0.10.0",
        "mergedeep==1.3.4",
        "pyyaml-include==1.4.1",
    ),
    *("PyYAML>=6", "toml==0.10.2", "typing-inspect==0.9.0", "mypy-extensions==1.1.0", "typing-extensions>=4.12"),
    *("deepdiff==8.6.1", "orderly-set==5.5.0", "huggingface-hub==0.35.3"),
)
"""The packages that LeRobot's follower and its motors import beside numpy, pyserial and tqdm: 22 MB. LeRobot declares
more, PyTorch among them, which no robot uses; `lerobot_suite.py` has stand-ins for those."""


@pytest.fixture(scope="module")
def site():
    """Return a folder with LeRobot's follower, installed once; LeRobot cannot be in the environment of the viewer."""
    folder = ROOT / ".cache" / f"lerobot-{VERSION}"
    done = folder / "installed.txt"
    if not done.exists() or done.read_text() != repr(NEEDED):
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--upgrade", "--target", folder]
        subprocess.run([*command, *NEEDED], check=True, timeout=250)
        done.write_text(repr(NEEDED))
    return folder


def test_the_follower_of_lerobot_passes_the_suite_of_devices(site, tmp_path):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--noconftest", "-c", os.devnull, SUITE]
    path = os.pathsep.join(map(str, (site, ROOT)))
    env = {name: value for name, value in os.environ.items() if name != "PYTEST_ADDOPTS"} | {"PYTHONPATH": path}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=env, timeout=280)
    assert done.returncode == 0, done.stdout[-4000:]
    assert re.search(r"\b19 passed\b", done.stdout)
    assert "failed" not in done.stdout
