"""The emulated Go2 behind DDS: who reads and drives it, and how it sinks when its host is gone."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

idl = pytest.importorskip("cyclonedds.idl")
from emulator import EmulatedProcess  # noqa: E402
from unitree_bench import CONTROLS, DAMPS, OFF, ways  # noqa: E402

from sim2real.emulation.legs import UnitreeEmulation  # noqa: E402
from sim2real.emulation.truth import Kind  # noqa: E402
from sim2real.errors import HardwareLost  # noqa: E402
from sim2real.hardware.unitree import device  # noqa: E402
from sim2real.hardware.unitree.device import UnitreeLegs  # noqa: E402

pytestmark = pytest.mark.process

ROOT = Path(__file__).resolve().parents[2]
BODY = "pipelines.go2.plant:Go2Body"
VERSION = "1.0.1"


def test_a_robot_that_is_not_there_is_lost(monkeypatch):
    monkeypatch.setattr(device, "_OPEN_S", 0.2)
    with pytest.raises(HardwareLost, match="has sent no state"):
        UnitreeLegs("lo:9").open()


@pytest.fixture(scope="module")
def unitree_sdk():
    """Return a folder with Unitree's client. It pins another cyclonedds and OpenCV, so pip installs it alone, once."""
    folder = ROOT / ".cache" / f"unitree-sdk2-{VERSION}"
    if not (folder / "unitree_sdk2py").is_dir():
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", folder]
        subprocess.run([*command, f"unitree-sdk2=={VERSION}"], check=True, timeout=100)
    return folder


@pytest.mark.night
def test_unitrees_own_client_lets_the_emulated_robot_stand_up(tmp_path, unitree_sdk):
    client = Path(__file__).with_name("unitree_client.py")
    with EmulatedProcess(BODY, UnitreeEmulation(0.004, 0.006, 0.0005), {}, tmp_path / "truth.bin") as robot:
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


HOST = """
import sys, time, numpy as np
from sim2real.errors import Sim2RealError
from sim2real.hardware.safety.gate import GateConfig
from sim2real.hardware.safety.rig import Rig
from sim2real.hardware.unitree.device import UnitreeLegs
from sim2real.hardware.unitree.legs import LegDrive
from pipelines.go2.plant import LYING

device = UnitreeLegs({port!r}, drive=LegDrive(lie_s=3.0), silence_s=0.6, max_silence_s=1.0)
low, high = device.reach()
gate = GateConfig((low.tolist(), high.tolist()), stale=device.commanded.stale, command_timeout_s=2.0)
with Rig(device, gate) as rig:
    rig.start()
    print("on", flush=True)
    begin_s, law = time.monotonic(), np.tile([0.0, 0.0, 60.0, 4.0, 0.0], (12, 1))
    try:
        while (t_s := time.monotonic() - begin_s) < 60.0:  # it stands up within 0.6 s
            law[:, 0] = LYING + min(1.0, t_s / 0.6) * (np.array([0.0, 0.8, -1.5] * 4) - LYING)
            rig.command(law, 0.0, t_s)
            rig.measure()
            time.sleep(0.015)
    except Sim2RealError as error:
        rig.close()
        print(error, flush=True)
        sys.exit(error.exit_code)
"""


@pytest.mark.night
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGKILL, id="killed"), pytest.param(signal.SIGSTOP, id="stopped")]
)
def test_a_robot_that_stands_sinks_before_its_motors_switch_off(tmp_path, number):
    robot = EmulatedProcess(BODY, UnitreeEmulation(), {"place": "floor"}, tmp_path / "truth.bin")
    code = HOST.format(port=robot.port)
    host = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert host.stdout.readline() == "on\n", host.stderr.read()
    time.sleep(1.2)
    end_ns = time.monotonic_ns()
    host.send_signal(number)
    if number == signal.SIGSTOP:
        time.sleep(1.0)
        host.send_signal(signal.SIGCONT)
    # The guardian holds the other end of stderr, until it ends.
    said, errors = host.communicate(timeout=20)
    # The motors were driven, damped, and switched off; in this order, once each.
    found, since_ns = ways(robot)
    assert found[-3:] == [CONTROLS, DAMPS, OFF]
    damped_s, off_s = (since_ns[-2:] - end_ns) * 1e-9
    assert 0.0 < damped_s < (0.3 if number == signal.SIGKILL else 1.0)
    assert off_s > damped_s + 0.3
    # It sinks more slowly than it falls, and lies when the torque goes off.
    t_ns, states = robot.truth().states()
    height, sinking = states["base[2]"], t_ns > end_ns
    assert height[~sinking][-1] > 0.25
    assert np.gradient(height, 1e-9 * t_ns)[sinking].min() > -1.0
    assert height[t_ns < since_ns[-1]][-1] < 0.12
    last = {int(row["servo_id"]): row["values"][0] for row in robot.truth().of(Kind.EFFECT)}
    assert last == dict.fromkeys(range(12), 0.0)
    reason = "the control process is gone" if number == signal.SIGKILL else "the control process was silent"
    assert f"sim2real guardian: {reason}" in errors
    assert "torque is off, confirmed after" in errors
    if number == signal.SIGSTOP:
        assert host.returncode == 3, (said, errors)
