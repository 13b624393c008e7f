"""The doctor's timing and plant questions, on a pendulum that another simulation moves."""

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_doctor_contract import network

from sim2real import cli
from sim2real.doctor import before, plant
from sim2real.doctor.contract import Contract, Policy, Term, contract_toml
from sim2real.doctor.diagnosis import diagnose, solve_timing
from sim2real.doctor.log import read_deployment
from sim2real.doctor.plant import Drives, driven_joints, solve_plant
from sim2real.doctor.solve import frozen_sensors

XML = """<mujoco><option timestep="0.0025"/><worldbody><body>
<joint name="a" axis="0 1 0" damping="0.01" armature="0.003"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.3" mass="0.4"/><body pos="0 0 -0.3"><joint name="b" axis="0 1 0"
damping="0.01" armature="0.003"/><geom type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.2"/></body></body>
</worldbody></mujoco>"""
CONTRACT = Contract(
    50.0, ("a", "b"), 0.0, 0.5, (Term("joint_pos"), Term("joint_vel")), (8.0, 5.0), (0.3, 0.2), delay_s=0.01
)


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replay a quarter of the windows, and let a policy stand for a third of the time."""
    monkeypatch.setattr(plant, "_WINDOWS", 10)
    monkeypatch.setattr(before, "_SECONDS", 1.3)


def recorded(
    folder: Path, kp: float = 1.0, limit: float = 1e6, delay_s: float = 0.01, rate: float = 50.0, fade: float = 0.0,
    zero: float = 0.0, friction: float = 0.0, sign: float = 1.0, payload: float = 0.0, kd: float = 1.0,
) -> Path:  # fmt: skip
    """Write the log of a robot with its own loop of control; the targets are leaps and waves."""
    model = mujoco.MjModel.from_xml_string(XML.replace('0.4"', '0.41"').replace("0.0025", "0.001"))
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    model.dof_frictionloss[1] = friction
    model.body_mass[2] += payload
    rows: dict[str, list] = {"t": [], "q": [], "dq": [], "target": []}
    waiting, goal = [(0.0, np.zeros(2))], np.zeros(2)
    for tick in range(8000):
        now = tick * 0.001
        if tick % round(1000 / rate) == 0:
            target = 0.5 * np.sin(np.array([4.0, 6.0]) * now) + 0.3 * np.sign(np.sin(np.array([2.1, 2.9]) * now))
            waiting.append((now + delay_s, target))
            q, dq = data.qpos + 5e-4 * rng.normal(size=2), data.qvel + 0.02 * rng.normal(size=2)
            for name, value in {"t": now, "q": q * [1, sign], "dq": dq * [1, sign], "target": target}.items():
                rows[name].append(value)
        while waiting and waiting[0][0] <= now:
            goal = waiting.pop(0)[1]
        strength = kp * (1 - fade * now / 8.0) * np.array([8.0, 5.0])
        torque = strength * (goal - data.qpos - [0, zero]) - kd * np.array([0.3, 0.2]) * data.qvel
        data.qfrc_applied[:] = np.clip(torque, -limit, limit)
        mujoco.mj_step(model, data)
    np.savez(folder / "log.npz", **{k: np.array(v) for k, v in rows.items()})
    (folder / "robot.xml").write_text(XML)
    return folder / "log.npz"


@pytest.mark.parametrize(
    ("setting", "fault"),
    [({}, ""), ({"kp": 0.5}, "gain"), ({"limit": 1.0}, "torque limit"), ({"delay_s": 0.035}, "delay"),
     ({"fade": 0.6}, "battery"), ({"zero": 0.15}, "zero offset"), ({"friction": 0.4}, "friction"),
     ({"sign": -1.0}, "sign"), ({"payload": 0.3}, "payload"), ({"kd": 0.2}, "damping")],
    ids=["sound", "gain", "limit", "delay", "battery", "zero", "friction", "sign", "payload", "damping"],
)  # fmt: skip
def test_the_fault_of_a_plant_is_named(setting: dict[str, float], fault: str, tmp_path: Path) -> None:
    log = read_deployment(recorded(tmp_path, **setting), CONTRACT.joints)
    found, figures = solve_plant(Drives(tmp_path / "robot.xml", CONTRACT), log, CONTRACT)
    assert [f.fault for f in found] == ([fault] if fault else [])
    assert figures["error_fitted"] <= figures["error"]
    if fault == "gain":
        assert figures["kp"] == pytest.approx(0.5, abs=0.05)
    if fault == "delay":
        assert figures["delay_s"] == pytest.approx(0.035, abs=0.005)


def test_windows_lie_where_the_policy_runs(tmp_path: Path) -> None:
    """A recorder may begin long before the policy, while the robot is held by another controller."""
    log = read_deployment(recorded(tmp_path), CONTRACT.joints)
    assert log.target is not None
    late = replace(log, t=log.t[150:], target=log.target[150:])
    starts = plant.Replay(Drives(tmp_path / "robot.xml", CONTRACT), late).starts
    assert len(starts) > 5
    assert late.state_t[starts].min() >= late.t[0]


def test_the_plant_is_judged_until_a_sensor_freezes(tmp_path: Path) -> None:
    log = read_deployment(recorded(tmp_path), CONTRACT.joints)
    q, dq = log.q.copy(), log.dq.copy()
    q[200:, 1], dq[200:, 1] = q[200, 1], 0.0
    policy = Policy(network(np.random.default_rng(0), 4, joints=2), CONTRACT)
    frozen = replace(log, q=q, dq=dq)
    found = diagnose(policy, frozen, Drives(tmp_path / "robot.xml", CONTRACT))
    assert "frozen joint" in found.faults
    assert not [f for f in found.findings if f.question == "plant"]
    assert frozen.target is not None
    at_rest = replace(frozen, target=frozen.target * [1, 0])  # such as a gripper that is to do nothing
    assert frozen_sensors(at_rest, CONTRACT.joints) == []


def test_torque_at_the_limit_of_the_model_is_no_fault(tmp_path: Path) -> None:
    log = read_deployment(recorded(tmp_path, limit=1.0), CONTRACT.joints)
    (tmp_path / "robot.xml").write_text(XML.replace("armature", 'actuatorfrcrange="-1.1 1.1" armature'))
    found, _ = solve_plant(Drives(tmp_path / "robot.xml", CONTRACT), log, CONTRACT)
    assert found == []


def test_another_rate_is_named(tmp_path: Path) -> None:
    log = read_deployment(recorded(tmp_path, rate=40.0), CONTRACT.joints)
    found, figures = solve_timing(log, CONTRACT)
    assert [f.fault for f in found] == ["rate"]
    assert figures["rate_hz"] == pytest.approx(40.0)


def files(folder: Path) -> list[str]:
    contract = Contract(50.0, ("a", "b", "c", "d"), 0.0, 0.1, (Term("joint_pos"), Term("joint_vel")), 8.0, 0.3)
    (folder / "policy.onnx").write_bytes(network(np.random.default_rng(0), 8))
    (folder / "contract.toml").write_text(contract_toml(contract))
    chain = "".join(f'<body pos="0 0 -0.1"><joint name="{j}" axis="0 1 0" damping="0.05"/>'
                    '<geom size="0.02" mass="0.1" contype="0" conaffinity="0"/>' for j in contract.joints)  # fmt: skip
    (folder / "robot.xml").write_text(f"<mujoco><worldbody>{chain}{'</body>' * 4}</worldbody></mujoco>")
    return ["--policy", str(folder / "policy.onnx"), "--contract", str(folder / "contract.toml"),
            "--mjcf", str(folder / "robot.xml"), "--out", str(folder / "out")]  # fmt: skip


def test_a_diagnosis_is_a_page_a_sentence_and_an_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plant, "_WINDOWS", 2)  # no plant explains what is made up
    time, rng = np.arange(200) / 50, np.random.default_rng(0)
    q = 0.1 * np.sin(time[:, None] * [2, 3, 4, 5])
    np.savez(tmp_path / "log.npz", t=time, q=q, action=rng.normal(size=(200, 4)), target=q)
    assert cli.main(["doctor", *files(tmp_path), "--log", str(tmp_path / "log.npz"), "--json"]) == 1
    data = json.loads(capsys.readouterr().out)
    assert "other network" in data["faults"]
    assert set(data["figures"]) == {"contract", "timing", "plant"}
    assert data["sentence"].rstrip(".") in (tmp_path / "out" / "doctor.html").read_text().replace("&#39;", "'")


def test_before_the_robot_moves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = cli.main(["doctor", *files(tmp_path), "--json"])
    data = json.loads(capsys.readouterr().out)
    assert data["stays_up"]
    assert code == (0 if data["sound"] else 1)
    assert set(data["delays"]) == {"0 ms", "5 ms", "10 ms", "20 ms", "30 ms", "40 ms"}


def test_the_joints_of_drives_come_in_their_order(tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(XML)
    assert driven_joints(path) == ["a", "b"]
    path.write_text(XML.replace("</mujoco>", '<actuator><motor joint="b"/><motor joint="a"/></actuator></mujoco>'))
    assert driven_joints(path) == ["b", "a"]
