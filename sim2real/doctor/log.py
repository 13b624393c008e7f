"""A deployment's log as arrays: measurements, observations, actions and commands."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import bags
from sim2real.log.importing.mapping import in_si
from sim2real.log.importing.names import Signal, columns_of, meaning
from sim2real.log.importing.propose import ImportHints, Proposal
from sim2real.log.importing.readers import Table, open_tables

_VECTORS = {
    "quat": "quat quaternion orientation base_quat imu_quat",
    "gyro": "gyro ang_vel angular_velocity base_ang_vel imu_gyro",
    "lin_vel": "lin_vel base_lin_vel linear_velocity",
    "command": "command cmd cmd_vel velocity_command velocity_commands aim",
    "obs": "observation obs observations",
    "action": "action actions raw_action network_action",
}
"""Signal without joints -> its names in a file; names of joint signals are read as in an import."""
_OF_NAME = {name: signal for signal, names in _VECTORS.items() for name in names.split()}
_ENTRIES = ["w", "x", "y", "z", "linear.x", "linear.y", "angular.z"]


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
        message_age_s: Ages of the measurements that the steps used, if the log has the messages [s].
        grain_s: How late the times of the steps may be, if a separate recorder stamped them [s].
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
    grain_s: float = 0.0

    @property
    def rows_are_steps(self) -> bool:
        """Whether the measurements were logged by the policy's own loop, one for each step."""
        return len(self.t) == len(self.state_t) and bool(np.allclose(self.t, self.state_t, atol=2e-3))

    @cached_property
    def age_s(self) -> np.ndarray | None:
        """Ages of the measurements that the steps used [s]: from the messages, or assuming the newest ones."""
        if self.message_age_s is not None or self.rows_are_steps:
            return self.message_age_s
        return self.t - self.state_t[newest(self.state_t, self.t)]

    def at_steps(self, name: str, lag_s: float = 0.0) -> np.ndarray:
        """Return a measured signal ``lag_s`` before the policy's steps; between measurements, the older one."""
        values = getattr(self, name)
        if self.rows_are_steps:
            rows = np.arange(len(self.t), dtype=float) - lag_s / max(np.median(np.diff(self.t)), 1e-6)
            low = np.clip(np.floor(rows + 1e-6).astype(int), 0, len(values) - 1)
            high, share = np.minimum(low + 1, len(values) - 1), np.clip(rows - low, 0.0, 1.0)[:, None]
            return values[low] if not np.any(share > 1e-6) else (1 - share) * values[low] + share * values[high]
        return values[newest(self.state_t, self.t - lag_s)]

    def before(self, end_s: float) -> Log:
        """Return the part of the log before a time."""
        steps = {n: v[self.t < end_s] for n in ("t", "command", "obs", "action", "target")
                 if (v := getattr(self, n)) is not None}  # fmt: skip
        states = {n: v[self.state_t < end_s] for n in ("state_t", "q", "dq", "quat", "gyro", "lin_vel")
                  if (v := getattr(self, n)) is not None}  # fmt: skip
        return replace(self, **steps, **states)


