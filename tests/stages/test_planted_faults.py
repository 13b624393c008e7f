"""Twelve faults, each planted in a log of an arm: the identification is rejected, and its worst second is the fault's.

Each log is simulated in C MuJoCo and identified with the command line, without folds and free runs.
"""

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from sim2real import cli

RATE_HZ, SECONDS, DELAY_S, KP = 100.0, 16.0, 0.02, 10.0
BEGIN_S, END_S = 11.0, 15.0
"""The faulty part; the last quarter of the log is held out."""
JOINTS = LIFT, ELBOW, WRIST = "lift", "elbow", "wrist"
LINK = """<body name="{name}" pos="0 0 {at}"><joint name="{name}" axis="0 1 0" damping="0.2" armature="0.02"
  frictionloss="0.05"/><geom type="capsule" fromto="0 0 0 0 0 -{long}" size="0.02" mass="{mass}" contype="0"
  conaffinity="0"/>{child}</body>"""
HAND = LINK.format(name=WRIST, at=-0.2, long=0.1, mass=0.1, child="")
LOWER = LINK.format(name=ELBOW, at=-0.25, long=0.2, mass=0.2, child=HAND)
XML = f"""<mujoco><option timestep="0.002" integrator="implicitfast"/><worldbody>
{LINK.format(name=LIFT, at=0, long=0.25, mass=0.3, child=LOWER)}</worldbody></mujoco>"""


