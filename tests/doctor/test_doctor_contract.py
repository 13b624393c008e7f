"""The doctor's contract question, and what it reads of foreign policies."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from onnx import TensorProto, helper, numpy_helper

from sim2real import cli
from sim2real.doctor.contract import Contract, Policy, Term, contract_toml, read_policy
from sim2real.doctor.log import read_deployment
from sim2real.doctor.solve import mirror_of, solve_contract
from sim2real.errors import UsageError
from sim2real.graph.episode import StepRecord
from sim2real.log.writer import SessionFile
from sim2real.policy import load_bundle

JOINTS = ("FL_hip", "FL_calf", "FR_hip", "FR_calf")
DEFAULT = np.array([0.1, -0.4, -0.1, -0.5])
TERMS = (Term("base_ang_vel", scale=0.25), Term("projected_gravity"), Term("joint_pos", history=2),
         Term("joint_vel", scale=0.1), Term("last_action"), Term("command", size=2))  # fmt: skip
CONTRACT = Contract(50.0, JOINTS, tuple(DEFAULT.tolist()), 0.5, TERMS, 20.0, 0.5)


def network(
    rng: np.random.Generator, size: int = CONTRACT.size, metadata: dict[str, str] | None = None, joints: int = 4
) -> bytes:
    """Return a network of one hidden layer with random weights."""
    arrays = {"k0": rng.normal(size=(size, 32)) * 0.5, "b0": 0.3 * rng.normal(size=32),
              "k1": rng.normal(size=(32, joints)) * 0.3, "b1": np.zeros(joints)}  # fmt: skip
    nodes = [helper.make_node("Gemm", ["obs", "k0", "b0"], ["h"]), helper.make_node("Tanh", ["h"], ["x"]),
             helper.make_node("Gemm", ["x", "k1", "b1"], ["actions"])]  # fmt: skip
    shape = lambda name, n: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, n])  # noqa: E731
    inits = [numpy_helper.from_array(v.astype(np.float32), k) for k, v in arrays.items()]
    graph = helper.make_graph(nodes, "net", [shape("obs", size)], [shape("actions", joints)], inits)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    for key, value in (metadata or {}).items():
        model.metadata_props.add(key=key, value=value)
    return model.SerializeToString()


def turned(quat: np.ndarray, v: np.ndarray, inverse: bool) -> np.ndarray:
    """Rotate by Rodrigues' formula, independent of the doctor's matrices."""
    axis = quat[1:] * (-1 if inverse else 1)
    return v + 2 * np.cross(axis, np.cross(axis, v) + quat[0] * v)


def deployment(fault: str, folder: Path, logged: tuple[str, ...]) -> tuple[Policy, Path]:
    """Write the log of a loop on made-up measurements, with a fault in the loop."""
    rng = np.random.default_rng(3)
    policy = Policy(network(rng), CONTRACT)
    other = Policy(network(np.random.default_rng(3)), CONTRACT)
    n, time = 300, np.arange(300) / 50.0
    waves = lambda k, size: size * np.sin(time[:, None] * rng.uniform(1, 9, k) + rng.uniform(0, 6, k))  # noqa: E731
    q, dq, gyro, command = DEFAULT + waves(4, 0.4), waves(4, 2.0), waves(3, 1.5), waves(2, 1.0)
    tilt = waves(3, 0.4)
    quat = np.concatenate([np.ones((n, 1)), tilt], 1)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    order = {"left and right": [2, 3, 0, 1], "joint order": [0, 2, 1, 3]}.get(fault, [0, 1, 2, 3])
    rows: dict[str, list] = {"observation": [], "action": [], "target": []}
    last = np.zeros(4)
    for i in range(n):
        late = max(0, i - 1) if fault == "delay" else i
        frozen = min(i, 90) if fault == "frozen imu" else late
        ang, down = gyro[frozen], turned(quat[frozen], np.array([0, 0, -1.0]), True)
        if fault == "gyro rotated twice":
            ang = turned(quat[i], ang, True)
        if fault == "world frame":
            ang = turned(quat[i], ang, False)
        if fault == "quaternion order":
            down = turned(np.roll(quat[i], 1), np.array([0, 0, -1.0]), True)
        if fault == "axes":
            ang = ang[[1, 0, 2]] * [1, -1, 1]
        now, then = q[late][order] - DEFAULT, q[max(0, late - 1)][order] - DEFAULT
        if fault == "frozen joint":
            now, then = (np.where([0, 0, 1, 0], q[min(k, 100)] - DEFAULT, q[k] - DEFAULT) for k in (i, max(0, i - 1)))
        if fault == "sign":
            now, then = now * [1, -1, 1, 1], then * [1, -1, 1, 1]
        if fault == "default pose":
            now, then = now - [0, 0.2, 0, 0], then - [0, 0.2, 0, 0]
        velocity = dq[late][order] * (10.0 if fault == "scale" else 1.0) * ([1, -1, 1, 1] if fault == "sign" else 1)
        if fault == "frozen joint":
            velocity = np.where([0, 0, 1, 0], dq[min(i, 100)], velocity)
        pair = (now, then) if fault == "history reversed" else (now, now) if fault == "history order" else (then, now)
        previous = {"missing term": 0.0 * last, "last action": DEFAULT + 0.5 * last}.get(fault, last)
        terms = [0.25 * ang, down, *pair, 0.1 * velocity, previous, command[i]]
        if fault == "term order":
            terms[0], terms[1] = terms[1], terms[0]
        obs = np.concatenate(terms)
        spoilt = obs * np.linspace(0.6, 1.6, len(obs)) + 0.1 if fault == "normaliser" else obs
        last = np.clip(other(spoilt[None])[0], *((-0.5, 0.5) if fault == "action clipped" else (-9, 9)))
        for name, value in (("observation", obs), ("action", last), ("target", DEFAULT + 0.5 * last)):
            rows[name].append(value)
    log = {"t": time, "q": q, "dq": dq, "gyro": gyro, "quat": quat, "command": command}
    np.savez(folder / "log.npz", **log, **{k: np.array(rows[k]) for k in logged})
    return policy, folder / "log.npz"


@pytest.mark.parametrize("logged", [("observation", "action", "target"), ("target",)], ids=["all", "targets"])
@pytest.mark.parametrize(
    "fault",
    ["joint order", "left and right", "sign", "gyro rotated twice", "world frame", "frozen imu", "default pose",
     "scale", "history reversed", "normaliser", "delay", "quaternion order", "axes", "frozen joint", "history order",
     "missing term", "last action", "term order", "action clipped", ""],
)  # fmt: skip
def test_the_fault_of_a_deployment_is_named(fault: str, logged: tuple[str, ...], tmp_path: Path) -> None:
    policy, path = deployment(fault, tmp_path, logged)
    found, _ = solve_contract(read_deployment(path, JOINTS), policy)
    assert {f.fault for f in found} == ({fault} if fault else set())
    assert all(0.0 <= f.share <= 1.0 for f in found)
    if fault == "delay":
        assert found[0].numbers["late_s"] == pytest.approx(0.02, abs=1e-3)


def test_commands_of_this_projects_logs_are_no_measurements(tmp_path: Path) -> None:
    """The Go2's actuator has a field q, as its motors have."""
    four = np.zeros(4)
    sensor, agent = {"position": four, "velocity": four}, {"q": four, "aim": np.zeros(2)}
    outputs = {"sensor": sensor, "agent": agent, "actuator": {"q": four, "tau": four}}
    log = SessionFile(tmp_path / "real.mcap", {"pipeline": "go2"}, {}, outputs, [], {})
    log.start(0, 0)
    for i in range(50):
        for k, (node, leaves) in enumerate(outputs.items()):
            at = 20_000 * i + 2_000 * k
            log.step(StepRecord(node, i, at, at, at, -1, at + 1000, 0), [v + k + 0.01 * i for v in leaves.values()])
    log.finish({})
    read = read_deployment(tmp_path / "real.mcap", JOINTS)
    assert read.q[10].tolist() == pytest.approx([0.1] * 4)
    assert read.target is not None
    assert read.target[10].tolist() == pytest.approx([2.1] * 4)
    assert read.command is not None
    assert read.command.shape == (50, 2)
    assert read.action is None
    assert read.t[1] - read.t[0] == pytest.approx(0.02)


