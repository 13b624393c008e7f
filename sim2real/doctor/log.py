"""A deployment's log as arrays: what was measured, what the policy saw and gave, and what was commanded."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
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
_OF_STEPS = ("command", "obs", "action", "target")
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
        message_age_s: Ages of the measurements that the steps answer, if the log has the messages [s].
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
    message_age_s: np.ndarray | None = None

    @property
    def rows_are_steps(self) -> bool:
        """Whether the measurements were logged by the policy's own loop, one for each step."""
        return len(self.t) == len(self.state_t) and bool(np.allclose(self.t, self.state_t, atol=2e-3))

    @cached_property
    def age_s(self) -> np.ndarray | None:
        """Ages of the measurements that the steps answer [s]: by the messages, or of the newest ones."""
        if self.message_age_s is not None or self.rows_are_steps:
            return self.message_age_s
        return self.t - self.state_t[self._rows(0.0)]

    def _rows(self, lag_s: float) -> np.ndarray:
        rows = np.searchsorted(self.state_t, self.t - lag_s + 1e-6, side="right") - 1
        return np.clip(rows, 0, len(self.state_t) - 1)

    def at_steps(self, name: str, lag_s: float = 0.0) -> np.ndarray:
        """Return a measured signal at the policy's steps, ``lag_s`` earlier; between measurements the older counts."""
        values = getattr(self, name)
        if self.rows_are_steps:
            rows = np.arange(len(self.t), dtype=float) - lag_s / max(np.median(np.diff(self.t)), 1e-6)
            low = np.clip(np.floor(rows + 1e-6).astype(int), 0, len(values) - 1)
            high, share = np.minimum(low + 1, len(values) - 1), np.clip(rows - low, 0.0, 1.0)[:, None]
            return values[low] if not np.any(share > 1e-6) else (1 - share) * values[low] + share * values[high]
        return values[self._rows(lag_s)]


@dataclass(frozen=True)
class _Signal:
    """Rows ``(K, C)``, their times (none: those of the steps), and the names of the columns."""

    values: np.ndarray
    t: np.ndarray = field(default_factory=lambda: np.zeros(0))
    columns: Sequence[str] = ()


def read_deployment(path: Path, joints: Sequence[str], robot_joints: Sequence[str] = ()) -> Log:
    """Read a log of this project, or a CSV, NPZ, JSON or bag with a row for each step of the policy.

    Args:
        joints: The joints of the contract, which are sought in the names of the columns.
        robot_joints: The joints in the order of columns without names; default: the contract's.

    Raises:
        UsageError: The file cannot be read, or has no times, positions or commands.
    """
    signals, age_s = _signals(path)
    found: dict[str, _Signal] = {}
    for name, signal in signals.items():
        if (kind := _kind_of(name)) is not None and kind not in found:
            found[kind] = _in_order(signal, robot_joints, joints, name) if kind in ("q", "dq", "target") else signal
    stamps = [found[n].t for n in ("action", "obs", "target") if n in found and len(found[n].t)]
    step_t = found["t"].values if "t" in found else stamps[0] if stamps else None
    if missing := [n for n, lacks in (("times t", step_t is None), ("positions q", "q" not in found)) if lacks]:
        raise UsageError(
            f"{path} has no {' and no '.join(missing)}. It has {', '.join(signals) or 'nothing'}",
            hint="the guide 'Doctor' lists the signals and their names",
        )
    assert step_t is not None
    if "action" not in found and "target" not in found:
        raise UsageError(f"{path} has neither actions nor targets, so nothing of the policy")
    if len(step_t) < 20 or not any(len(found[n].values) == len(step_t) for n in _OF_STEPS[1:] if n in found):
        raise UsageError(f"{path} has {len(step_t)} times of steps; actions, targets or observations do not fit them")
    q = found["q"]
    state_t = found["state_t"].values if "state_t" in found else q.t if len(q.t) == len(q.values) else step_t
    if "dq" not in found:
        found["dq"] = _Signal(np.gradient(q.values, state_t, axis=0), state_t)
    order = np.argsort(state_t, kind="stable")
    parts: dict[str, np.ndarray] = {}
    for name, signal in found.items():
        if not np.isfinite(signal.values).all():
            raise UsageError(f"{path}: {name} has values that are not finite")
        if name in _STATES:
            parts[name] = _at(signal, state_t, f"{path}: {name}")[order]
        elif name in _OF_STEPS:
            parts[name] = _at(signal, step_t, f"{path}: {name}")
    if "action" in parts and parts["action"].shape[1] != len(joints):
        raise UsageError(f"{path}: action has {parts['action'].shape[1]} columns, the policy {len(joints)}")
    return Log(step_t, state_t[order], message_age_s=age_s, **parts)


