"""The doctor on logs of other recorders: a leg whose policy has its trainer's metadata, deployed with a fault."""

import json
from dataclasses import replace
from pathlib import Path

import made_bags as bags
import mujoco
import numpy as np
import pytest
from test_doctor_contract import network

from sim2real import cli
from sim2real.doctor import plant
from sim2real.doctor.contract import Contract, Policy, Term, read_policy
from sim2real.doctor.diagnosis import diagnose
from sim2real.doctor.log import Log, read_deployment
from sim2real.doctor.plant import Drives
from sim2real.errors import UsageError

JOINTS = ("hip_abd", "hip_flex", "knee", "ankle")
DEFAULT = np.array([0.0, 0.4, -0.9, 0.3])
XML = """<mujoco><compiler angle="radian"/><default><geom type="capsule" size=".02" contype="0" conaffinity="0"/>
<joint axis="0 1 0" damping="0.05" frictionloss="0.02" armature="0.01"/></default><worldbody><body pos="0 0 1">
<joint name="hip_abd" axis="1 0 0"/><geom fromto="0 0 0 0 .08 0" mass=".5"/><body pos="0 .08 0">
<joint name="hip_flex"/><geom fromto="0 0 0 0 0 -.2" mass=".9"/><body pos="0 0 -.2">
<joint name="knee"/><geom fromto="0 0 0 0 0 -.2" mass=".3"/><body pos="0 0 -.2">
<joint name="ankle"/><geom fromto="0 0 0 .1 0 0" mass=".2"/></body></body></body></body></worldbody></mujoco>"""
METADATA = {
    "joint_names": ",".join(JOINTS), "default_joint_pos": "0.000,0.400,-0.900,0.300", "action_scale": "0.300",
    "observation_names": "joint_pos,joint_vel,actions,command", "observation_dims": "4.0,4.0,4.0,2.0",
    "observation_terms_history_length": "2.0,1.0,1.0,1.0", "observation_terms_scale": "1.0,0.1,1.0,1.0",
    "joint_stiffness": "40.000", "joint_damping": "1.200", "step_dt": "0.02", "delay_s": "0.008",
}  # fmt: skip


def deployed(folder: Path, fault: str) -> dict[str, np.ndarray]:
    """Run the policy on the leg; return a row for each 5 ms, with the newest values of the policy's loop."""
    (folder / "policy.onnx").write_bytes(network(np.random.default_rng(0), 18, METADATA))
    (folder / "robot.xml").write_text(XML)
    policy = read_policy(folder / "policy.onnx", out=folder)
    model, rng = mujoco.MjModel.from_xml_string(XML), np.random.default_rng(1)
    model.opt.timestep, model.body_mass[:] = 0.001, 1.03 * model.body_mass
    data = mujoco.MjData(model)
    data.qpos[:] = DEFAULT
    kp, order = (20.0 if fault == "gain" else 40.0), [0, 2, 1, 3] if fault == "joint order" else [0, 1, 2, 3]
    past, last, waiting, goal = DEFAULT - DEFAULT, np.zeros(4), [], DEFAULT
    rows: dict[str, list] = {}
    seen: dict[str, np.ndarray] = {}
    for tick in range(4000):
        now = 0.001 * tick
        q, dq = data.qpos + 3e-4 * rng.normal(size=4), data.qvel + 0.01 * rng.normal(size=4)
        if tick % 20 == 0:
            command = np.sin([2.1 * now, 3.3 * now + 1])
            angle = q[order] - DEFAULT
            pair = [angle, past] if fault == "history reversed" else [past, angle]
            obs = np.concatenate([*pair, 0.1 * dq[order], last, command]).astype(np.float32)
            past, last = angle, policy(obs[None])[0]
            target = (DEFAULT + 0.3 * last)[np.argsort(order)]
            waiting.append((now + 0.008, target))
            seen = {"observation": obs, "action": last, "target": target, "command": command}
        while waiting and waiting[0][0] <= now:
            goal = waiting.pop(0)[1]
        if tick % 5 == 0:
            for name, value in {"t": np.array(now), "q": q, "dq": dq, **seen}.items():
                rows.setdefault(name, []).append(value)
        data.qfrc_applied[:] = kp * (goal - data.qpos) - 1.2 * data.qvel
        mujoco.mj_step(model, data)
    return {name: np.array(values) for name, values in rows.items()}