def test_a_log_without_actions_and_targets_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "log.npz", t=np.arange(50) / 50, q=np.zeros((50, 4)))
    with pytest.raises(UsageError, match="targets"):
        read_deployment(tmp_path / "log.npz", JOINTS)


@pytest.mark.parametrize("signal", ["obs", "command", "gyro"])
def test_rows_without_times_that_fit_nothing_are_refused(signal: str, tmp_path: Path) -> None:
    """One row holds for all; another number of rows says nothing about when they were."""
    log = {"t": np.arange(50) / 50, "q": np.zeros((50, 4)), "target": np.zeros((50, 4))}
    np.savez(tmp_path / "log.npz", **log, **{signal: np.ones((1, 3))})
    held = getattr(read_deployment(tmp_path / "log.npz", JOINTS), signal)
    assert held.shape == (50, 3)
    np.savez(tmp_path / "log.npz", **log, **{signal: np.ones((40, 3))})
    with pytest.raises(UsageError, match=f"{signal} has 40 rows"):
        read_deployment(tmp_path / "log.npz", JOINTS)


def test_mirrored_joints() -> None:
    assert mirror_of(("left_knee_joint", "right_knee_joint", "waist")) == (1, 0, 2)
    assert mirror_of(("shoulder", "elbow")) is None


