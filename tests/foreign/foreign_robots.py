"""Logs of robots that nobody here has seen, with what is right about them: signs, orders, units, delay, positions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sim2real.log.importing.files.foreign import open_foreign
from sim2real.log.importing.importer import import_opened
from sim2real.log.importing.proposal import propose
from sim2real.log.importing.quantities import ImportHints

KINDS = ("sine", "triangle", "chirp", "gait", "multisine")


def servo(t, goal, late_s=0.02, wn=25.0, damping=0.9):
    """Return the position of a servo of second order, which follows a goal ``late_s`` later; 86 ms in all."""
    dt, q, x, v = t[1] - t[0], np.zeros_like(goal), goal[0], 0.0
    for k in range(len(t)):
        u = goal[max(k - round(late_s / dt), 0)]
        for _ in range(5):
            v += (wn * wn * (u - x) - 2 * damping * wn * v) * dt / 5
            x += v * dt / 5
        q[k] = x
    return q


def motion(seconds=10.0, dt=0.005, joints=2):
    """Return stamps [s], goals of ten tones, and positions [rad] that follow them 95 ms later."""
    t = dt * np.arange(round(seconds / dt))
    rng = np.random.default_rng(1)
    tones, phases = rng.uniform(0.1, 2.0, (joints, 10)), rng.uniform(0, 2 * np.pi, (joints, 10))
    goal = np.stack(
        [0.12 * np.sin(2 * np.pi * np.outer(t, w) + p).sum(axis=1) for w, p in zip(tones, phases, strict=True)], 1
    )
    return t, goal, np.stack([servo(t, column) for column in goal.T], axis=1)


def csv(path, columns, end=""):
    """Write columns, numbers or words, by name, and return the path."""
    rows = zip(*(c if isinstance(c, list) else [f"{x:.6f}" for x in c] for c in columns.values()), strict=True)
    path.write_text("\n".join([",".join(columns), *(",".join(row) + end for row in rows)]) + "\n")
    return path


def imported(path, **asked):
    """Return the episode that a file becomes without a mapping, and the proposal."""
    file = open_foreign(path)
    found = propose(file, ImportHints("x", **asked))
    return import_opened(file, found.mapping), found


def goal_scales(found):
    """Return the scale of each joint's goal."""
    own = found.mapping.nodes["actuator"].fields["goal"]
    return np.broadcast_to(own.scale, (len(found.joints),))


def wave(kind, rng):
    """Return a motion of one joint as a function of time [s], of about 1 rad from end to end."""
    f, phase = rng.uniform(0.3, 3.0), rng.uniform(0, 2 * np.pi)
    if kind == "sine":
        return lambda t: 0.5 * np.sin(2 * np.pi * f * t + phase)
    if kind == "triangle":
        return lambda t: np.arcsin(np.sin(2 * np.pi * f * t + phase)) / np.pi
    if kind == "chirp":
        end, over_s = rng.uniform(2, 5), rng.uniform(6, 20)
        return lambda t: 0.4 * np.sin(phase + 2 * np.pi * (0.1 * t + 0.5 * (end - 0.1) / over_s * np.maximum(t, 0) * t))
    if kind == "gait":
        second, at = rng.uniform(0.1, 0.5), rng.uniform(0, 2 * np.pi)
        return lambda t: 0.4 * (np.sin(2 * np.pi * f * t + phase) + second * np.sin(4 * np.pi * f * t + at))
    tones, phases = rng.uniform(0.1, 2.5, 8), rng.uniform(0, 2 * np.pi, 8)
    return lambda t: 0.13 * np.sin(2 * np.pi * np.multiply.outer(t, tones) + phases).sum(axis=-1)


@dataclass
class Log:
    """A log as columns, and the truth about it.

    Attributes:
        columns: Name -> values, or texts; what goes into the file.
        kind: What moved the joints.
        joints: Their names, in the order of the measured columns.
        sign: Of positions over commands, of each joint.
        goals: Of each joint: the goal's source in the file.
        units: Unit of the positions and of the goals.
        named: Whether columns have names of joints.
        late_s: Delay [s].
        period_s: Time between samples [s].
        position: Shape ``(N, joints)`` [rad].
        dropped: Samples that must not be imported.
        marks: What else is odd about it.
    """

    columns: dict
    kind: str
    joints: tuple
    sign: np.ndarray
    goals: list
    units: tuple
    named: bool
    late_s: float
    period_s: float
    position: np.ndarray
    dropped: set = field(default_factory=set)
    marks: list = field(default_factory=list)