def as_csv(folder: Path, rows: dict[str, np.ndarray]) -> Path:
    """Write a recorder's file at its own 200 Hz: milliseconds and degrees, without the network's signals."""
    columns = {"time_ms": 1e3 * rows["t"]}
    for j in (2, 0, 3, 1):
        for name, suffix in (("q", "pos_deg"), ("dq", "vel_deg_s"), ("target", "cmd_deg")):
            columns[f"{JOINTS[j]}_{suffix}"] = np.degrees(rows[name][:, j])
    columns |= {f"command_{i}": rows["command"][:, i] for i in range(2)}
    lines = [",".join(columns), *(",".join(f"{v:.8g}" for v in row) for row in zip(*columns.values(), strict=True))]
    (folder / "log.csv").write_text("\n".join(lines) + "\n")
    return folder / "log.csv"


def as_bag(folder: Path, rows: dict[str, np.ndarray]) -> Path:
    """Write a bag: joint states at 200 Hz in the vendor's order, the policy's topics at its rate."""
    steps = np.flatnonzero(np.append(True, (np.diff(rows["action"], axis=0) != 0.0).any(1)))
    made = []

    def add(t: float, topic: str, message: dict, kind: str = bags.NUMBERS) -> None:
        made.append((topic, kind, message, round(1e9 * t)))

    for k, now in enumerate(1.7e9 + rows["t"]):
        stamp = round(1e9 * now)
        state = bags.state(rows["q"][k, ::-1], stamp, JOINTS[::-1])
        add(now, "/joint_states", state | {"velocity": rows["dq"][k, ::-1].tolist()}, bags.STATE)
        if k in steps:
            for late, name in ((1e-3, "observation"), (2e-3, "action"), (0.0, "command")):
                layout = {"dim": [], "data_offset": 0}
                add(now + late, f"/policy/{name}", {"layout": layout, "data": rows[name][k].tolist()})
            add(now + 3e-3, "/joint_commands", bags.state(rows["target"][k], stamp, JOINTS), bags.STATE)
    return bags.write(folder / "log.mcap", made)


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replay a quarter of the windows."""
    monkeypatch.setattr(plant, "_WINDOWS", 10)


@pytest.mark.parametrize(
    ("write", "fault"),
    [(as_csv, ""), (as_csv, "gain"), (as_bag, ""), (as_bag, "joint order"), (as_bag, "history reversed")],
)
def test_the_fault_is_named_in_a_foreign_log(
    write: object, fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path, deployed(tmp_path, fault))  # type: ignore[operator]
    flags = ["--policy", str(tmp_path / "policy.onnx"), "--mjcf", str(tmp_path / "robot.xml"), "--log", str(log)]
    code = cli.main(["doctor", *flags, "--out", str(tmp_path), "--json"])
    data = json.loads(capsys.readouterr().out)
    assert data["faults"] == ([fault] if fault else [])
    assert code == bool(fault)


def test_names_that_fit_no_joint_are_refused(tmp_path: Path) -> None:
    time = np.arange(200) / 50
    np.savez(tmp_path / "log.npz", **{"t": time, "q.slide": time, "q.pole": time, "target.slide": time})
    with pytest.raises(UsageError, match="slide, pole; the contract's joints: hip_abd, hip_flex, knee, ankle"):
        read_deployment(tmp_path / "log.npz", JOINTS)


def test_terms_of_other_sizes_and_joints_without_an_action_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Such as of a cart with a pole: the policy moves one joint, and sees two."""
    monkeypatch.setattr(plant, "_WINDOWS", 2)  # no plant explains what is made up
    contract = Contract(50.0, JOINTS, 0.0, 0.3, (Term("joint_pos", size=5),), 40.0, 1.2)
    toe = '<body><joint name="toe"/><joint axis="1 0 0"/><geom fromto="0 0 0 0 0 .1" mass=".1"/></body>'
    (tmp_path / "robot.xml").write_text(XML.replace("</body>", f"{toe}</body>", 1))
    time, rng = np.arange(200) / 50, np.random.default_rng(0)
    q = 0.1 * np.sin(time[:, None] * [2, 3, 4, 5])
    log = Log(time, time, q, np.gradient(q, time, axis=0), obs=rng.normal(size=(200, 5)), target=q)
    policy = Policy(network(rng, 5), contract)
    found = diagnose(policy, log, Drives(tmp_path / "robot.xml", contract))
    assert [what for what in found.skipped if "joint_pos" in what]
    assert [what for what in found.skipped if "toe" in what]
    assert diagnose(policy, replace(log, obs=None)).skipped["contract"]
