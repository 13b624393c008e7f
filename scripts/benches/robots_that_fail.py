"""Robots drawn at random, each with a policy that works, deployed with faults: logs for the doctor.

The simulator differs from the model that the doctor gets, as a robot does: masses, friction, armature and gains are
others, motors lag, encoders and IMU have noise and steps, and messages have delays that jitter.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from sim2real.doctor.contract import Contract, Policy, Term, contract_toml

ROOT = Path(__file__).resolve().parents[2]
STEP_S = 0.002
FAULTS = (
    "joint order", "sign", "gyro rotated twice", "world frame", "scale", "history reversed", "rate", "delay", "gain",
    "torque limit", "frozen imu", "default pose", "normaliser", "left and right",
)  # fmt: skip
"""The names of the faults, as the doctor gives them."""
KINDS = ("pendulum", "arm", "so101", "go2")
_ONLY_LEGS = {"gyro rotated twice", "world frame", "frozen imu", "left and right"}
_MIRRORED = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]


def kinds_for(faults: tuple[str, ...]) -> list[str]:
    """Return the kinds of robots that can have all these faults."""
    if _ONLY_LEGS & set(faults):
        return ["go2"]
    return [k for k in KINDS if k != "pendulum" or "joint order" not in faults]


@dataclass
class Robot:
    """A model, a policy with its contract, and what the robot itself is like."""

    kind: str
    xml: str
    network: bytes
    contract: Contract
    swing: float
    rng: np.random.Generator
    limit: np.ndarray = field(default_factory=lambda: np.zeros(0))
    imu: bool = False
    spoilt_network: Callable[[np.random.Generator], bytes] | None = None


# -- models and policies


_PENDULUM = """<mujoco model="pendulum"><option timestep="0.002"/><worldbody><body name="rod" pos="0 0 1">
<joint name="hinge" axis="0 1 0" actuatorfrcrange="-4 4" damping="{d}" frictionloss="{f}" armature="{a}"/>
<geom type="capsule" size="0.01" fromto="0 0 0 0 0 -{l}" mass="{m}" contype="0" conaffinity="0"/></body></worldbody>
</mujoco>"""


def draw(kind: str, seed: int) -> Robot:
    """Return a robot of a kind with a policy that works on it."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    if kind == "go2":
        return _go2(rng)
    if kind == "pendulum":
        mass, length = rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.35)
        xml = _PENDULUM.format(m=mass, l=length, d=0.01, f=0.01, a=0.003)
        joints, kp, kd, limit = ("hinge",), rng.uniform(6, 12), 0.3, 4.0
        return _reacher(kind, xml, joints, kp, kd, limit, 0.7, rng)
    spec = mujoco.MjSpec.from_file(str(ROOT / f"pipelines/{kind}/{kind}.xml"))
    spec.option.timestep = STEP_S
    small = kind == "arm"
    for joint in spec.joints:
        damping, joint.frictionloss, joint.armature = (0.02, 0.01, 0.004) if small else (0.3, 0.05, 0.02)
        joint.damping = [damping, 0.0, 0.0]
    kp, kd, limit = (rng.uniform(4, 8), 0.12, 1.5) if small else (rng.uniform(12, 25), 0.5, 3.5)
    for joint in spec.joints:
        joint.actfrclimited, joint.actfrcrange = True, [-limit, limit]
    joints = tuple(j.name for j in spec.joints)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    return _reacher(kind, spec.to_xml(), joints, kp, kd, limit, 0.45, rng)