def simulated(fault=None):
    """Return stamps [s], goals and positions [rad] of three joints with a delay of 20 ms, in steps of 1 ms.

    ``fault`` is called before each step with the time [s], the model, and a dict of the arm's ``delay_s``, ``kp``,
    ``most`` (largest torque) and ``share`` of delivered messages, each ``(3,)``.
    """
    model = mujoco.MjModel.from_xml_string(XML.replace("0.002", "0.001"))
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    t = np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    rates = np.array([0.3, 0.7, 1.3, 2.1]) * rng.uniform(0.8, 1.25, (3, 4))
    goal = 0.2 * np.sin(2 * np.pi * t[:, None, None] * rates + rng.uniform(0, 6, (3, 4))).sum(axis=2)
    goal *= np.minimum(1, t)[:, None]
    delivered, heard = rng.random(goal.shape), np.zeros(3)
    q = np.zeros_like(goal)
    for k in range(round(1e3 * SECONDS)):
        arm = {"delay_s": np.full(3, DELAY_S), "kp": np.full(3, KP), "most": np.full(3, np.inf), "share": np.ones(3)}
        if fault is not None:
            fault(1e-3 * k, model, arm)
        if k % 10 == 0:
            q[k // 10] = data.qpos
        rows = np.floor((1e-3 * k - arm["delay_s"]) * RATE_HZ + 1e-6).astype(int)
        for j, row in enumerate(rows):
            if row >= 0 and delivered[row, j] < arm["share"][j]:
                heard[j] = goal[row, j]
        data.qfrc_applied[:] = np.clip(arm["kp"] * (heard - data.qpos), -arm["most"], arm["most"])
        mujoco.mj_step(model, data)
    return t, goal, q + 2e-4 * rng.standard_normal(q.shape)


def in_motion(change, end_s=END_S):
    """Return a log whose arm is changed during the faulty part: ``change(model, arm)``."""

    def fault(now_s, model, arm):
        if BEGIN_S <= now_s < end_s:
            change(model, arm)
        elif now_s >= end_s:
            model.dof_frictionloss[1] = 0.05

    return lambda: simulated(fault)


def in_log(change, end_s=END_S):
    """Return a log whose measurements are changed in the faulty part: ``change(q, rows)``."""

    def log():
        t, goal, q = simulated()
        change(q, np.flatnonzero((t >= BEGIN_S) & (t < end_s)))
        return t, goal, q

    return log


def setting(name, value):
    """Change the elbow's ``delay_s``, ``kp``, ``most`` or ``share``."""
    return lambda model, arm: arm[name].__setitem__(1, value)


def friction(value):
    """Change the elbow's friction [N m]."""
    return lambda model, arm: model.dof_frictionloss.__setitem__(1, value)


def laden(model, arm):
    """Add 1.5 kg to the hand."""
    model.body_mass[model.body(WRIST).id] = 1.6


def elbow(values):
    """Replace the elbow's positions: ``values(positions, rows)``."""
    return lambda q, rows: q[:, 1].__setitem__(rows, values(q[:, 1], rows))


def swapped(q, rows):
    """Exchange the positions of elbow and wrist."""
    q[np.ix_(rows, [1, 2])] = q[np.ix_(rows, [2, 1])]


def lost(x, rows):
    """Repeat the last position for most messages."""
    gone, x = np.random.default_rng(3).random(len(rows)) < 0.97, x.copy()
    for k in rows[gone]:
        x[k] = x[k - 1]
    return x[rows]


frozen = elbow(lambda x, rows: x[rows[0]])
reversed_sign = elbow(lambda x, rows: -x[rows])
zero_moved = elbow(lambda x, rows: x[rows] + 1.0)
noisy = elbow(lambda x, rows: x[rows] + np.random.default_rng(5).uniform(-0.58, 0.58, len(rows)))
slow_clock = elbow(lambda x, rows: np.interp(rows[0] + 0.9 * (rows - rows[0]), np.arange(len(x)), x))
ALWAYS = float("inf")
FAULTS = {
    "a joint sticks": (in_motion(friction(1e3)), {ELBOW}, END_S),
    "a wrong sign": (in_log(reversed_sign, ALWAYS), {ELBOW}, SECONDS),
    "the delay jumps": (in_motion(setting("delay_s", 0.35), ALWAYS), {ELBOW}, SECONDS),
    "saturation": (in_motion(setting("most", 0.3)), {ELBOW}, END_S),
    "two joints are swapped": (in_log(swapped, ALWAYS), {ELBOW, WRIST}, SECONDS),
    "the zero moves": (in_log(zero_moved, ALWAYS), {ELBOW}, SECONDS),
    "a payload is added": (in_motion(laden, ALWAYS), {LIFT, ELBOW}, SECONDS),
    "messages are lost": (in_log(elbow(lost)), {ELBOW}, END_S),
    "a frozen encoder": (in_log(frozen), {ELBOW}, END_S),
    "a noisy sensor": (in_log(noisy, ALWAYS), {ELBOW}, SECONDS),
    "friction changes": (in_motion(friction(3.0), ALWAYS), {ELBOW}, SECONDS),
    "a wrong time scale": (in_log(slow_clock, ALWAYS), {ELBOW}, SECONDS),
}
"""Name -> function that returns the log, the joints that may be named, and the end of the faulty part [s]."""


def identified(t, goal, q):
    """Identify from a log in the working directory; return parameters.json."""
    Path("robot.xml").write_text(XML)
    np.savez("run.npz", t_s=t, q_rad=q, goal_rad=goal)
    assert cli.main(["new", "rig", "--mjcf", "robot.xml", "--log", "run.npz", "--as-told"]) == 0
    assert cli.main(["identify", "rig", "--log", "run.npz", "--folds", "0", "--free-run-s", "0"]) == 0
    (folder,) = Path.cwd().glob("runs/rig/*/identify")
    return json.loads((folder / "parameters.json").read_text())


@pytest.mark.night
@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_log_is_rejected_with_the_second_of_the_fault(name, tmp_path, monkeypatch):
    log, joints, end_s = FAULTS[name]
    monkeypatch.chdir(tmp_path)
    result = identified(*log())
    assert result["verdict"]["status"] != "accepted"
    worst = result["worst"]
    assert worst["joint"] in joints
    assert BEGIN_S - 0.5 <= worst["begin_s"] <= end_s - 0.5


@pytest.mark.night
def test_a_fault_in_the_fitted_part_is_refused_and_named(tmp_path, monkeypatch, capsys):
    """Held-out errors alone are those of a good model."""
    t, goal, q = simulated()
    frozen(q, np.flatnonzero((t >= 4.0) & (t < 5.5)))
    monkeypatch.chdir(tmp_path)
    result = identified(t, goal, q)
    assert result["verdict"]["status"] == "change the model"
    said = capsys.readouterr().err
    begin_s = float(re.search(r"joint elbow, (\d+\.\d) s of run", said)[1])
    assert 4.0 <= begin_s <= 4.7
