"""A deployment's log as arrays: what was measured, what the policy saw and gave, and what was commanded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.names import columns_of

_NAMES = {
    "t": "t time time_s stamp timestamp t_s",
    "q": "q th theta position positions joint_pos joint_position dof_pos qpos",
    "dq": "dq thdot qd velocity velocities joint_vel joint_velocity dof_vel qvel",
    "quat": "quat quaternion orientation base_quat imu_quat",
    "gyro": "gyro ang_vel angular_velocity base_ang_vel imu_gyro",
    "lin_vel": "lin_vel base_lin_vel linear_velocity",
    "command": "command cmd velocity_command velocity_commands aim",
    "obs": "observation obs observations",
    "action": "action actions raw_action network_action",
    "target": "target targets goal goals q_des q_target goal_position cmd_position joint_target torque_command",
    "torque": "torque tau tau_est effort",
    "state_t": "state_t state_time sensor_time",
}
"""Signal -> its names in a file, whose last part counts: ``sensor.position``."""
_OF_NAME = {name: signal for signal, names in _NAMES.items() for name in names.split()}
_STATES = ("q", "dq", "quat", "gyro", "lin_vel")
_UNUSED_NODES = ("world", "truth")


@dataclass(frozen=True)
class Log:
    """A deployment.

    Attributes:
        t: Times of the policy's steps ``(N,)`` [s].
        state_t: Times of the measurements ``(K,)`` [s].
        q, dq: Joints ``(K, J)``, in the contract's order [rad], [rad/s].
        quat, gyro, lin_vel: ``(K, 4)`` as w, x, y, z; ``(K, 3)`` [rad/s]; ``(K, 3)`` [m/s].
        command: The task's command ``(N, C)``.
        obs: Observations before normalising ``(N, O)``.
        action: Outputs of the network ``(N, A)``.
        target: Commands to the drives ``(N, J)``, in the contract's order.
        age_s: Age of the measurement that each step answers ``(N,)``, if the log has the messages [s].
    """

    t: np.ndarray
    state_t: np.ndarray
    q: np.ndarray
    dq: np.ndarray
    quat: np.ndarray | None = None
    gyro: np.ndarray | None = None
    lin_vel: np.ndarray | None = None
    command: np.ndarray | None = None
    obs: np.ndarray | None = None
    action: np.ndarray | None = None
    target: np.ndarray | None = None
    age_s: np.ndarray | None = None

    @property
    def rows_are_steps(self) -> bool:
        """Whether the measurements were logged by the policy's own loop, one for each step."""
        return len(self.t) == len(self.state_t) and bool(np.allclose(self.t, self.state_t, atol=2e-3))

    def at_steps(self, name: str, lag_s: float = 0.0) -> np.ndarray:
        """Return a measured signal at the policy's steps, ``lag_s`` earlier; between measurements the older counts."""
        values = getattr(self, name)
        if self.rows_are_steps:
            rows = np.arange(len(self.t), dtype=float) - lag_s / max(np.median(np.diff(self.t)), 1e-6)
            low = np.clip(np.floor(rows + 1e-6).astype(int), 0, len(values) - 1)
            high, share = np.minimum(low + 1, len(values) - 1), np.clip(rows - low, 0.0, 1.0)[:, None]
            return values[low] if not np.any(share > 1e-6) else (1 - share) * values[low] + share * values[high]
        rows = np.searchsorted(self.state_t, self.t - lag_s + 1e-6, side="right") - 1
        return values[np.clip(rows, 0, len(values) - 1)]


def read_deployment(path: Path, joints: Sequence[str], actions: int, robot_joints: Sequence[str] = ()) -> Log:
    """Read a log of this project, or a CSV, NPZ, JSON or bag with a row for each step of the policy.

    Args:
        joints: The joints of the contract, which are sought in the names of the columns.
        actions: Number of the policy's actions.
        robot_joints: The joints in the order of columns without names; default: the contract's.

    Raises:
        UsageError: The file cannot be read, or has no times, positions or commands.
    """
    signals, stamps, named, age_s = _signals(path)
    found: dict[str, np.ndarray] = {}
    times: dict[str, np.ndarray] = {}
    for name, values in signals.items():
        signal = _signal_of(name)
        if signal is not None and signal not in found:
            found[signal], times[signal] = np.asarray(values, float), stamps.get(name, np.zeros(0))
            if signal in ("q", "dq", "target"):
                found[signal] = _in_order(found[signal], named.get(name, []) or robot_joints, joints, name)
    step_t = found.get("t")
    for name in ("action", "obs", "target"):
        if step_t is None and name in found and len(times[name]):
            step_t = times[name]
    state_t = found.get("state_t")
    if state_t is None and "q" in found:
        state_t = times["q"] if len(times["q"]) == len(found["q"]) else step_t
    if missing := [n for n, v in (("times t", step_t), ("positions q", found.get("q"))) if v is None]:
        raise UsageError(
            f"{path} has no {' and no '.join(missing)}. It has {', '.join(signals) or 'nothing'}",
            hint="the guide 'Doctor' lists the signals and their names",
        )
    assert step_t is not None
    assert state_t is not None
    if "action" not in found and "target" not in found:
        raise UsageError(f"{path} has neither actions nor targets, so nothing of the policy")
    count = {len(found[n]) for n in ("obs", "action", "target") if n in found and len(found[n]) == len(step_t)}
    if count != {len(step_t)} or len(step_t) < 20:
        raise UsageError(f"{path} has {len(step_t)} times of steps; actions, targets or observations do not fit them")
    if "dq" not in found:
        found["dq"] = np.gradient(found["q"], state_t, axis=0)
    order = np.argsort(state_t, kind="stable")
    state_t = np.asarray(state_t)[order]
    states, others = {}, {}
    for name, values in found.items():
        if not np.isfinite(values).all():
            raise UsageError(f"{path}: {name} has values that are not finite")
        if name in _STATES:
            own = len(values) == len(order)
            states[name] = values[order] if own else _at(values, times[name], state_t, f"{path}: {name}")
        elif name in ("command", "obs", "action", "target"):
            others[name] = _at(values, times[name], step_t, f"{path}: {name}")
    if others.get("action") is not None and others["action"].shape[1] != actions:
        raise UsageError(f"{path}: action has {others['action'].shape[1]} columns, the policy {actions}")
    return Log(step_t, state_t, age_s=age_s, **states, **others)