def _reacher(
    kind: str, xml: str, joints: tuple[str, ...], kp: float, kd: float, limit: float, swing: float,
    rng: np.random.Generator,
) -> Robot:  # fmt: skip
    """Return a robot whose policy follows commanded angles, by a random network that was fitted to a controller."""
    count, history = len(joints), int(rng.integers(2, 5))
    model = mujoco.MjModel.from_xml_string(xml)
    middle = model.jnt_range.mean(1) * model.jnt_limited
    default = 0.3 * rng.uniform(-1, 1, count) + 0.3 * middle
    scale = float(rng.choice([0.25, 0.5]))
    terms = (
        Term("joint_pos", history=history, scale=1.0),
        Term("joint_vel", scale=float(rng.choice([0.05, 0.1, 1.0])), history=history),
        Term("last_action"),
        Term("command", size=count),
    )
    contract = Contract(
        50.0, joints, tuple(map(float, default)), scale, terms, float(kp), kd, delay_s=0.012,
        history_order=str(rng.choice(["oldest first", "newest first"])),  # type: ignore[arg-type]
        history_layout=str(rng.choice(["term", "step"])),  # type: ignore[arg-type]
    )  # fmt: skip
    samples = _samples(contract, swing, rng)
    lagged = [i for i, (term, lag) in enumerate(contract.layout) if contract.observation[term].kind == "joint_pos"]
    block = lambda k, lag: samples[:, contract.block(k, lag)]  # noqa: E731
    q, old, dq = block(0, 0), block(0, len(lagged) - 1), block(1, 0) / contract.observation[1].scale
    last, command = block(2, 0), block(3, 0)
    mixing = np.eye(count) + 0.05 * rng.normal(size=(count, count))
    error = command - q
    action = (command + 0.35 * error @ mixing - 0.02 * dq - 0.3 * (q - old)) / scale + 0.1 * last
    action += 0.1 * np.tanh(3 * error) + 0.05 * np.sin(4 * q)
    mean, std = samples.mean(0) + 0.1 * rng.normal(size=samples.shape[1]), samples.std(0) * rng.uniform(0.7, 1.4)
    net = _fitted((samples - mean) / std, action, rng)
    outside = bool(rng.random() < 0.5)
    if outside:
        contract = replace_contract(contract, mean=tuple(mean.tolist()), std=tuple(std.tolist()))

    def spoilt(other: np.random.Generator) -> bytes:
        return _onnx(mean + 0.4 * std * other.normal(size=len(std)), std * other.uniform(0.5, 1.8, len(std)), *net)

    network = _onnx(np.zeros_like(mean), np.ones_like(std), *net) if outside else _onnx(mean, std, *net)
    return Robot(kind, xml, network, contract, swing, rng, np.full(count, limit), False, spoilt)


def replace_contract(contract: Contract, **changes: Any) -> Contract:
    """Return a contract with other settings."""
    import msgspec

    return msgspec.structs.replace(contract, **changes)


def _samples(contract: Contract, swing: float, rng: np.random.Generator) -> np.ndarray:
    """Return observations of smooth random motions ``(N, O)``."""
    n, count = 6000, len(contract.joints)
    command = swing * rng.uniform(-1.2, 1.2, (n, count))
    q, dq = command + 0.3 * rng.normal(size=(n, count)), 2.0 * rng.normal(size=(n, count))
    parts = []
    for term, lag in contract.layout:
        kind = contract.observation[term].kind
        value = {"joint_pos": q - 0.02 * lag * dq + 0.01 * rng.normal(size=q.shape),
                 "joint_vel": dq + 0.3 * lag * rng.normal(size=q.shape),
                 "last_action": command / contract.action_scale + 0.5 * rng.normal(size=q.shape),
                 "command": command}[kind]  # fmt: skip
        parts.append(value * contract.observation[term].scale)
    return np.concatenate(parts, axis=1)