# -- descriptions

METADATA = {
    "joint_names": ",".join(JOINTS), "default_joint_pos": "0.100,-0.400,-0.100,-0.500", "action_scale": "0.500",
    "observation_names": "base_ang_vel,projected_gravity,joint_pos,joint_vel,actions,command",
    "observation_terms_history_length": "1.000,1.000,2.000,1.000,1.000,1.000",
    "observation_dims": "3.0,3.0,4.0,4.0,4.0,2.0",
    "joint_stiffness": "20.000,30.000,20.000,30.000", "joint_damping": "0.500,0.500,0.500,0.500",
}  # fmt: skip


def written(folder: Path, metadata: dict[str, str]) -> Path:
    path = folder / "policy.onnx"
    path.write_bytes(network(np.random.default_rng(0), metadata=metadata))
    return path


def test_metadata_of_mjlab_lack_the_rate_alone(tmp_path: Path) -> None:
    policy = written(tmp_path, METADATA)
    assert cli.main(["doctor", "--policy", str(policy), "--log", "x.csv", "--out", str(tmp_path)]) == 2
    text = (tmp_path / "contract.toml").read_text()
    assert [line for line in text.splitlines() if line.startswith("#")] == [
        "# rate_hz = how many steps does the policy make in a second [Hz]?"
    ]
    with pytest.raises(UsageError, match="rate_hz"):
        read_policy(policy, tmp_path / "contract.toml")
    (tmp_path / "contract.toml").write_text(text.replace(text.splitlines()[0], "rate_hz = 50"))
    contract = read_policy(policy, tmp_path / "contract.toml").contract
    assert contract.per_joint("kp").tolist() == [20, 30, 20, 30]
    assert contract.layout[2:4] == [(2, 1), (2, 0)]


