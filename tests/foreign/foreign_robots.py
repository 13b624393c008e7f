"""Logs of robots that nobody here has seen, with the truth about them: order, signs, units, delay, positions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sim2real.log.importing.importer import import_table
from sim2real.log.importing.propose import ImportHints, propose
from sim2real.log.importing.readers import open_tables

KINDS = ("sine", "triangle", "chirp", "gait", "multisine", "jerk", "stairs")
STYLES = {
    "plain": ("q_{0}{1}", "goal_{0}{1}"),
    "last": ("{0}_pos{1}", "{0}_cmd{1}"),
    "dots": ("state.{0}.position{1}", "command.{0}.position{1}"),
    "square": ("{0} position{1}", "{0} target{1}"),
}
SUFFIX = {"rad": "_rad", "deg": "_deg", "rev": "_turns", "counts": "_ticks", "percent": "_percent"}
VENDOR = ("FR_0", "FR_1", "FR_2", "FL_0", "FL_1", "FL_2")
MODEL = tuple(f"{leg}_{part}_joint" for leg in ("FL", "FR") for part in ("hip", "thigh", "calf"))


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


def proposed(path, **asked):
    """Return the proposed mapping of a file, which may have open questions."""
    (table,) = open_tables(path)
    return propose(table, ImportHints("x", **asked))


def imported(path, **asked):
    """Return the episode that a file becomes without a mapping, and the proposal; no question may be open."""
    (table,) = open_tables(path)
    found = propose(table, ImportHints("x", **asked))
    assert found.questions == {}
    return import_table(table, found.mapping), found


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
    if kind in ("jerk", "stairs"):
        levels, dwell = rng.uniform(-0.5, 0.5, 40), rng.uniform(0.5, 1.5)

        def between(t):
            """From one level to the next in 60 % of a dwell: a minimum-jerk motion, or a fast one."""
            k = np.clip(np.floor(t / dwell).astype(int), 0, 38)
            share = np.clip((t / dwell - k) / (0.6 if kind == "jerk" else 0.08), 0, 1)
            smooth = share**3 * (10 - 15 * share + 6 * share**2)
            return np.where(t < 0, levels[0], levels[k] + (levels[k + 1] - levels[k]) * smooth)

        return between
    tones, phases = rng.uniform(0.1, 2.5, 8), rng.uniform(0, 2 * np.pi, 8)
    return lambda t: 0.13 * np.sin(2 * np.pi * np.multiply.outer(t, tones) + phases).sum(axis=-1)


@dataclass
class Log:
    """A log as columns, and the truth about it.

    Attributes:
        columns: Name -> values; what goes into the file.
        kind: What moved the joints.
        joints: Their names, in the order in which they must be imported.
        asked: Joints of the robot, if they are known.
        sign: Of positions over commands, of each joint.
        units: Unit of the positions and of the goals.
        late_s: Delay [s].
        position: Shape ``(N, joints)`` [rad], in the order of the joints.
        goal: Shape ``(N, joints)`` [rad], with the sign that makes the position follow.
        dropped: Samples that must not be imported.
        range_rad: Angle of 100 percent [rad].
        places: Column of each joint in arrays of commands without names.
        marks: What else is odd about it.
    """

    kind: str
    late_s: float
    period_s: float
    columns: dict = field(default_factory=dict)
    joints: tuple = ()
    asked: tuple = ()
    sign: np.ndarray = field(default_factory=lambda: np.zeros(0))
    units: tuple = ()
    named: bool = True
    position: np.ndarray = field(default_factory=lambda: np.zeros(0))
    goal: np.ndarray = field(default_factory=lambda: np.zeros(0))
    dropped: set = field(default_factory=set)
    range_rad: float = 0.0
    places: tuple = ()
    marks: list = field(default_factory=list)


def draw(seed):
    """Return a random log."""
    rng = np.random.default_rng(seed)
    kind, n = KINDS[seed % len(KINDS)], int(rng.integers(1, 6))
    vendor = rng.random() < 0.1
    n = len(VENDOR) if vendor else n
    log = Log(kind, rng.uniform(0, 0.3), 1 / rng.choice([30.0, 50.0, 100.0, 200.0, 333.0]))
    t = log.period_s * np.arange(int(rng.uniform(8, 16) / log.period_s))
    shared = wave(kind, rng)
    waves = [shared if kind == "gait" or rng.random() < 0.2 else wave(kind, rng) for _ in range(n)]
    apart = rng.uniform(0, 0.5, n) if kind == "gait" else np.zeros(n)
    # Without a level, the sign of a tone is open.
    size, mean = rng.uniform(0.5, 1.6, n), rng.uniform(-0.6, 0.6, n) * (rng.random() < 0.7)
    held = (rng.random(n) < 0.15) & (n > 1)
    size = np.where(held, 0.0, size)
    turning = (rng.random(n) < 0.1) & ~held & (kind != "stairs")
    onward = np.where(turning, rng.choice([-1, 1], n) * rng.uniform(0.4, 1.2, n), 0.0)

    def moved(at):
        return np.stack([size[i] * waves[i](at - apart[i]) + mean[i] + onward[i] * at for i in range(n)], axis=1)

    log.sign = np.where(rng.random(n) < 0.3, -1.0, 1.0)
    log.goal = moved(t)
    log.position = moved(t - log.late_s) + rng.choice([2e-4, 1e-3, 4e-3]) * rng.standard_normal((len(t), n))
    written, commanded = log.position.copy(), log.goal * log.sign
    if turning.any():
        log.marks.append("turns")
        low = rng.choice([-np.pi, 0.0])
        for x in (written, commanded):
            x[:, turning] = (x[:, turning] - low) % (2 * np.pi) + low
    _spoil(log, written, rng)
    log.columns["t_s"] = t
    _write(log, written, commanded, vendor, rng)
    return log


def _spoil(log, written, rng):
    """Put glitches and missing numbers into what was measured."""
    n, joints = written.shape
    if rng.random() < 0.2:
        rows, value, i = rng.choice(np.arange(5, n - 5), 4, replace=False), -np.pi, int(rng.integers(joints))
        # On a circle, what is close to half a turn on either side is no glitch.
        rows = [k for k in rows if np.abs((written[k, i] - value + np.pi) % (2 * np.pi) - np.pi) > 1.5]
        written[rows, i] = value
        log.dropped |= {int(k) for k in rows}
        log.marks.append("glitches")
    if rng.random() < 0.2:
        rows = rng.choice(n, 5, replace=False)
        written[rows, rng.integers(joints)] = np.nan
        log.dropped |= {int(k) for k in rows}
        log.marks.append("missing")


def _write(log, written, commanded, vendor, rng):
    n = written.shape[1]
    odd = rng.random() < 0.3
    log.units = tuple(rng.choice(["rev", "counts", "percent"] if odd else ["rad", "deg"], 2))
    log.units = log.units if rng.random() < 0.3 else (log.units[0],) * 2
    told = [bool(rng.random() < 0.6) for _ in range(2)]
    log.range_rad = range_rad = rng.uniform(1.2, 3.0)
    per_rad = {"rad": 1, "deg": 180 / np.pi, "rev": 0.5 / np.pi, "counts": 2048 / np.pi, "percent": 100 / range_rad}
    written, commanded = (x * per_rad[u] for x, u in zip((written, commanded), log.units, strict=True))
    written, commanded = (
        np.round(x) if u == "counts" else x for x, u in zip((written, commanded), log.units, strict=True)
    )
    suffix = [SUFFIX[u] if say else "" for u, say in zip(log.units, told, strict=True)]
    order = rng.permutation(n)
    log.named = bool(vendor or rng.random() < 0.6)
    if log.named:
        names = list(VENDOR) if vendor else [f"j{'abcdefgh'[i]}" for i in range(n)]
        q, goal = STYLES[str(rng.choice(list(STYLES)))]
        log.columns |= {goal.format(names[i], suffix[1]): commanded[:, i] for i in order}
        log.columns |= {q.format(names[i], suffix[0]): written[:, i] for i in range(n)}
        if vendor:
            places = [VENDOR.index(f"{leg}_{k}") for leg in ("FL", "FR") for k in range(3)]
            log.asked, log.joints = MODEL, MODEL
            log.position, log.goal, log.sign = log.position[:, places], log.goal[:, places], log.sign[places]
        else:
            log.joints = tuple(names)
    else:
        # The program that wrote them did so in one order, or, rarely, in two.
        order = order if rng.random() < 0.5 else np.arange(n)
        log.columns |= {f"goal{suffix[1]}": commanded[:, order], f"q{suffix[0]}": written}
        log.places = tuple(np.argsort(order).tolist())
        log.joints = tuple(map(str, range(n)))
    if rng.random() < 0.2:
        log.columns["effort" if not log.named else "effort_ja"] = np.full(len(written), np.nan)
    if rng.random() < 0.2:
        log.columns["kd"] = np.zeros(len(written))


def save(log, folder, text=True):
    """Write a log as CSV where its columns are single ones and text is wanted, else as npz, and return the path."""
    if not log.named or not text:
        np.savez(folder / "log.npz", **log.columns)
        return folder / "log.npz"
    rows = np.column_stack(list(log.columns.values()))
    np.savetxt(folder / "log.csv", rows, delimiter=",", header=",".join(log.columns), comments="", fmt="%.7f")
    return folder / "log.csv"


def faults(log, episode, found):
    """Return what is wrong about an import without a word; an empty list if it is right."""
    wrong = []
    kept = np.setdiff1d(np.arange(len(log.position)), sorted(log.dropped))
    position, goal = episode.outputs["sensor"]["position"], episode.outputs["actuator"].get("goal")
    if goal is None:
        return [f"goals are {list(episode.outputs['actuator'])}"]
    if len(position) != len(kept):
        return [f"{len(position)} samples for {len(kept)}"]
    off = position - log.position[kept]
    off -= 2 * np.pi * np.round(np.median(off, axis=0) / (2 * np.pi))
    if np.abs(off).max() > (2e-3 if "counts" in log.units else 1e-3):
        wrong.append(f"positions off by {np.abs(off).max():.3g} rad")
    for i, joint in enumerate(log.joints):
        unproven = any(joint in line and "not checked" in line for line in found.evidence)
        off = goal[:, i] - log.goal[:, i]
        off -= 2 * np.pi * np.round(np.median(off) / (2 * np.pi))
        if np.abs(off).max() > 2e-3 and not unproven:
            wrong.append(f"goal of {joint} off by {np.abs(off).max():.3g} rad")
    return wrong
