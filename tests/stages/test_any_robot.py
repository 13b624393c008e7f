"""From somebody's model and log to parameters, all by flags; the truth is a simulation in C MuJoCo, written by hand."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sim2real import cli

RATE_HZ, DELAY_S = 100.0, 0.024
TRUTH = {"kp": 9.0, "damping": 0.35, "armature": 0.012, "frictionloss_lift": 0.05}
XML = """<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body name="upper"><joint name="lift" axis="0 1 0" damping="0.2" armature="0.02" frictionloss="0.02"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.3"/>
    </body>
  </worldbody>
</mujoco>"""


def simulated(seed, duration_s=10.0):
    """Return stamps [s], goals and positions [rad] of a joint that hears each goal 24 ms late, in steps of 1 ms."""
    model = mujoco.MjModel.from_xml_string(XML.replace("0.002", "0.001"))
    model.dof_damping[0], model.dof_armature[0] = TRUTH["damping"], TRUTH["armature"]
    model.dof_frictionloss[0] = TRUTH["frictionloss_lift"]
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    t = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    goal = sum(0.25 * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for f in (0.3, 0.7, 1.3, 2.1)) * np.minimum(1, t)
    q, late = np.zeros_like(t), round(1e3 * DELAY_S)
    for k in range(round(1e3 * duration_s)):
        if k % 10 == 0:
            q[k // 10] = data.qpos[0]
        heard = goal[(k - late) // 10] if k >= late else 0.0
        data.qfrc_applied[0] = TRUTH["kp"] * (heard - data.qpos[0])
        mujoco.mj_step(model, data)
    return t, goal, q + 2e-4 * rng.standard_normal(q.shape)


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A working directory with a model and two logs."""
    monkeypatch.chdir(tmp_path)
    Path("robot.xml").write_text(XML)
    for name, seed in (("run", 0), ("later", 1)):
        t, goal, q = simulated(seed)
        np.savez(f"{name}.npz", t_s=t, q_rad=q[:, None], goal_rad=goal[:, None])
    return tmp_path


@pytest.mark.night
def test_a_model_and_a_log_give_parameters_that_hold_on_a_later_log(workplace, capsys):
    assert cli.main(["new", "rig", "--mjcf", "robot.xml", "--log", "run.npz"]) == 0
    assert cli.main(["identify", "rig", "--log", "run.npz", "--folds", "2", "--free-run-s", "0"]) == 0
    assert "verdict: accepted" in capsys.readouterr().err
    (folder,) = workplace.glob("runs/rig/*/identify")
    found = json.loads((folder / "parameters.json").read_text())
    rows = {p["name"]: p["estimate"] for p in found["parameters"]}
    assert found["verdict"]["status"] == "accepted"
    for name, truth in TRUTH.items():
        assert rows[name] == pytest.approx(truth, rel=0.05), name
    assert rows["delay"] == pytest.approx(DELAY_S, abs=1e-3)
    model = mujoco.MjModel.from_xml_path(str(folder / "identified.xml"))
    assert model.dof_damping[0] == pytest.approx(rows["damping"], rel=1e-5)
    assert cli.main(["validate", str(folder / "parameters.json"), "--log", "later.npz", "--json"]) == 0
    ahead, free = json.loads(capsys.readouterr().out)["errors"]
    assert (ahead["free_run"], ahead["exceeded"]) == (False, False)
    assert (free["free_run"], free["expected"], free["ratio"]) == (True, None, None)
    assert ahead["ratio"] == pytest.approx(ahead["error"] / ahead["expected"])
    assert cli.main(["export", str(folder / "parameters.json"), "--out", "exported.xml"]) == 0
    assert "not expressed" not in capsys.readouterr().err
    t, goal, q = simulated(1)
    assert np.abs(alone("exported.xml", t, goal) - q).max() < 0.02 * np.ptp(q)


def alone(path, t, goals):
    """Return what a model's joint does [rad] when its one actuator gets the goals, with nothing else around it."""
    model = mujoco.MjModel.from_xml_path(path)
    data, q = mujoco.MjData(model), np.zeros_like(t)
    step_s = model.opt.timestep
    for k in range(round(t[-1] / step_s) + 1):
        now = k * step_s
        row = min(int(now * RATE_HZ + 1e-6), len(t) - 1)
        if abs(now - t[row]) < 0.5 * step_s:
            q[row] = data.qpos[0]
        data.ctrl[0] = goals[row]
        mujoco.mj_step(model, data)
    return q