def _at(values: np.ndarray, times: np.ndarray, wanted: np.ndarray, what: str) -> np.ndarray:
    """Return a signal at other times: the newest value then; a single row holds for all.

    Raises:
        UsageError: It has another number of rows, and no times of its own.
    """
    if len(values) == len(wanted):
        return values
    if len(values) == 1:
        return np.repeat(values, len(wanted), axis=0)
    if len(times) != len(values):
        raise UsageError(f"{what} has {len(values)} rows and no times of its own; {len(wanted)} rows are wanted")
    return values[np.clip(np.searchsorted(times, wanted + 1e-6, side="right") - 1, 0, len(values) - 1)]


def _signal_of(name: str) -> str | None:
    """Return the signal of a name; an angle or a torque of a command is a target, a measured torque is not used."""
    *nodes, last = re.split(r"[./]", name.lower())
    if nodes[:1] and nodes[0] in _UNUSED_NODES:
        return None
    signal = _OF_NAME.get(last)
    if nodes[:1] == ["agent"]:
        return signal if signal in ("action", "obs", "command") else None
    if any(node == "actuator" or node.endswith("cmd") for node in nodes):
        return "target" if signal in ("q", "target", "action", "torque") else None
    return None if signal == "torque" else signal


def _in_order(values: np.ndarray, names: Sequence[str], joints: Sequence[str], signal: str) -> np.ndarray:
    """Return the columns of the joints in the contract's order; without names they count as in this order."""
    if not names:
        if values.ndim != 2 or values.shape[1] != len(joints):
            raise UsageError(
                f"{signal} has {values.shape[1:]} columns without names, the contract {len(joints)} joints",
                hint="name the columns, such as q.FL_hip_joint",
            )
        return values
    exact = [names.index(j) for j in joints if j in names]
    found = (exact, "") if len(exact) == len(joints) else columns_of(joints, names)
    if found is None:
        raise UsageError(f"{signal} has the columns {', '.join(names)}; the contract's joints: {', '.join(joints)}")
    return values[:, found[0]]


def _signals(
    path: Path,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, list[str]], np.ndarray | None]:
    """Return signals, their times and the names of their columns; and ages of observations."""
    from sim2real.log.importing.readers import open_tables
    from sim2real.log.writer import LIBRARY

    if path.is_file():
        with path.open("rb") as file:
            if LIBRARY.split()[0].encode() in file.read(200):
                return _own_log(path)
    table = open_tables(path)[0]
    signals: dict[str, np.ndarray] = {}
    named: dict[str, list[str]] = {}
    joined: dict[str, list[tuple[str, np.ndarray]]] = {}
    for name, values in table.columns.items():
        # One column for each joint, or each entry: `q.FL_hip_joint`, `observation[3]`, `action_0`.
        match = re.fullmatch(r"(.+?)[.\[/](.+?)\]?", name) or re.fullmatch(r"(.+?)_(\d+)", name)
        if np.ndim(values) == 1 and match and _OF_NAME.get(match[1].lower()):
            joined.setdefault(match[1], []).append((match[2], values))
        elif np.ndim(values) == 2 or _OF_NAME.get(name.lower()) in ("t", "state_t"):
            signals[name] = values
            named[name] = table.names.get(name, [])
    for name, columns in joined.items():
        signals[name] = np.stack([v for _, v in columns], axis=1)
        labels = [label for label, _ in columns]
        named[name] = [] if all(re.fullmatch(r"\d+", label) for label in labels) else labels
    for name in [n for n in signals if n.lower().endswith("_joints")]:
        del signals[name]
    for name, words in table.words.items():  # npz: joints = ["FL_hip_joint", ...]
        if name in ("joints", "joint_names"):
            named |= {n: list(words) for n in signals if _signal_of(n) in ("q", "dq", "target")}
    return signals, {}, named, None


def _own_log(
    path: Path,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, list[str]], np.ndarray | None]:
    from sim2real.log.reader import read_log

    episode = read_log(path)
    signals, stamps, named = {}, {}, {}
    joints = episode.metadata.get("joints", [])
    for node, output in episode.outputs.items():
        for field, values in output.items():
            name = f"{node}.{field}"
            signals[name] = values if np.ndim(values) > 1 else np.asarray(values)[:, None]
            steps = episode.steps[node]
            stamps[name] = steps.begun_s if _signal_of(name) in _STATES else steps.end / 1e6
            named[name] = list(joints) if signals[name].shape[1] == len(joints) else []
    age_s = None
    for (node, source), messages in episode.messages.items():
        if source == "sensor" and node in ("agent", "policy") and len(messages):
            used = messages.seq_in >= 0
            begun = episode.steps[node].begun_s
            ok = used & (messages.seq_in < len(begun)) & (messages.seq_out < len(episode.steps[source]))
            age_s = begun[messages.seq_in[ok]] - episode.steps[source].begun_s[messages.seq_out[ok]]
    return signals, stamps, named, age_s