def _at(signal: _Signal, wanted: np.ndarray, what: str) -> np.ndarray:
    """Return a signal at other times: the newest value then; a single row holds for all.

    Raises:
        UsageError: It has another number of rows, and no times of its own.
    """
    values, times = signal.values, signal.t
    if len(values) == len(wanted):
        return values
    if len(values) == 1:
        return np.repeat(values, len(wanted), axis=0)
    if len(times) != len(values):
        raise UsageError(f"{what} has {len(values)} rows and no times of its own; {len(wanted)} rows are wanted")
    return values[np.clip(np.searchsorted(times, wanted + 1e-6, side="right") - 1, 0, len(values) - 1)]


def _kind_of(name: str) -> str | None:
    """Return the kind of a signal; an angle or a torque of a command is a target, a measured torque is not used."""
    *nodes, last = re.split(r"[./]", name.lower())
    if nodes[:1] and nodes[0] in _UNUSED_NODES:
        return None
    kind = _OF_NAME.get(last)
    if nodes[:1] == ["agent"]:
        return kind if kind in ("action", "obs", "command") else None
    if any(node == "actuator" or node.endswith("cmd") for node in nodes):
        return "target" if kind in ("q", "target", "action", "torque") else None
    return None if kind == "torque" else kind


def _in_order(signal: _Signal, robot_joints: Sequence[str], joints: Sequence[str], name: str) -> _Signal:
    """Return the columns of the joints in the contract's order; without names they come in the robot's order."""
    names = signal.columns or robot_joints
    if not names:
        if signal.values.ndim != 2 or signal.values.shape[1] != len(joints):
            raise UsageError(
                f"{name} has {signal.values.shape[1:]} columns without names, the contract {len(joints)} joints",
                hint="name the columns, such as q.FL_hip_joint",
            )
        return signal
    exact = [names.index(j) for j in joints if j in names]
    found = (exact, "") if len(exact) == len(joints) else columns_of(joints, names)
    if found is None:
        raise UsageError(f"{name} has the columns {', '.join(names)}; the contract's joints: {', '.join(joints)}")
    return replace(signal, values=signal.values[:, found[0]])


def _signals(path: Path) -> tuple[dict[str, _Signal], np.ndarray | None]:
    """Return the signals of a file by their names, and the ages of observations."""
    from sim2real.log.importing.readers import open_tables
    from sim2real.log.writer import LIBRARY

    if path.is_file():
        with path.open("rb") as file:
            if LIBRARY.split()[0].encode() in file.read(200):
                return _own_log(path)
    table = open_tables(path)[0]
    of_file = next((list(words) for name, words in table.words.items() if name in ("joints", "joint_names")), [])
    signals: dict[str, _Signal] = {}
    joined: dict[str, list[tuple[str, np.ndarray]]] = {}
    for name, values in table.columns.items():
        # One column for each joint, or each entry: `q.FL_hip_joint`, `observation[3]`, `action_0`.
        match = re.fullmatch(r"(.+?)[.\[/](.+?)\]?", name) or re.fullmatch(r"(.+?)_(\d+)", name)
        if np.ndim(values) == 1 and match and _OF_NAME.get(match[1].lower()):
            joined.setdefault(match[1], []).append((match[2], values))
        elif np.ndim(values) == 2 or _OF_NAME.get(name.lower()) in ("t", "state_t"):
            signals[name] = _Signal(np.asarray(values, float), columns=of_file or table.names.get(name, []))
    for name, columns in joined.items():
        labels = [label for label, _ in columns]
        numbered = all(re.fullmatch(r"\d+", label) for label in labels)
        values = np.stack([np.asarray(v, float) for _, v in columns], axis=1)
        signals[name] = _Signal(values, columns=of_file or ([] if numbered else labels))
    return signals, None


def _own_log(path: Path) -> tuple[dict[str, _Signal], np.ndarray | None]:
    from sim2real.log.reader import read_log

    episode = read_log(path)
    signals, age_s = {}, None
    joints = episode.metadata.get("joints", [])
    for node, output in episode.outputs.items():
        steps = episode.steps[node]
        for name, field_values in ((f"{node}.{leaf}", v) for leaf, v in output.items()):
            values = np.asarray(field_values, float)
            values = values if values.ndim > 1 else values[:, None]
            times = steps.begun_s if _kind_of(name) in _STATES else steps.end / 1e6
            signals[name] = _Signal(values, times, joints if values.shape[1] == len(joints) else ())
    for (node, source), messages in episode.messages.items():
        if source == "sensor" and node in ("agent", "policy") and len(messages):
            begun, ended = episode.steps[node].begun_s, episode.steps[source].begun_s
            ok = (messages.seq_in >= 0) & (messages.seq_in < len(begun)) & (messages.seq_out < len(ended))
            age_s = begun[messages.seq_in[ok]] - ended[messages.seq_out[ok]]
    return signals, age_s
