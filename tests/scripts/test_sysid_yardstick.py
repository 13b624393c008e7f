"""The yardstick of identification: mujoco.sysid on short recordings."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from mujoco import sysid as toolbox

REPOSITORY = Path(__file__).resolve().parent.parent.parent
DATA = Path(os.environ.get("SIM2REAL_DATA", REPOSITORY.parent / "shared" / "data"))

if not hasattr(toolbox, "optimize"):
    pytest.skip("needs mujoco[sysid]: pip install 'sim2real[bench]'", allow_module_level=True)

sys.path.insert(0, str(REPOSITORY / "scripts"))
from benches.identify import sysid  # noqa: E402


def test_commands_are_held_not_interpolated():
    t, command = np.array([0.0, 0.025, 0.05]), np.array([[1.0], [2.0], [3.0]])
    still = np.zeros((3, 1))
    spec = sysid._disk_problem(delay=False)[0]
    control = sysid._Run(sysid.Recording(t, command, still, np.zeros((1, 2))), spec).control
    assert control.data[:-1, 0].tolist() == [1.0] * 5 + [2.0] * 5 + [3.0]


def test_a_recording_that_ends_without_torque_is_simulated_through():
    t = np.arange(400) * 0.005
    enabled = t < 1.0
    constants = {"kp": 800, "mass": 0.49, "length": 0.1, "torque_enable": enabled}
    goal = np.full((400, 1), 0.5)
    recording = sysid.Recording(t, goal, np.where(enabled, 0.4, 0.0)[:, None], np.zeros((1, 2)), constants)
    rows = {"torque": (0.5, 0.1, 2.0, sysid._torque), "damping": (0.05, 0.0, 0.5, sysid._damping)}
    angle = sysid._free_run(sysid._parameters(rows, delay=False)[0], sysid._xl330_runs(recording))[:, 0]
    assert angle.shape == t.shape
    assert angle[195] > 0.3  # held up against gravity
    assert abs(angle[-1]) < 0.05  # dropped
    assert np.abs(np.diff(angle)).max() < 0.1  # without a jump where the parts meet


@pytest.mark.night  # `make test` finds a delay in test_latency_league.py
@pytest.mark.skipif(not (DATA / "unbalanced_disk" / "disk_fit.npz").is_file(), reason=f"no recordings in {DATA}")
def test_the_delay_of_the_disk_is_found_in_a_short_recording():
    with np.load(DATA / "unbalanced_disk" / "disk_fit.npz") as file:
        command, angle = file["u"][:1200, None], file["th"][:1200, None]
    recording = sysid.Recording(np.arange(1200) * 0.025, command, angle, np.zeros((1, 2)))
    result = sysid.disk(recording.part(0, 800), [recording], delay=True)
    assert 0.018 < result.values["delay"] < 0.030
    low, high = result.interval95["delay"]
    assert low < result.values["delay"] < high
    assert result.physics_steps_per_evaluation == pytest.approx(4000, abs=5)
    assert result.evaluations > 10
    assert np.sqrt(np.mean((result.predictions[0] - angle) ** 2)) < 0.1
