"""Examines a policy before the robot moves, with the policy and the model alone."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim2real.doctor.contract import UNMEASURED, Policy
from sim2real.doctor.deployed import Deployed
from sim2real.doctor.log import Log
from sim2real.doctor.plant import Drives, lowest_points, mujoco
from sim2real.doctor.search import Setting

_SECONDS = 4.0
_DELAYS = {f"{1e3 * s:.0f} ms": Setting((("delay_s", s),)) for s in (0.0, 0.005, 0.01, 0.02, 0.03, 0.04)}
_PLANTS = {"0.7 of the gains": Setting((("kd", 0.7), ("kp", 0.7))),
           "1.3 of the gains": Setting((("kd", 1.3), ("kp", 1.3))),
           "no dry friction": Setting((("friction", -1.0),)),
           "dry friction of 5% of the largest torque": Setting((("friction", 0.05),))}  # fmt: skip
_STARTS, _POSE_RAD, _TILT_RAD = 8, 0.25, 0.15
_LARGE = (1.0, 10.0, 1000.0)
_UPRIGHT, _FAST_RAD_S = 0.5, 3.0


@dataclass(frozen=True)
class Run:
    """Result of a policy in the model: whether it stayed up, rms speed of joints, shares of limited commands."""

    up: bool
    until_s: float
    speed: float
    clipped: float
    beyond: float


def examine(policy: Policy, drives: Drives) -> dict[str, Any]:
    """Return what may fail: actions that are not finite, unmeasured entries, and disturbances that make it fall."""
    c, lines, rng = policy.contract, list[str](), np.random.default_rng(0)
    finite = all(np.isfinite(policy(scale * rng.normal(size=(256, c.size)))).all() for scale in _LARGE)
    if not finite:
        lines.append("the network gives numbers that are not finite for large observations")

    # Entries of the observation that no robot measures.
    unmeasured: dict[str, float] = {}
    usual = 0.3 * rng.normal(size=(256, c.size))
    for term, lag in c.layout:
        own = c.observation[term]
        if own.kind in UNMEASURED:
            moved = usual.copy()
            moved[:, c.block(term, lag)] += 0.5
            change = float(np.abs(policy(moved) - policy(usual)).mean() / (policy(usual).std() + 1e-9))
            unmeasured[own.term] = max(change, unmeasured.get(own.term, 0.0))
    lines += [f"the action depends on {name}, which a robot's sensors do not give: 0.5 of it changes the actions by "
              f"{change:.0%} of their deviation" for name, change in unmeasured.items() if change > 0.02]  # fmt: skip

    # The policy in the model, as in training and with disturbances of a real robot.
    nominal = _run(policy, drives, Setting())
    limit = max(3.0 * nominal.speed, _FAST_RAD_S)
    runs = {name: _run(policy, drives, plant) for name, plant in {**_DELAYS, **_PLANTS}.items()}
    stands = {name: run.up and run.speed < limit for name, run in runs.items()}
    starts = sum(_run(policy, drives, Setting(), np.random.default_rng(seed)).up for seed in range(_STARTS))
    if not nominal.up:
        text = f"in the model itself the policy fails after {nominal.until_s:.2f} s, without a command and a delay"
        lines.insert(0, f"{text}: the contract or the model is not that of the training")
    else:
        late = [name for name in _DELAYS if not stands[name]]
        lines += [f"it fails from a delay of {name} on: measure the robot's" for name in late[:1]]
        lines += [f"it fails with {name}" for name in _PLANTS if not stands[name]]
        if starts < _STARTS:
            lines.append(f"it stays up from {starts} of {_STARTS} starts within {_POSE_RAD} rad of its default pose")
    if nominal.clipped > 0.05:
        lines.append(f"{nominal.clipped:.0%} of its commands ask for more torque than the model's drives have")
    if nominal.beyond > 0.05:
        lines.append(f"{nominal.beyond:.0%} of its targets are beyond the joints' ranges")
    sentence = f"{lines[0][0].upper()}{lines[0][1:]}." if lines else "Nothing speaks against a first test."
    return {
        "sentence": sentence, "sound": not lines, "lines": lines, "finite": finite, "unmeasured": unmeasured,
        "delays": {name: stands[name] for name in _DELAYS}, "plants": {name: stands[name] for name in _PLANTS},
        "starts": f"{starts} of {_STARTS}", "stays_up": nominal.up,
        "clipped": nominal.clipped, "beyond": nominal.beyond,
    }  # fmt: skip


def _run(policy: Policy, drives: Drives, plant: Setting, start: np.random.Generator | None = None) -> Run:
    """Let the policy act in the model, with the command 0; ``start``: random numbers for another start."""
    c, d = policy.contract, drives
    model = d.with_plant(plant, np.minimum(d.limit, d.kp))  # the largest torque: the model's, or the torque for 1 rad
    data = mujoco.MjData(model)
    default = c.per_joint("default_joint_pos")
    spread = (0.0, 0.0) if start is None else (_POSE_RAD, _TILT_RAD)
    draw = start or np.random.default_rng(0)
    data.qpos[d.qpos] = default + draw.uniform(-spread[0], spread[0], len(default))
    if d.free:
        mujoco.mju_euler2Quat(data.qpos[3:7], draw.uniform(-spread[1], spread[1], 3), "xyz")
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
    ids = [model.joint(j).id for j in c.joints]
    low, high = model.jnt_range[ids].T
    bounded = (model.jnt_limited[ids] == 1) & (c.drive == "position")
    size = sum(c.size_of(t) for t in c.observation if t.kind == "command")
    ended = lambda up, now, kept: Run(up, now, float(np.mean(kept)), float(np.mean(clipped)), float(np.mean(beyond)))  # noqa: E731
    steps = int(_SECONDS / model.opt.timestep)
    for tick in range(steps):
        now = tick * model.opt.timestep
        if now >= next_s - 1e-9:
            next_s += 1.0 / c.rate_hz
            quat, gyro = (data.qpos[3:7], data.qvel[3:6]) if d.free else (np.array([1.0, 0, 0, 0]), np.zeros(3))
            past.append((data.qpos[d.qpos].copy(), data.qvel[d.dof].copy(), quat.copy(), gyro.copy(), action))
            rows = [past[0]] * (longest + 1 - len(past)) + list(past)
            q, dq, quats, gyros, actions = (np.array(column) for column in zip(*rows, strict=True))
            times, count = np.arange(len(rows)) / c.rate_hz, len(rows)
            # The newest row has no action yet: its last action is the action of the row before.
            log = Log(times, times, q, dq, quats, gyros, np.zeros((count, 3)), np.zeros((count, size)), None,
                      np.roll(actions, -1, 0))  # fmt: skip
            deployed = Deployed(log, policy)
            action = policy(deployed.observations(Setting(), np.array([count - 1])))[0]
            if not np.isfinite(action).all():
                return Run(False, now, np.inf, 1.0, 1.0)
            target = deployed.targets(Setting(), action[None])[0]
            commands.append((now + plant.get("delay_s", 0.0), target))
            clipped.append(np.abs(d.torque(target, q[-1], dq[-1])) > d.limit)
            beyond.append(bounded & ((target < low) | (target > high)))
        while len(commands) > 1 and commands[1][0] <= now:
            commands.popleft()
        data.ctrl[:] = commands[0][1]
        mujoco.mj_step(model, data)
        speeds.append(float(np.sqrt(np.mean(data.qvel[d.dof] ** 2))))
        fallen = d.free and (data.qpos[2] < 0.5 * height or 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2) < _UPRIGHT)
        if fallen or not np.isfinite(data.qpos).all() or speeds[-1] > 100.0:
            return ended(False, now, speeds)
    return ended(True, _SECONDS, speeds[steps // 2 :])
