"""Before the robot moves: what the policy and the model alone say about what may fail."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim2real.doctor.contract import UNMEASURED, Policy
from sim2real.doctor.log import Log
from sim2real.doctor.plant import Drives, Plant, lowest_points, mujoco
from sim2real.doctor.solve import Deployed, Making

_SECONDS, _DELAYS_S = 4.0, (0.0, 0.005, 0.01, 0.02, 0.03, 0.04)
_PLANTS = {"0.7 of the gains": Plant(kp=0.7, kd=0.7), "1.3 of the gains": Plant(kp=1.3, kd=1.3),
           "half of the friction": Plant(friction=0.5), "twice the friction": Plant(friction=2.0)}  # fmt: skip
_STARTS, _POSE_RAD, _TILT_RAD = 8, 0.25, 0.15
_LARGE = (1.0, 10.0, 1000.0)
_UPRIGHT, _FAST_RAD_S = 0.5, 3.0


@dataclass(frozen=True)
class Run:
    """A policy in the model: whether it stayed up, the rms speed of its joints, and shares of limited commands."""

    up: bool
    until_s: float
    speed: float
    clipped: float
    beyond: float


def examine(policy: Policy, drives: Drives) -> dict[str, Any]:
    """Return what may fail: numbers that are none, unmeasured entries, and what the policy stands in the model."""
    c, lines, rng = policy.contract, list[str](), np.random.default_rng(0)
    numbers = [policy(scale * rng.normal(size=(256, c.size))) for scale in _LARGE]
    finite = all(np.isfinite(action).all() for action in numbers)
    if not finite:
        lines.append("the network gives numbers that are not finite for large observations")

    # Entries that no robot measures.
    unmeasured = {}
    starts = np.cumsum([0, *(c.size_of(c.observation[t]) for t, _ in c.layout)])
    usual = 0.3 * rng.normal(size=(256, c.size))
    for block, (term, _) in enumerate(c.layout):
        own = c.observation[term]
        if own.kind in UNMEASURED:
            moved = usual.copy()
            moved[:, starts[block] : starts[block + 1]] += 0.5
            change = float(np.abs(policy(moved) - policy(usual)).mean() / (policy(usual).std() + 1e-9))
            unmeasured[own.term] = max(change, unmeasured.get(own.term, 0.0))
    lines += [f"the action depends on {name}, which a robot's sensors do not give: 0.5 of it changes the actions by "
              f"{change:.0%} of their deviation" for name, change in unmeasured.items() if change > 0.02]  # fmt: skip

    # The policy in the model, as trained and with what a robot may have.
    nominal = _run(policy, drives, Plant(), None)
    runs = {f"{1e3 * d:.0f} ms": _run(policy, drives, Plant(delay_s=d), None) for d in _DELAYS_S}
    others = {name: _run(policy, drives, plant, None) for name, plant in _PLANTS.items()}
    starts_up = [_run(policy, drives, Plant(), np.random.default_rng(seed)).up for seed in range(_STARTS)]
    standing = lambda run: run.up and run.speed < max(3.0 * nominal.speed, _FAST_RAD_S)  # noqa: E731
    first = next((name for name, run in runs.items() if not standing(run)), None)
    if not nominal.up:
        text = f"in the model itself the policy fails after {nominal.until_s:.2f} s, without a command and a delay"
        lines.insert(0, f"{text}: the contract or the model is not that of the training")
    elif first is not None:
        lines.append(f"it fails from a delay of {first} on: measure the robot's")
    lines += [f"it fails with {name}" for name, run in others.items() if nominal.up and not standing(run)]
    if nominal.up and sum(starts_up) < _STARTS:
        lines.append(
            f"it stays up from {sum(starts_up)} of {_STARTS} starts within {_POSE_RAD} rad of its default pose"
        )
    if nominal.clipped > 0.05:
        lines.append(f"{nominal.clipped:.0%} of its commands ask for more torque than the model's drives have")
    if nominal.beyond > 0.05:
        lines.append(f"{nominal.beyond:.0%} of its targets are beyond the joints' ranges")
    sound = finite and nominal.up and not lines
    sentence = "Nothing speaks against a first test." if sound else f"{lines[0][0].upper()}{lines[0][1:]}."
    return {
        "sentence": sentence, "sound": sound, "lines": lines, "finite": finite, "unmeasured": unmeasured,
        "delays": {name: standing(run) for name, run in runs.items()},
        "plants": {name: standing(run) for name, run in others.items()},
        "starts": f"{sum(starts_up)} of {_STARTS}", "stays_up": nominal.up, "clipped": nominal.clipped,
        "beyond": nominal.beyond,
    }  # fmt: skip


def _run(policy: Policy, drives: Drives, plant: Plant, start: np.random.Generator | None) -> Run:
    """Let the policy act in the model, with the command 0."""
    c, d = policy.contract, drives
    model = d.with_plant(plant, np.full(len(c.joints), 1e6))
    data = mujoco.MjData(model)
    default = c.per_joint("default_joint_pos")
    data.qpos[d.qpos] = default
    if start is not None:
        data.qpos[d.qpos] += start.uniform(-_POSE_RAD, _POSE_RAD, len(default))
    if d.free:
        turn = np.zeros(3) if start is None else start.uniform(-_TILT_RAD, _TILT_RAD, 3)
        mujoco.mju_euler2Quat(data.qpos[3:7], turn, "xyz")
        data.qpos[2] = 0.0
        mujoco.mj_kinematics(model, data)
        data.qpos[2] = 0.002 - min(p[2] for _, p in lowest_points(model, data))
    height = float(data.qpos[2]) if d.free else 0.0
    longest = max(t.history for t in c.observation)
    past: deque[tuple[np.ndarray, ...]] = deque(maxlen=longest + 1)
    resting = default if c.drive == "position" else np.zeros(len(default))
    commands: deque[tuple[float, np.ndarray]] = deque([(-1.0, resting)])
    action, next_s, speeds, clipped, beyond = np.zeros(len(c.joints)), 0.0, [], [], []
    data.ctrl[:] = resting
    ranges, limited = model.jnt_range[_joint_ids(model, c.joints)], model.jnt_limited[_joint_ids(model, c.joints)]
    size = sum(c.size_of(t) for t in c.observation if t.kind == "command")
    steps = int(_SECONDS / model.opt.timestep)
    for tick in range(steps):
        now = tick * model.opt.timestep
        if now >= next_s - 1e-9:
            next_s += 1.0 / c.rate_hz
            quat, gyro = (data.qpos[3:7], data.qvel[3:6]) if d.free else (np.array([1.0, 0, 0, 0]), np.zeros(3))
            past.append((data.qpos[d.qpos].copy(), data.qvel[d.dof].copy(), quat.copy(), gyro.copy(), action))
            rows = [past[0]] * (longest + 1 - len(past)) + list(past)
            q, dq, quats, gyros, actions = (np.array(column) for column in zip(*rows, strict=True))
            times = np.arange(len(rows)) / c.rate_hz
            # The newest row's own action does not exist yet: its last action is that of the row before.
            log = Log(times, times, q, dq, quats, gyros, np.zeros((len(rows), 3)),
                      np.zeros((len(rows), size)), None, np.roll(actions, -1, 0))  # fmt: skip
            deployed = Deployed(log, policy)
            action = policy(deployed.observations(Making(), np.array([len(rows) - 1])))[0]
            if not np.isfinite(action).all():
                return Run(False, now, np.inf, 1.0, 1.0)
            target = deployed.targets(Making(), action[None])[0]
            commands.append((now + plant.delay_s, target))
            torque = target if d.torque_driven else d.kp * (target - q[-1]) - d.kd * dq[-1]
            clipped.append(np.abs(torque) > d.limit)
            beyond.append(limited & ((target < ranges[:, 0]) | (target > ranges[:, 1])) & (c.drive == "position"))
        while len(commands) > 1 and commands[1][0] <= now:
            commands.popleft()
        data.ctrl[:] = commands[0][1]
        mujoco.mj_step(model, data)
        speeds.append(float(np.sqrt(np.mean(data.qvel[d.dof] ** 2))))
        fallen = d.free and (data.qpos[2] < 0.5 * height or 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2) < _UPRIGHT)
        if fallen or not np.isfinite(data.qpos).all() or speeds[-1] > 100.0:
            return Run(False, now, float(np.mean(speeds)), float(np.mean(clipped)), float(np.mean(beyond)))
    return Run(True, _SECONDS, float(np.mean(speeds[steps // 2 :])), float(np.mean(clipped)), float(np.mean(beyond)))


def _joint_ids(model: Any, joints: tuple[str, ...]) -> list[int]:
    return [model.joint(j).id for j in joints]