def test_each_joint_has_one_pattern() -> None:
    contract = Contract(50.0, ("fl_hip", "fr_hip"), 0.0, 0.5, (Term("joint_pos"),))
    for patterns, said in (({"fl.*": 1.0}, "no .*fr_hip"), ({".*": 1.0, "fl.*": 2.0}, "2 .*fl_hip")):
        with pytest.raises(UsageError, match=said):
            msgspec.structs.replace(contract, kp=patterns).per_joint("kp")


def test_metadata_have_any_form_of_a_number(tmp_path: Path) -> None:
    forms = METADATA | {"joint_stiffness": "2e+01, 3.0E1, +40, 50.", "action_scale": "[.25]", "step_dt": "0.02"}
    contract = read_policy(written(tmp_path, forms), out=tmp_path).contract
    assert contract.per_joint("kp").tolist() == [20, 30, 40, 50]
    assert contract.per_joint("action_scale").tolist() == [0.25] * 4
    with pytest.raises(UsageError, match="action_scale"):
        read_policy(written(tmp_path, forms | {"action_scale": "a quarter"}), out=tmp_path)


@pytest.mark.parametrize("value", ["1.000", "0.000", "-0.000"])
def test_placeholders_are_no_gains(value: str, tmp_path: Path) -> None:
    policy = written(tmp_path, METADATA | {"joint_stiffness": ",".join([value] * 4), "step_dt": "0.02"})
    with pytest.raises(UsageError, match="placeholder"):
        read_policy(policy, out=tmp_path)
    assert "# kp = " in (tmp_path / "contract.toml").read_text()
    small = written(tmp_path, METADATA | {"joint_stiffness": "1.500", "step_dt": "0.02"})
    assert read_policy(small, out=tmp_path).contract.per_joint("kp").tolist() == [1.5] * 4


LAB = """
joint_ids_map: [3, 0, 2, 1]
step_dt: 0.02
stiffness: [10.0, 20.0, 30.0, 40.0]
damping: [1.0, 2.0, 3.0, 4.0]
default_joint_pos: [0.1, 0.2, 0.3, 0.4]
actions:
  JointPositionAction: {clip: null, joint_names: [.*], scale: [0.25, 0.25, 0.25, 0.25], offset: [0.1, 0.2, 0.3, 0.4]}
observations:
  base_ang_vel: {params: {}, clip: null, scale: [0.2, 0.2, 0.2], history_length: 1}
  projected_gravity: {scale: [1.0, 1.0, 1.0], history_length: 1}
  joint_pos_rel: {scale: [1.0, 1.0, 1.0, 1.0], history_length: 2}
  joint_vel_rel: {scale: [0.05, 0.05, 0.05, 0.05], history_length: 1}
  last_action: {scale: [1.0, 1.0, 1.0, 1.0], history_length: 1}
  velocity_commands: {scale: [1.0, 1.0], history_length: 1}
"""
GYM = """
control_dt: 0.02
leg_joint2motor_idx: [3, 0, 2, 1]
kps: [10, 20, 30, 40]
kds: [1, 1, 1, 1]
default_angles: [0.1, 0.2, 0.3, 0.4]
ang_vel_scale: 0.25
dof_pos_scale: 1.0
dof_vel_scale: 0.05
action_scale: 0.25
cmd_scale: [2.0, 2.0, 0.25]
num_actions: 4
num_obs: 21
"""
ISAAC = """
decimation: 4
sim: {dt: 0.005, render: !!python/object/apply:builtins.slice [null, 1]}
scene:
  robot:
    init_state: {joint_pos: {.*_hip: 0.1, .*_calf: -0.5}}
    actuators: {legs: {joint_names_expr: [.*], stiffness: 25.0, damping: 0.5}}
observations:
  policy:
    history_length: null
    base_ang_vel: {func: a:b, scale: 0.2, history_length: 0}
    projected_gravity: {func: a:b, scale: null}
    joint_pos_rel: {func: a:b, scale: null, history_length: 2}
    joint_vel_rel: {func: a:b, scale: 0.05}
    last_action: {func: a:b}
actions: {joint_pos: {scale: 0.25, offset: !!python/tuple [0, 1]}}
"""