def _fitted(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Return a layer of random tanh units and a linear one that gives ``y``."""
    width = 256
    kernel = rng.normal(size=(x.shape[1], width)) * 0.35 / np.sqrt(x.shape[1])
    bias = 0.5 * rng.normal(size=width)
    hidden = np.concatenate([np.tanh(x @ kernel + bias), np.ones((len(x), 1))], 1)
    out = np.linalg.solve(hidden.T @ hidden + 1e-3 * np.eye(width + 1), hidden.T @ y)
    return kernel, bias, out[:-1], out[-1]


def _onnx(mean: np.ndarray, std: np.ndarray, *layers: np.ndarray) -> bytes:
    from onnx import TensorProto, helper, numpy_helper

    arrays = dict(zip(("mean", "std", "k0", "b0", "k1", "b1"), (mean, std, *layers), strict=True))
    nodes = [
        helper.make_node("Sub", ["obs", "mean"], ["c"]), helper.make_node("Div", ["c", "std"], ["x"]),
        helper.make_node("Gemm", ["x", "k0", "b0"], ["h"]), helper.make_node("Tanh", ["h"], ["y"]),
        helper.make_node("Gemm", ["y", "k1", "b1"], ["actions"]),
    ]  # fmt: skip
    shape = lambda name, size: helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, size])  # noqa: E731
    inits = [numpy_helper.from_array(np.asarray(v, np.float32), k) for k, v in arrays.items()]
    graph = helper.make_graph(nodes, "policy", [shape("obs", len(mean))], [shape("actions", layers[-1].size)], inits)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    return model.SerializeToString()


def _go2(rng: np.random.Generator) -> Robot:
    """Return a Go2 with the policy that its pipeline ships."""
    spec = mujoco.MjSpec.from_file(str(ROOT / "pipelines/go2/go2.xml"))
    spec.option.timestep = STEP_S
    joints = tuple(a.target for a in spec.actuators)
    stance = (-0.1, 0.8, -1.5, 0.1, 0.8, -1.5, -0.1, 1.0, -1.5, 0.1, 1.0, -1.5)
    terms = tuple(
        Term(name, history=h)
        for name, h in (("gyro", 3), ("gravity", 3), ("joint_pos", 3), ("joint_vel", 3), ("last_action", 3),
                        ("command", 1))
    )  # fmt: skip
    contract = Contract(
        50.0, joints, stance, 0.6, terms, 35.0, 0.6, delay_s=0.0169, history_order="newest first", history_layout="step"
    )
    network = (ROOT / "pipelines/go2/walk/policy.onnx").read_bytes()

    def spoilt(other: np.random.Generator) -> bytes:
        """Return the policy with the normaliser of another training."""
        import onnx
        from onnx import numpy_helper

        model = onnx.load_from_string(network)
        for tensor in model.graph.initializer:
            if tensor.name in ("mean", "std"):
                value = numpy_helper.to_array(tensor)
                if tensor.name == "std":
                    value = value * other.uniform(0.6, 1.7, value.shape)
                else:
                    value = value + 0.15 * other.normal(size=value.shape)
                tensor.CopyFrom(numpy_helper.from_array(value.astype(np.float32), tensor.name))
        return model.SerializeToString()

    limit = np.array([23.7, 23.7, 45.4] * 4)
    return Robot("go2", spec.to_xml(), network, contract, 0.0, rng, limit, True, spoilt)


# -- deployments


@dataclass
class Wrong:
    """What is wrong with a deployment; the defaults are sound."""

    order: np.ndarray | None = None
    order_of: str = "both"
    signs: np.ndarray | None = None
    signs_of: str = "both"
    imu: str = ""
    frozen: str = ""
    scaled: tuple[str, float] = ("", 1.0)
    reversed_history: bool = False
    rate: float = 1.0
    delay_s: float = 0.0
    late: str = ""
    kp: float = 1.0
    limit: float = 1.0
    offset: np.ndarray | None = None
    offset_of: str = "both"
    normaliser: bool = False


def draw_faults(robot: Robot, faults: tuple[str, ...], rng: np.random.Generator) -> Wrong:
    """Return a random deployment with these faults."""
    wrong, count = Wrong(), len(robot.contract.joints)
    for fault in faults:
        if fault == "joint order":
            wrong.order_of = str(rng.choice(["both", "observation", "action"]))
            if robot.kind == "go2" and rng.random() < 0.7:  # by type, as Isaac Lab has them, or alphabetical
                wrong.order = np.array([[0, 3, 6, 9, 1, 4, 7, 10, 2, 5, 8, 11],
                                        [5, 3, 4, 2, 0, 1, 11, 9, 10, 8, 6, 7],
                                        [0, 1, 2, 3, 4, 5, 9, 10, 11, 6, 7, 8]][rng.integers(3)])  # fmt: skip
            else:
                wrong.order = np.arange(count)
                first, second = rng.choice(count, 2, replace=False)
                wrong.order[[first, second]] = second, first
        elif fault == "left and right":
            wrong.order, wrong.order_of = np.array(_MIRRORED), str(rng.choice(["both", "observation", "action"]))
        elif fault == "sign":
            wrong.signs, wrong.signs_of = np.ones(count), str(rng.choice(["both", "observation", "action"]))
            wrong.signs[rng.integers(count)] = -1.0
        elif fault in ("gyro rotated twice", "world frame"):
            wrong.imu = "twice" if fault == "gyro rotated twice" else str(rng.choice(["gyro", "gravity"], p=[0.7, 0.3]))
        elif fault == "frozen imu":
            wrong.frozen = str(rng.choice(["sensor", "observation"]))
        elif fault == "scale":
            kinds = [t.kind for t in robot.contract.observation if t.kind in ("joint_pos", "joint_vel", "ang_vel")]
            wrong.scaled = str(rng.choice([*kinds, "action"])), float(rng.choice([0.25, 0.5, 2.0]))
        elif fault == "history reversed":
            wrong.reversed_history = True
        elif fault == "rate":
            wrong.rate = float(rng.choice([0.6, 0.8, 1.25, 2.0]))
        elif fault == "delay":
            wrong.delay_s, wrong.late = 0.02, str(rng.choice(["sensing", "acting", "loop"]))
        elif fault == "gain":
            wrong.kp = 0.5
        elif fault == "torque limit":
            wrong.limit = float(rng.uniform(0.4, 0.6))
        elif fault == "default pose":
            wrong.offset, wrong.offset_of = np.zeros(count), str(rng.choice(["both", "observation", "action"]))
            some = rng.choice(count, int(rng.integers(1, min(3, count) + 1)), replace=False)
            wrong.offset[some] = rng.uniform(0.1, 0.3, len(some)) * rng.choice([-1, 1], len(some))
        elif fault == "normaliser":
            wrong.normaliser = True
    return wrong


def deploy(robot: Robot, wrong: Wrong, seconds: float, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Run the policy on the robot as it is, and return all signals of the deployment, a row for each step."""
    c = robot.contract
    model = _disturbed(mujoco.MjModel.from_xml_string(robot.xml), rng)
    data = mujoco.MjData(model)
    addresses = [int(model.jnt_qposadr[model.joint(j).id]) for j in c.joints]
    dofs = [int(model.jnt_dofadr[model.joint(j).id]) for j in c.joints]
    default, scale = c.per_joint("default_joint_pos"), c.per_joint("action_scale")
    data.qpos[addresses] = default
    if robot.imu:
        data.qpos[:3] = 0, 0, 0.33
    mujoco.mj_forward(model, data)
    kp = c.per_joint("kp") * wrong.kp * rng.uniform(0.94, 1.06, len(dofs))
    kd = c.per_joint("kd") * rng.uniform(0.9, 1.1, len(dofs))
    lag_s, tau = rng.uniform(0.001, 0.003), np.zeros(len(dofs))
    limit = _needed(robot, seconds) * wrong.limit if wrong.limit < 1.0 else robot.limit
    policy = Policy(robot.network, c)
    if wrong.normaliser and robot.spoilt_network is not None:
        bare = replace_contract(c, mean=(), std=())
        policy = Policy(robot.spoilt_network(rng), bare)
    period = 1.0 / (c.rate_hz * wrong.rate)
    sensing, acting = rng.uniform(0.002, 0.005), rng.uniform(0.003, 0.007)
    sensing += wrong.delay_s * (wrong.late == "sensing")
    acting += wrong.delay_s * (wrong.late == "acting")
    # Pipelines of messages: measurements on their way to the policy, and targets on theirs to the drives.
    measured: deque[tuple[float, dict[str, np.ndarray]]] = deque()
    commands: deque[tuple[float, np.ndarray]] = deque([(0.0, default.copy())])
    seen = _measure(data, addresses, dofs, robot.imu, rng, None)
    frozen_at = rng.uniform(0.1, 0.3) * seconds
    bias, target, last = 0.02 * rng.normal(size=3), default.copy(), np.zeros(len(dofs))
    rows: dict[str, list[np.ndarray]] = {}
    states: dict[str, list[np.ndarray]] = {}
    history: deque[dict[str, np.ndarray]] = deque(maxlen=16)
    next_step, fell_s, frozen = 0.0, None, None
    phases, speeds = rng.uniform(0, 6.28, (2, len(dofs))), rng.uniform(1.0, 6.0, (2, len(dofs)))
    walk = np.zeros(3)
    raw_late: deque[dict[str, np.ndarray]] = deque(maxlen=2)
    for tick in range(int(seconds / STEP_S)):
        now = tick * STEP_S
        if tick % 2 == 0:
            fresh = _measure(data, addresses, dofs, robot.imu, rng, bias)
            if wrong.frozen == "sensor" and now > frozen_at and robot.imu:
                frozen = frozen or {k: fresh[k] for k in ("gyro", "quat")}
                fresh |= frozen
            measured.append((now + sensing + rng.uniform(0, 0.002), fresh))
        while measured and measured[0][0] <= now:
            seen = measured.popleft()[1]
            for key, value in (("state_t", np.array(now)), *seen.items()):
                states.setdefault(key, []).append(value)
        if now >= next_step - 1e-9:
            next_step += period * (1 + 0.01 * rng.normal())
            if robot.imu and len(history) % 8 == 0 and rng.random() < 0.15:
                walk = rng.uniform(-1, 1, 3) * np.array([0.8, 0.4, 1.0]) * (rng.random() > 0.1)
            command = walk.copy() if robot.imu else robot.swing * np.sum(np.sin(speeds * now + phases), 0) / 2
            raw_late.append(seen)
            used = raw_late[0] if wrong.late == "loop" else seen
            if wrong.frozen == "observation" and now > frozen_at:
                frozen = frozen or {k: used[k] for k in ("gyro", "quat")}
                used = used | frozen
            history.append(_quantities(c, wrong, used, command, last))
            observation = _observation(c, wrong, history)
            action = policy(observation[None])[0]
            last = action
            if now < 0.5 and robot.imu:
                action = action * now / 0.5
                last = action
            target = _target(wrong, default, scale, action)
            commands.append((now + acting + rng.uniform(0, 0.002), target))
            noted = {"t": np.array(now), **seen, "command": command, "observation": observation, "action": action,
                     "target": target}  # fmt: skip
            for key, value in noted.items():
                rows.setdefault(key, []).append(value)
        while len(commands) > 1 and commands[1][0] <= now:
            commands.popleft()
        goal = commands[0][1] if commands[0][0] <= now else default
        wanted = np.clip(kp * (goal - data.qpos[addresses]) - kd * data.qvel[dofs], -limit, limit)
        tau += (wanted - tau) * min(1.0, STEP_S / lag_s)
        data.qfrc_applied[dofs] = tau
        mujoco.mj_step(model, data)
        if robot.imu and fell_s is None and (data.qpos[2] < 0.15 or np.cos(_tilt(data.qpos[3:7])) < 0.5):
            fell_s = now
        if fell_s is not None and now > max(fell_s + 1.0, 4.0):
            break
    signals = {key: np.array(values) for key, values in rows.items()}
    signals |= {f"stream.{key}": np.array(values) for key, values in states.items()}
    signals["fell"] = np.array(fell_s is not None)
    return signals


def _needed(robot: Robot, seconds: float) -> np.ndarray:
    """Return the largest torques of a sound deployment, without the moments of impacts ``(J,)``."""
    calm = deploy(replace(robot), Wrong(), min(seconds, 6.0), np.random.default_rng(5))
    c = robot.contract
    torque = c.per_joint("kp") * (calm["target"] - calm["q"]) - c.per_joint("kd") * calm["dq"]
    return np.quantile(np.abs(torque[10:]), 0.97, axis=0)


def _disturbed(model: mujoco.MjModel, rng: np.random.Generator) -> mujoco.MjModel:
    heavier = rng.uniform(0.95, 1.06, model.nbody)
    model.body_mass *= heavier
    model.body_inertia *= heavier[:, None]
    model.body_ipos[1:] += 0.003 * rng.normal(size=(model.nbody - 1, 3))
    for name, low, high in (("dof_damping", 0.7, 1.4), ("dof_frictionloss", 0.7, 1.5), ("dof_armature", 0.85, 1.2)):
        getattr(model, name)[:] *= rng.uniform(low, high, model.nv)
    model.geom_friction[:, 0] *= rng.uniform(0.8, 1.2)
    model.actuator_gainprm[:], model.actuator_biasprm[:] = 0.0, 0.0  # the drives are those of ``deploy``
    return model


def _measure(
    data: mujoco.MjData, addresses: list[int], dofs: list[int], imu: bool, rng: np.random.Generator,
    bias: np.ndarray | None,
) -> dict[str, np.ndarray]:  # fmt: skip
    n, count = rng.normal, len(dofs)
    step = 2 * np.pi / 16384
    found = {
        "q": step * np.round((data.qpos[addresses] + 0.0008 * n(size=count)) / step),
        "dq": data.qvel[dofs] + 0.04 * n(size=count),
    }
    if imu:
        quat = data.qpos[3:7] + 0.002 * n(size=4)
        found |= {"quat": quat / np.linalg.norm(quat), "gyro": data.qvel[3:6] + 0.03 * n(size=3)}
        found["gyro"] = found["gyro"] + (0.0 if bias is None else bias)
    return found


def rotated(quat: np.ndarray, vector: np.ndarray, inverse: bool) -> np.ndarray:
    """Return a vector of the body in the world, or with ``inverse`` one of the world in the body."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    matrix = matrix.reshape(3, 3)
    return (matrix.T if inverse else matrix) @ vector


def _tilt(quat: np.ndarray) -> float:
    return float(np.arccos(np.clip(rotated(quat, np.array([0, 0, 1.0]), True)[2], -1, 1)))


def _quantities(c: Contract, wrong: Wrong, seen: dict[str, np.ndarray], command: np.ndarray, last: np.ndarray
                ) -> dict[str, np.ndarray]:  # fmt: skip
    """Return the parts of an observation by their kinds, as the deployment makes them."""
    q, dq, default = seen["q"], seen["dq"], c.per_joint("default_joint_pos")
    if wrong.order is not None and wrong.order_of != "action":
        q, dq = q[wrong.order], dq[wrong.order]
    if wrong.signs is not None and wrong.signs_of != "action":
        q, dq = q * wrong.signs, dq * wrong.signs
    if wrong.offset is not None and wrong.offset_of != "action":
        default = default + wrong.offset
    made = {"joint_pos": q - default, "joint_vel": dq, "last_action": last, "command": command}
    if "gyro" in seen:
        gyro, down = seen["gyro"], np.array([0, 0, -1.0])
        gravity = down if wrong.imu == "gravity" else rotated(seen["quat"], down, True)
        if wrong.imu in ("twice", "gyro"):
            gyro = rotated(seen["quat"], gyro, wrong.imu == "twice")
        made |= {"ang_vel": gyro, "gravity": gravity}
    name, factor = wrong.scaled
    return {k: v * (factor if k == name else 1.0) for k, v in made.items()}


def _observation(c: Contract, wrong: Wrong, history: deque[dict[str, np.ndarray]]) -> np.ndarray:
    parts = []
    for term, lag in c.layout:
        own = c.observation[term]
        back = own.history - 1 - lag if wrong.reversed_history else lag
        row = history[-1 - back] if back < len(history) else history[0]
        parts.append(row[own.kind] * np.asarray(own.scale))
    return np.concatenate(parts)


def _target(wrong: Wrong, default: np.ndarray, scale: np.ndarray, action: np.ndarray) -> np.ndarray:
    factor = wrong.scaled[1] if wrong.scaled[0] == "action" else 1.0
    offset = wrong.offset if wrong.offset is not None and wrong.offset_of != "observation" else 0.0
    move = scale * factor * action
    if wrong.signs is not None and wrong.signs_of != "observation":
        move = move * wrong.signs
        default = default if wrong.signs_of == "action" else default * wrong.signs
    target = default + offset + move
    if wrong.order is not None and wrong.order_of != "observation":
        placed = np.empty_like(target)
        placed[wrong.order] = target
        return placed
    return target


def write_case(robot: Robot, signals: dict[str, np.ndarray], folder: Path, rng: np.random.Generator) -> dict[str, Path]:
    """Write model, policy, contract and log, with the signals that such a log happens to have."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot.xml").write_text(robot.xml)
    (folder / "policy.onnx").write_bytes(robot.network)
    (folder / "contract.toml").write_text(contract_toml(robot.contract))
    kept = ["t", "command", "target"]
    logs = rng.random(2).tolist()
    kept += ["observation"] * (logs[0] < 0.5) + ["action"] * (logs[0] < 0.5 or logs[1] < 0.5)
    log = {k: signals[k] for k in kept}
    streamed = rng.random() < 0.3
    for key in ("q", "dq", "quat", "gyro", "state_t"):
        if streamed and f"stream.{key}" in signals:
            log[key] = signals[f"stream.{key}"]
        elif key in signals:
            log[key] = signals[key]
    np.savez(folder / "real.npz", **log)
    return {"mjcf": folder / "robot.xml", "policy": folder / "policy.onnx", "contract": folder / "contract.toml",
            "log": folder / "real.npz"}  # fmt: skip