def newest(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return for each wanted time the newest row."""
    return np.clip(np.searchsorted(times, wanted + 1e-6, side="right") - 1, 0, len(times) - 1)


def read_deployment(
    path: Path, joints: Sequence[str], robot_joints: Sequence[str] = (), drive: str = "position"
) -> Log:
    """Read a log of this project, or a CSV, NPZ, JSON or bag.

    Args:
        joints: The joints of the contract, by which columns are found.
        robot_joints: The joints in the order of columns without names; default: the contract's.
        drive: Kind of targets in the contract: angles or torques.

    Raises:
        UsageError: The file cannot be read, lacks times, positions or commands, or has names that match no joint.
    """
    table, age_s = _own_table(path) if path.is_file() and bags.is_ours(path) else (open_tables(path)[0], None)
    vectors = _take_vectors(table, joints)
    reader = Proposal(table, ImportHints(""))
    signals = {**_of_joints(reader.signals, joints, robot_joints or joints, drive), **vectors}
    listed = ", ".join([*vectors, *table.keys]) or "nothing"
    if "q" not in signals or not {"action", "target"} & set(signals):
        what = "positions q" if "q" not in signals else "actions and no targets"
        raise UsageError(f"{path} has no {what}. It has {listed}", hint="the guide 'Doctor' lists the signals")
    times: dict[str, np.ndarray] = {}
    for name, signal in signals.items():
        rows = len(signal.values)
        if not np.isfinite(signal.values).all():
            raise UsageError(f"{path}: {name} has values that are not finite")
        if rows == 1:  # the same for all
            continue
        reader.questions.clear()
        node = "actuator" if name in ("command", "obs", "action", "target") else "sensor"
        times[name] = reader.clock(replace(signal, meaning=replace(signal.meaning, side="")), node)[1]
        if reader.questions:
            raise UsageError(
                f"{path}: {name} has {rows} rows; their times: {'; '.join(reader.questions.values())}",
                hint=f"give it as many rows as the times t, or separate times; the file has {listed}",
            )
    of_steps = next(n for n in ("action", "target", "obs") if n in times)
    step_t, state_t = times[of_steps], times["q"]
    values = signals[of_steps].values
    new = np.flatnonzero(np.append(True, (values[1:] != values[:-1]).any(axis=1)))
    grain_s = 0.0
    if len(new) > 20 and np.median(np.diff(new)) > 1.0:  # the recorder is faster than the policy
        step_t, grain_s = step_t[new], float(np.median(np.diff(step_t)))
    if len(step_t) < 20:
        raise UsageError(f"{path} has {len(step_t)} steps of the policy, too few")
    if min(step_t[-1], state_t[-1]) - max(step_t[0], state_t[0]) < 0.5 * min(np.ptp(step_t), np.ptp(state_t)):
        raise UsageError(f"{path}: the times of positions and commands hardly overlap: they have two clocks")
    start, parts = min(step_t[0], state_t[0]), dict[str, np.ndarray]()
    for name, signal in signals.items():
        wanted = state_t if name in ("q", "dq", "quat", "gyro", "lin_vel") else step_t
        own = times.get(name, wanted[:1])
        rows = newest(own, wanted)
        if name == "target":  # a target is sent after its step
            rows = np.minimum(np.searchsorted(own, wanted - 1e-6), len(own) - 1)
        parts[name] = signal.values[rows]
    if "dq" not in parts:
        parts["dq"] = np.gradient(parts["q"], state_t, axis=0)
    if "action" in parts and parts["action"].shape[1] != len(joints):
        raise UsageError(f"{path}: action has {parts['action'].shape[1]} columns, the policy {len(joints)}")
    return Log(step_t - start, state_t - start, message_age_s=age_s, grain_s=grain_s, **parts)


def _vector(name: str) -> tuple[str, str]:
    """Return the signal without joints of a column, and its entry: ``observation[3]``, ``/imu.orientation.x``."""
    ends = [(len(name), "")] + [(m.start(), name[m.end() :].rstrip("]")) for m in re.finditer(r"[.\[/_]", name)]
    for end, entry in ends:
        parts = [part for part in re.split(r"[./]", name[:end].lower()) if part not in ("data", "values")]
        kind, usual = _OF_NAME.get(parts[-1] if parts else "", ""), not entry or entry.isdigit() or entry in _ENTRIES
        if kind and (usual or entry == "data" or (kind in ("obs", "action") and name[end] != "_")):
            return kind, entry
    return "", ""


def _take_vectors(table: Table, joints: Sequence[str]) -> dict[str, Signal]:
    """Return the signals without joints, and remove their columns from the table."""
    columns: dict[str, dict[str, str]] = {}
    for name in list(table.columns):
        kind, entry = _vector(name)
        if kind and np.ndim(table.columns[name]) in (1, 2) and entry not in columns.get(kind, {}):
            columns.setdefault(kind, {})[entry] = name
    found = {}
    for kind, named in columns.items():
        entries = [""] if "" in named else list(named)
        if all(e.isdigit() or e in _ENTRIES for e in entries):
            entries.sort(key=lambda e: _ENTRIES.index(e) if e in _ENTRIES else int(e))
        elif kind == "action" and (order := columns_of(joints, [meaning(e).label for e in entries])):
            entries = [entries[i] for i in order[0]]
        taken = [table.columns[named[e]].astype(float) for e in entries]
        values = np.concatenate([v if v.ndim == 2 else v[:, None] for v in taken], axis=1)
        names = tuple(named[e] for e in entries)
        unit = meaning(names[0])
        found[kind] = Signal(names, ("",) * values.shape[1], unit, values * in_si(unit.unit)[0])
        for name in named.values():
            del table.columns[name]
    return found


def _of_joints(signals: Sequence[Signal], joints: Sequence[str], robot: Sequence[str], drive: str) -> dict[str, Signal]:
    """Return positions, velocities and targets in the contract's order; columns without names have the robot's."""
    quantities = {"q": ("position",), "dq": ("velocity",), "target": ("position", "", "torque")}
    if drive == "torque":
        quantities["target"] = ("torque", "position", "")
    found: dict[str, Signal] = {}
    for kind, wanted in quantities.items():
        own = [s for quantity in wanted for s in signals if s.meaning.quantity == quantity and s.values.ndim == 2
               and (s.meaning.side == "command") == (kind == "target")]  # fmt: skip
        for s in own:
            numbered = {re.sub(r"_?\d+$", "", label) for label in s.labels}
            if any(s.labels) and (len(numbered) > 1 or s.width == 1 < len(joints)):
                places = columns_of(joints, s.labels)
            else:
                by_name = {name: i for i, name in enumerate(robot)}
                places = s.width == len(robot) and ([by_name[j] for j in joints], "")
            if places:
                factor, unit = in_si(s.meaning.unit)
                if unit not in ("", "rad", "m", "s"):
                    raise UsageError(f"{s.name} is in {s.meaning.unit}: the doctor reads radians, degrees and metres")
                found[kind] = replace(s.taken(places[0]), values=s.values[:, places[0]] * factor)
                break
        else:
            if wide := [s for s in own if s.width > 1 or len(joints) == 1]:
                named = ", ".join(filter(None, wide[0].labels)) or "without names"
                raise UsageError(
                    f"{wide[0].name} has {wide[0].width} columns, {named}; the contract's joints: {', '.join(joints)}",
                    hint=f"name the columns, such as q.{joints[0]}",
                )
    return found


def _own_table(path: Path) -> tuple[Table, np.ndarray | None]:
    """Return the outputs of a log of this project as a table, and the ages of the agent's observations."""
    from sim2real.log.reader import read_log

    episode, age_s = read_log(path), None
    table, joints = Table(path, "sim2real"), episode.metadata.get("joints", [])
    for node, output in episode.outputs.items():
        if node in ("world", "truth"):
            continue
        agent, commands = node == "agent", node in ("agent", "actuator")
        topic, steps = f"/{node}_cmd" if node == "actuator" else f"/{node}", episode.steps[node]
        table.add(f"{topic}.stamp_us", steps.end if commands else np.rint(1e6 * steps.begun_s).astype(np.int64))
        for leaf, field_values in output.items():
            values = np.asarray(field_values, float)
            if values.ndim < 3 and not (agent and _vector(leaf)[0] not in ("action", "obs", "command")):
                table.add(f"{topic}.{leaf}", values if values.ndim > 1 else values[:, None])
                if values.shape[1:] == (len(joints),):
                    table.names[f"{topic}.{leaf}"] = list(joints)
    for (node, source), messages in episode.messages.items():
        if source == "sensor" and node in ("agent", "policy") and len(messages):
            begun, ended = episode.steps[node].begun_s, episode.steps[source].begun_s
            ok = (messages.seq_in >= 0) & (messages.seq_in < len(begun)) & (messages.seq_out < len(ended))
            age_s = begun[messages.seq_in[ok]] - ended[messages.seq_out[ok]]
    return table, age_s