@pytest.mark.parametrize(("text", "size"), [(LAB, CONTRACT.size), (GYM, 21)], ids=["unitree_rl_lab", "unitree_rl_gym"])
def test_a_unitree_deployment(text: str, size: int, tmp_path: Path) -> None:
    (tmp_path / "policy.onnx").write_bytes(network(np.random.default_rng(0), size))
    (tmp_path / "deploy.yaml").write_text(text)
    contract = read_policy(tmp_path / "policy.onnx", tmp_path / "deploy.yaml", JOINTS).contract
    assert contract.joints == ("FR_calf", "FL_hip", "FR_hip", "FL_calf")
    assert contract.rate_hz == 50
    # unitree_rl_lab has gains in the order of the motors, unitree_rl_gym in that of the network.
    assert contract.per_joint("kp").tolist() == ([40, 10, 30, 20] if text is LAB else [10, 20, 30, 40])


def test_an_env_of_isaac_lab_asks_for_the_order_of_the_joints(tmp_path: Path) -> None:
    (tmp_path / "policy.onnx").write_bytes(network(np.random.default_rng(0), 22))
    (tmp_path / "env.yaml").write_text(ISAAC)
    with pytest.raises(UsageError, match="1 open question"):
        read_policy(tmp_path / "policy.onnx", tmp_path / "env.yaml", JOINTS, tmp_path)
    path = tmp_path / "contract.toml"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([f"joints = {json.dumps(JOINTS)}", *lines[1:]]))
    contract = read_policy(tmp_path / "policy.onnx", path).contract
    assert contract.per_joint("default_joint_pos").tolist() == [0.1, -0.5, 0.1, -0.5]
    assert contract.per_joint("kp").tolist() == [25] * 4
    assert contract.rate_hz == 50


def test_the_shipped_bundle_is_read_and_asks_for_the_pose(tmp_path: Path) -> None:
    bundle = Path(__file__).parents[2] / "pipelines/go2/walk"
    with pytest.raises(UsageError, match="default_joint_pos"):
        read_policy(bundle, out=tmp_path)


def test_a_foreign_policy_becomes_a_bundle(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    (tmp_path / "policy.onnx").write_bytes(network(rng))
    mean, std = rng.normal(size=CONTRACT.size), rng.uniform(0.5, 2, CONTRACT.size)
    normalised = msgspec.structs.replace(CONTRACT, mean=tuple(mean.tolist()), std=tuple(std.tolist()), clip=5.0)
    (tmp_path / "c.toml").write_text(contract_toml(normalised))
    flags = ["--policy", str(tmp_path / "policy.onnx"), "--contract", str(tmp_path / "c.toml")]
    assert cli.main(["doctor", *flags, "--bundle", str(tmp_path / "b"), "--out", str(tmp_path)]) == 0
    policy, x = read_policy(tmp_path / "policy.onnx", tmp_path / "c.toml"), rng.normal(size=(5, CONTRACT.size))
    runner = load_bundle(tmp_path / "b", "onnx")
    assert np.allclose([runner(row) for row in x], policy(x), atol=1e-5)
    again = read_policy(tmp_path / "b", tmp_path / "b" / "contract.toml")
    assert np.allclose(again(x), policy(x), atol=1e-5)


def test_no_onnx_and_wrong_sizes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "policy.onnx").write_text("no network")
    with pytest.raises(UsageError, match="ONNX"):
        read_policy(tmp_path / "policy.onnx")
    (tmp_path / "policy.onnx").write_bytes(network(np.random.default_rng(0), 11))
    (tmp_path / "c.toml").write_text(contract_toml(CONTRACT))
    with pytest.raises(UsageError, match="11 numbers"):
        read_policy(tmp_path / "policy.onnx", tmp_path / "c.toml")
