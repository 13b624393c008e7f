"""The emulated Go2 behind DDS: Unitree's own client reads and drives it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sim2real.emulation.process import EmbeddedRobot
from sim2real.emulation.truth import Kind

pytest.importorskip("cyclonedds")
from sim2real.emulation.legs import UnitreeEmulation
from sim2real.errors import HardwareLost
from sim2real.hardware.unitree import guarded
from sim2real.hardware.unitree.dds import Address, DdsLink
from sim2real.hardware.unitree.device import UnitreeLegs

pytestmark = pytest.mark.process

ROOT = Path(__file__).resolve().parents[2]
BODY = "pipelines.go2.plant:Go2Body"
VERSION = "1.0.1"


@pytest.fixture(scope="module")
def unitree_sdk():
    """Return a folder with Unitree's client. It pins another cyclonedds and OpenCV, so pip installs it alone, once."""
    folder = ROOT / ".cache" / f"unitree-sdk2-{VERSION}"
    if not (folder / "unitree_sdk2py").is_dir():
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", folder]
        subprocess.run([*command, f"unitree-sdk2=={VERSION}"], check=True, timeout=100)
    return folder


@pytest.mark.night
def test_unitrees_own_client_lets_the_emulated_robot_stand_up(unitree_sdk):
    client = Path(__file__).with_name("unitree_client.py")
    with EmbeddedRobot(BODY, UnitreeEmulation(0.004, 0.006, 0.0005)) as robot:
        command = [sys.executable, client, robot.port.removeprefix("lo:")]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=60, env={"PYTHONPATH": str(unitree_sdk)}, check=False
        )
        assert done.returncode == 0, done.stderr[-2000:]
        report = json.loads(done.stdout.splitlines()[-1])
        truth = robot.truth()
    # It reads the states that the body has, and their CRC by its own code.
    assert report["intact"]
    assert report["states"] > 500
    assert set(np.diff(report["ticks_ms"]) % 2) == {0}
    np.testing.assert_allclose(report["q"], [0.0, 0.8, -1.5] * 4, atol=0.2)
    assert report["quaternion"][0] == pytest.approx(1.0, abs=0.05)
    assert 100.0 < sum(report["foot_force"]) < 200.0  # it weighs 15 kg
    # It drives the motors: the base rises while it writes, and sinks softly afterwards.
    t_ns, states = truth.states()
    effects = truth.of(Kind.EFFECT)
    height = states["base[2]"]
    assert height[t_ns < effects["t_ns"][0]].max() < 0.1
    assert height[t_ns < effects["t_ns"][-1]].max() > 0.27
    late_ms = 1e-6 * (effects["t_ns"] - effects["t_host_ns"])
    assert np.median(late_ms) == pytest.approx(6.0, abs=1.0)


def test_a_robot_starts_in_a_domain_without_programs():
    """The guardian of an earlier robot may still be in that robot's: it would count as a second program."""
    with EmbeddedRobot(BODY, UnitreeEmulation()) as first:
        left_behind = DdsLink(Address.parse(first.port), "of an earlier robot")
    try:
        with EmbeddedRobot(BODY, UnitreeEmulation()) as second:
            assert second.port != first.port
            link = DdsLink(Address.parse(second.port), "another")
            assert link.next_state(5.0) is not None
            link.close()
    finally:
        left_behind.close()


def test_a_robot_that_is_not_there_is_lost(monkeypatch):
    monkeypatch.setattr(guarded, "_OPEN_S", 0.2)
    with pytest.raises(HardwareLost, match="has sent no state"):
        UnitreeLegs("lo:9").open()