def draw(seed):
    """Return a random log."""
    rng = np.random.default_rng(seed)
    kind, n = KINDS[seed % len(KINDS)], int(rng.integers(1, 6))
    period_s, late_s = 1 / rng.choice([30.0, 50.0, 100.0, 200.0, 333.0]), rng.uniform(0, 0.3)
    t = period_s * np.arange(int(rng.uniform(8, 16) / period_s))
    shared = wave(kind, rng)
    waves = [shared if kind == "gait" or rng.random() < 0.2 else wave(kind, rng) for _ in range(n)]
    apart = rng.uniform(0, 0.5, n) if kind == "gait" else np.zeros(n)
    # Without a level, the sign of a tone is open; the first thousand logs have levels.
    size, mean = rng.uniform(0.5, 1.6, n), rng.uniform(-0.6, 0.6, n) * (seed < 1000 or rng.random() < 0.5)
    turning = rng.random(n) < 0.15
    onward = np.where(turning, rng.choice([-1, 1], n) * rng.uniform(0.4, 1.2, n), 0.0)

    def motion(at):
        return np.stack([size[i] * waves[i](at - apart[i]) + mean[i] + onward[i] * at for i in range(n)], axis=1)

    sign = np.where(rng.random(n) < 0.3, -1.0, 1.0)
    goal, q = motion(t), motion(t - late_s) + rng.choice([2e-4, 1e-3, 4e-3]) * rng.standard_normal((len(t), n))
    log = Log({"t_s": t}, kind, (), sign, [], (), True, late_s, period_s, q)
    log.position = q
    written, commanded = q.copy(), goal * sign
    if turning.any():
        log.marks.append("turns")
        low = rng.choice([-np.pi, 0.0])
        written[:, turning], commanded[:, turning] = (
            (x[:, turning] - low) % (2 * np.pi) + low for x in (written, commanded)
        )
    _spoil(log, written, rng)
    _write(log, written, commanded, rng)
    return log


def _spoil(log, written, rng):
    """Put glitches and missing numbers into what was measured."""
    n, joints = written.shape
    if rng.random() < 0.3:
        rows = rng.choice(np.arange(5, n - 5), 4, replace=False)
        value, i = -np.pi, int(rng.integers(joints))
        # On a circle, what is close to half a turn on either side is no glitch.
        rows = [k for k in rows if np.abs((written[k, i] - value + np.pi) % (2 * np.pi) - np.pi) > 1.5]
        written[rows, i] = value
        log.dropped |= {int(k) for k in rows}
        log.marks.append("glitches")
    if rng.random() < 0.3:
        rows = rng.choice(n, 5, replace=False)
        written[rows, rng.integers(joints)] = np.nan
        log.dropped |= {int(k) for k in rows}
        log.marks.append("missing")


def _write(log, written, commanded, rng):
    n = written.shape[1]
    log.units = tuple(rng.choice(["rad", "deg"], 2))
    told = [rng.random() < 0.6 for _ in range(2)]
    written, commanded = (
        np.degrees(x) if u == "deg" else x for x, u in zip((written, commanded), log.units, strict=True)
    )
    suffix = [f"_{u}" if say else "" for u, say in zip(log.units, told, strict=True)]
    names, log.named = [f"j{'abcdefgh'[i]}" for i in range(n)], bool(rng.random() < 0.6)
    order = rng.permutation(n)
    if log.named:
        log.columns |= {f"goal_{names[i]}{suffix[1]}": commanded[:, i] for i in order}
        log.columns |= {f"q_{names[i]}{suffix[0]}": written[:, i] for i in range(n)}
        log.goals = [f"goal_{names[i]}{suffix[1]}" for i in range(n)]
    else:
        log.columns |= {f"goal{suffix[1]}": commanded[:, order], f"q{suffix[0]}": written}
        place = {int(i): k for k, i in enumerate(order)}
        log.goals = [f"goal{suffix[1]}[:,{place[i]}]" for i in range(n)]
    log.joints = tuple(names) if log.named else tuple(map(str, range(n)))
    if rng.random() < 0.3:
        log.columns["effort" if not log.named else f"effort_{names[0]}"] = np.full(len(written), np.nan)
        log.marks.append("empty column")
    if rng.random() < 0.2:
        log.columns["kd"] = np.zeros(len(written))
        log.marks.append("kd 0")


def save(log, folder):
    """Write a log as CSV where its columns are single ones, else as npz, and return the path."""
    if not log.named:
        np.savez(folder / "log.npz", **log.columns)
        return folder / "log.npz"
    rows = np.column_stack(list(log.columns.values()))
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=",".join(log.columns), comments="", fmt="%.7f")
    return folder / "log.csv"
