"""Checks whether the data of an import agree with its mapping. They choose nothing: they confirm, ask or refuse.

Goals and measured positions in one unit are compared joint by joint: order, sign, lag, slope, copies, zeros, clocks.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim2real.graph.episode import Episode
from sim2real.later import Later
from sim2real.leaps import reach_rad
from sim2real.log.importing.names import meaning

ndimage = Later("scipy.ndimage")
TURN_RAD = 2.0 * np.pi
_MAX_ROWS = 6000
"""Compared rows; a longer recording is thinned."""
_FINER = 4
"""Compared rows for each sample."""
_LAGS_S = (-0.3, 0.6)
_FOLLOWS_R = 0.8
"""A position follows a command from this correlation on."""
_SLOPES = (0.5, 1.6)
"""A servo follows its goal with such a slope; another one means another unit or scale."""
_STILL = 2e-3
"""A joint with a smaller standard deviation does not move [rad or m]."""
_MOST_STEPS = 4
"""A zero that moves more often is no zero."""
_FASTEST_RAD_S = 60.0
"""Highest speed of a joint; a faster step is no motion."""


@dataclass(frozen=True)
class Finding:
    """A sentence on the data of one joint, or of all.

    Attributes:
        kind: ``order``, ``sign``, ``slope``, ``lag``, ``copy``, ``clock``, ``zero``, ``rate``, ``scale``, ``still`` or
            ``follows``.
        joint: Number of the joint; -1 for all.
        weight: ``refuse``: data and mapping contradict each other; ``ask``: the data fit several mappings;
            ``warn``: true, and to be known; ``note``: evidence.
    """

    kind: str
    joint: int
    text: str
    weight: Literal["refuse", "ask", "warn", "note"]


@dataclass(frozen=True)
class Response:
    """How positions follow commands at each lag.

    Attributes:
        lag_s: Shape ``(L,)`` [s].
        r: Shape ``(L, joints, commands)``: correlation.
        slope: Shape ``(L, joints, commands)``: of positions over commands.
        misfit: Shape ``(2, L, joints, commands)``: error of the command, and of its opposite, over the spread.
        moves: Shape ``(joints,)``: whether position and command of the same number move.
        period_s: Time between samples of the faster side [s].
    """

    lag_s: np.ndarray
    r: np.ndarray
    slope: np.ndarray
    misfit: np.ndarray
    moves: np.ndarray
    period_s: float

    def best(
        self, joint: int, command: int, sign: float, begin_s: float | None = None
    ) -> tuple[float, float, float, float]:
        """Return correlation, lag [s], slope and misfit of the best lag with a sign of the correlation."""
        rows = np.flatnonzero(self.lag_s >= (-1.5 * self.period_s if begin_s is None else begin_s))
        k = rows[np.argmax(sign * self.r[rows, joint, command])]
        misfit = float(self.misfit[0 if sign > 0 else 1, rows, joint, command].min())
        return float(self.r[k, joint, command]), float(self.lag_s[k]), float(self.slope[k, joint, command]), misfit


def respond(
    t_s: tuple[np.ndarray, np.ndarray], command: np.ndarray, position: np.ndarray, acting: np.ndarray | None = None
) -> Response | None:
    """Compare commands and positions on one grid of time; None if they overlap in fewer than 50 samples.

    Args:
        t_s: Stamps of commands ``(N,)`` and of positions ``(M,)`` [s].
        command: Shape ``(N, commands)``.
        position: Shape ``(M, joints)``.
        acting: Shape ``(N,)``: whether commands act; None: all do.
    """
    # Finer than the samples, as a fast tone turns its sign within two of them.
    grid, held, joined, live = _on_grid(t_s, command, position, acting, _FINER)
    if len(grid) < 2 or live.sum() * (grid[1] - grid[0]) < 50 * (
        sample_s := min(float(np.median(np.diff(t))) for t in t_s)
    ):
        return None
    period_s = float(grid[1] - grid[0])
    lags = np.arange(round(_LAGS_S[0] / period_s), round(_LAGS_S[1] / period_s) + 1)
    least = round(50 * sample_s / period_s)
    lags = lags[np.abs(lags) < len(grid) - least]
    # At a lag, sum over the rows at which both the command then and the position now are known: by FFT, for all lags.
    centre = [x[live].mean(axis=0) for x in (held, joined)]  # for the precision of the sums
    c, q = (np.where(live[:, None], x - m, 0.0) for x, m in zip((held, joined), centre, strict=True))
    size = 1 << (2 * len(grid) - 1).bit_length()
    ones, x, xx, y, yy = (np.fft.rfft(v, size, axis=0) for v in (live[:, None].astype(float), c, c * c, q, q * q))

    def sums(now: np.ndarray, then: np.ndarray) -> np.ndarray:
        return np.fft.irfft(now * np.conj(then), size, axis=0)[lags]

    count = np.maximum(sums(ones, ones), 1.0)
    mx, vx = sums(ones, x) / count, sums(ones, xx) / count
    my, vy = sums(y, ones) / count, sums(yy, ones) / count
    vx, vy = np.maximum(vx - mx**2, 1e-18), np.maximum(vy - my**2, 1e-18)
    both = np.stack([sums(y[:, j : j + 1], x) for j in range(q.shape[1])], axis=1)
    cov = both / count[:, :, None] - my[:, :, None] * mx[:, None, :]
    slope = cov / vx[:, None, :]
    r = cov / np.sqrt(vx[:, None, :] * vy[:, :, None])
    r[count[:, 0] < least] = 0.0
    level = [(my + centre[1])[:, :, None] - sign * (mx + centre[0])[:, None, :] for sign in (1.0, -1.0)]
    square = [
        vy[:, :, None] + vx[:, None, :] - 2 * sign * cov + at**2 for sign, at in zip((1.0, -1.0), level, strict=True)
    ]
    misfit = np.sqrt(np.maximum(np.stack(square), 0.0) / vy[:, :, None])
    both = min(q.shape[1], c.shape[1])
    moves = (q[live].std(axis=0) > _STILL)[:both] & (c[live].std(axis=0) > _STILL)[:both]
    return Response(lags * period_s, r, slope, misfit, moves, sample_s)


def check(
    t_s: tuple[np.ndarray, np.ndarray],
    goal: np.ndarray,
    position: np.ndarray,
    names: Sequence[str],
    by_name: bool = True,
    acting: np.ndarray | None = None,
) -> list[Finding]:
    """Compare goals and positions of the same joints in one unit.

    Args:
        t_s: Stamps of goals ``(N,)`` and of positions ``(M,)`` [s].
        goal: Shape ``(N, joints)`` [rad or m].
        position: Shape ``(M, joints)``, in the same unit.
        names: Names of the joints.
        by_name: Whether names say which goal belongs to which position; else their order does, which must be evident.
        acting: Shape ``(N,)``: whether goals act; None: all do.
    """
    found = respond(t_s, goal, position, acting)
    if found is None:
        return [
            Finding("still", -1, "goals and positions overlap in fewer than 50 samples: nothing is checked", "refuse")
        ]
    findings: list[Finding] = []
    moving = np.flatnonzero(found.moves)
    copies = copied(*t_s, goal, position)
    lags: dict[int, float] = {}
    for i in range(len(names)):
        if copies[i]:
            text = f"{names[i]}: its goals are copies of its measurements, so they hold no information on the drive"
            findings.append(Finding("copy", i, text, "refuse"))
        elif i not in moving:
            findings.append(_held(i, names[i], goal[:, i], position[:, i]))
        else:
            own, lag_s = _own(found, i, names, by_name)
            findings += own
            if lag_s is not None:
                lags[i] = lag_s
    following = [i for i in lags if not copies[i]]
    clock = _clock(t_s, goal, position, following or moving.tolist(), acting)
    if any(f.weight == "refuse" for f in clock):
        findings = [f for f in findings if f.kind not in ("follows", "lag")]
    elif moving.size and not lags and not any(f.weight in ("refuse", "ask") for f in findings):
        text = "no position follows its goal: units, signs, order and clocks are unproven"
        findings.append(Finding("follows", -1, text, "ask"))
    findings += clock
    if following:
        late = ", ".join(f"{names[i]} {1e3 * lags[i]:.0f} ms" for i in following[:6])
        text = f"positions follow their goals: {late}" + " ..." * (len(following) > 6)
        findings.append(Finding("follows", -1, text, "note"))
    for i in moving.tolist() if not any(f.weight == "refuse" for f in findings) else ():
        findings += _zero(t_s, goal[:, i], position[:, i], i, names[i], lags.get(i)) if not copies[i] else []
    if moving.size:
        findings += _rates(t_s, goal, position, moving.tolist())
    return findings + _scales(position, names)


def check_episode(episode: Episode, joints: Sequence[str] = (), by_name: bool = True) -> list[Finding]:
    """Compare the goals and positions of an imported episode; see ``check``."""
    sensed, commands = episode.outputs.get("sensor", {}), episode.outputs.get("actuator", {})
    units = {**episode.units.get("actuator", {}), **episode.units.get("sensor", {})}
    enabled = [values for name, values in commands.items() if meaning(name).quantity == "enabled"]
    acting = np.asarray((enabled[0].reshape(len(enabled[0]), -1) > 0).all(axis=1)) if len(enabled) == 1 else None
    findings: list[Finding] = []
    for name, position in sensed.items():
        for goal, values in commands.items():
            pair = meaning(name).quantity == "position" and meaning(goal).side == "command"
            if not (pair and meaning(goal).quantity in ("", "position") and units.get(goal) == units.get(name)):
                continue
            flat = values.reshape(len(values), -1), position.reshape(len(position), -1)
            if flat[0].shape[1] == flat[1].shape[1]:
                names = joints if len(joints) == flat[1].shape[1] else [f"joint {i}" for i in range(flat[1].shape[1])]
                t_s = episode.steps["actuator"].begun_s, episode.steps["sensor"].begun_s
                findings += check(t_s, *flat, names, by_name, acting)
    return findings


_HINTS = {
    "sign": "change the sign of that joint's scale, such as scale = [1, -1]",
    "order": "list the sources in the order of the positions",
    "copy": "log the commands that were sent, not the measurements",
    "clock": "stamp both streams with one clock, such as a recorder's",
    "zero": "cut the file where the zero moves: --samples A:B",
    "scale": "name the other joints with --joints, or give the column its own scale in a mapping",
    "slope": "correct the unit, or name the other joints with --joints",
    "lag": "exchange the names, or correct stamp_offset",
}


def hint_for(findings: Sequence[Finding]) -> str:
    """Return what to do about findings that refuse an import."""
    hints = dict.fromkeys(_HINTS.get(f.kind, "correct the mapping") for f in findings)
    return "; ".join(hints) + "; --as-told imports it all the same"


def is_rate(t_s: np.ndarray, angle: np.ndarray, velocity: np.ndarray) -> bool:
    """Return whether velocities ``(N, joints)`` are the rate of angles, in the same unit."""
    rows = np.isfinite(angle).all(axis=1) & np.isfinite(velocity).all(axis=1) & np.isfinite(t_s)
    if rows.sum() < 50 or (np.diff(t_s[rows]) <= 0).any():
        return False
    rate = np.gradient(angle[rows], t_s[rows], axis=0)
    rate, v = (ndimage.uniform_filter1d(x, 5, axis=0)[3:-3] for x in (rate, velocity[rows]))
    moving = v.std(axis=0) > 1e-9
    x, y = v[:, moving].ravel(), rate[:, moving].ravel()
    return bool(moving.any() and np.corrcoef(x, y)[0, 1] > 0.8 and 0.8 < (x @ y) / (x @ x) < 1.25)


def _own(found: Response, i: int, names: Sequence[str], by_name: bool) -> tuple[list[Finding], float | None]:
    """Return findings on order, sign, slope and lag of a joint, and its lag [s] if it follows its own goal."""
    name, everyone = names[i], range(found.r.shape[2])
    r, lag_s, slope, misfit = found.best(i, i, 1.0)
    against, _, opposite, mirror = found.best(i, i, -1.0)
    own = max(r, -against)
    findings: list[Finding] = []
    others = []
    for j in everyone:
        if j != i and not _same(found, i, j):
            fits = [found.best(i, j, sign) for sign in (1.0, -1.0)]
            others.append((max(abs(f[0]) for f in fits), min(f[3] for f in fits), j))
    better = max(others, default=(0.0, np.inf, -1))
    if better[0] > 0.9 and own < 0.6:
        text = f"{name} follows the goal of {names[better[2]]} (r {better[0]:.2f}), not its own (r {own:.2f})"
        return [Finding("order", i, text, "refuse")], None
    if not by_name and max(own, better[0]) >= _FOLLOWS_R:
        for other, other_misfit, j in others:
            shape = 1 - other > 3 * (1 - own) + 0.02
            level = min(misfit, mirror) < 0.5 * other_misfit and other_misfit > 0.1
            if not (shape or level) or (other > own + 0.02 and not level):
                text = f"{name} follows the goals of column {i} and of column {j} alike (r {own:.2f} and {other:.2f})"
                return [Finding("order", i, text, "ask")], None
    # The sign: shape first, then level, as a tone that is half a period later is its opposite.
    if own < _FOLLOWS_R:
        lead = found.best(i, i, 1.0, _LAGS_S[0])
        if lead[0] > 0.9:
            text = (
                f"{name} moves {-1e3 * lead[1]:.0f} ms before its goal: names are exchanged, or the clocks do not agree"
            )
            return [Finding("lag", i, text, "refuse")], None
        text = f"{name} does not follow its goal (r {own:.2f} at most): sign, unit and order are not checked"
        return [Finding("follows", i, text, "warn")], None
    plus = 1 + against > 3 * (1 - r) + 0.02 or (misfit < 0.5 * mirror and mirror > 0.1 and r > _FOLLOWS_R)
    minus = 1 - r > 3 * (1 + against) + 0.02 or (mirror < 0.5 * misfit and misfit > 0.1 and -against > _FOLLOWS_R)
    if minus and not plus:
        text = f"{name} moves against its goal (r {against:.2f}, slope {opposite:.3g}): a sign of scale is wrong"
        return [Finding("sign", i, text, "refuse")], None
    if not plus or minus:
        text = f"{name} fits its goal with either sign (r {r:.2f} and {against:.2f}): the motion repeats"
        findings.append(Finding("sign", i, text, "ask"))
    if not _SLOPES[0] < slope < _SLOPES[1] and not findings:
        # A weak servo stays far behind its goal, but no servo goes far beyond it.
        text = f"{name} follows its goal (r {r:.2f}) with a slope of {slope:.3g}: unit or scale of one of them is wrong"
        return [Finding("slope", i, text, "ask" if 0.15 < slope < 4.0 else "refuse")], None
    lead = found.best(i, i, 1.0, _LAGS_S[0])
    if lead[1] < -1.5 * found.period_s and 1 - r > 3 * (1 - lead[0]) + 0.005:
        text = f"{name} moves {-1e3 * lead[1]:.0f} ms before its goal: names are exchanged, or the clocks do not agree"
        return [Finding("lag", i, text, "refuse")], None
    return findings, None if findings else lag_s


def _same(found: Response, i: int, j: int) -> bool:
    """Return whether two joints have the same goals, or exactly opposite ones, which another sign could exchange."""
    same = np.abs(found.r[:, i, i] - found.r[:, i, j]).max() < 1e-6
    level = np.abs(found.misfit[:, :, i, i] - found.misfit[:, :, i, j]).max() < 1e-6
    opposite = np.abs(found.r[:, i, i] + found.r[:, i, j]).max() < 1e-6
    mirrored = np.abs(found.misfit[:, :, i, i] - found.misfit[::-1, :, i, j]).max() < 1e-6
    return bool((same and level) or (opposite and mirrored))


def _held(i: int, name: str, goal: np.ndarray, position: np.ndarray) -> Finding:
    """Return what the levels of a joint that is held show."""
    g, q = float(np.median(goal)), float(np.median(position))
    if np.ptp(goal) < 4 * _STILL and abs(g) > 0.1 and abs(q - g) > 0.5 * abs(g):
        # A weak servo sags; an opposite or far level is another sign, zero or unit.
        text = f"{name} is held at {q:.3g} by a goal of {g:.3g}: another sign, unit or zero"
        return Finding("sign" if abs(q + g) < 0.3 * abs(g) else "slope", i, text, "ask")
    return Finding("still", i, f"{name} hardly moves: sign, order and unit are not checked", "warn")


def _clock(
    t_s: tuple[np.ndarray, np.ndarray],
    goal: np.ndarray,
    position: np.ndarray,
    joints: Sequence[int],
    acting: np.ndarray | None,
) -> list[Finding]:
    """Return a finding if the lag grows: two clocks run at different rates."""
    begin, end = max(t[0] for t in t_s), min(t[-1] for t in t_s)
    count = min(10, int((end - begin) / 3.0))
    if count < 4 or not joints:
        return []
    edges = np.linspace(begin, end, count + 1)
    middles, lags = [], []
    for low, high in itertools.pairwise(edges.tolist()):
        rows = [
            np.flatnonzero((t >= a) & (t <= b)) for t, a, b in ((t_s[0], low - 1.0, high + 1.0), (t_s[1], low, high))
        ]
        if min(map(len, rows)) < 60:
            continue
        c, q = goal[rows[0]][:, joints], position[rows[1]][:, joints]
        part = respond((t_s[0][rows[0]], t_s[1][rows[1]]), c, q, None if acting is None else acting[rows[0]])
        if part is None:
            continue
        own = [part.best(k, k, 1.0, _LAGS_S[0])[:2] for k in range(len(joints)) if part.moves[k]]
        own = [lag for r, lag in own if r > 0.9]
        if own:
            middles.append(0.5 * (low + high))
            lags.append(float(np.median(own)))
    if len(lags) < 4:
        return []
    rate, start = np.polyfit(middles, lags, 1)
    rest = np.asarray(lags) - (rate * np.asarray(middles) + start)
    grown = rate * (end - begin)
    period_s = max(float(np.median(np.diff(t))) for t in t_s)
    if abs(grown) < max(0.02, 2.5 * period_s) or rest.std() > 0.15 * abs(rate) * np.ptp(middles):
        return []
    text = (
        f"the lag of positions behind goals grows by {1e3 * rate:.1f} ms each second ({1e3 * grown:.0f} ms in all): "
        "the clocks of the two streams run at different rates"
    )
    # The lag of a servo also changes with the frequency of a sweep, by less.
    return [Finding("clock", -1, text, "refuse" if abs(grown) > 0.15 else "warn")]


def _zero(
    t_s: tuple[np.ndarray, np.ndarray], goal: np.ndarray, position: np.ndarray, i: int, name: str, lag_s: float | None
) -> list[Finding]:
    """Return findings on a zero that steps, or an offset between goal and position.

    Args:
        lag_s: By how much the position follows its goal [s]; None if it does not: then only steps are looked for.
    """
    grid, held, joined, _ = _on_grid(t_s, goal[:, None], position[:, None], None)
    n, period_s = len(grid), float(grid[1] - grid[0])
    # Predict the position from the last goals; the rest shows the zero.
    span = max(1, round(((lag_s or 0.2) + 0.3) / period_s / 12))
    if n - 12 * span < 200:
        return []
    past = np.stack([held[12 * span - k * span : n - k * span, 0] for k in range(13)], axis=1)
    q, at, rows = joined[12 * span :, 0], grid[12 * span :], np.arange(n - 12 * span)

    def fitted(steps: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the sizes of the steps, and what goals and steps leave of the positions."""
        known = np.concatenate([past, rows[:, None] >= np.asarray(steps, int)[None, :]], axis=1)
        known = known - known.mean(axis=0)
        gram = known.T @ known
        gram += 1e-9 * (np.trace(gram) / len(gram) + 1e-12) * np.eye(len(gram))
        weights = np.linalg.solve(gram, known.T @ (q - q.mean()))
        return weights[13:], q - q.mean() - known @ weights

    # Add the step that explains most of the rest, up to a few: slips, or zeros that move.
    steps: list[int] = []
    _, rest = fitted(steps)
    first, edge = float(rest.std()), max(len(q) // 20, 1)
    for _ in range(_MOST_STEPS):
        total, count = np.cumsum(rest), rows + 1.0
        far = int(np.argmax((np.abs(total) / np.sqrt(count * (len(q) - count) + 1.0))[edge:-edge])) + edge + 1
        # A step of the goals can hide what follows them.
        leapt = int(np.argmax(np.abs(np.diff(past[edge:-edge, 0])))) + edge + 1
        near = {m for k in (far, leapt) for m in range(max(k - 3, 1), min(k + 4, len(q) - 1))} - {*steps}
        if not near:
            break
        left, k = min((float(fitted([*steps, m])[1].std()), m) for m in near)
        if left > 0.9 * rest.std():
            break
        steps.append(k)
        _, rest = fitted(steps)
    # A slip is several small steps, or one.
    for chosen in (steps, steps[:1]):
        sizes, rest = fitted(chosen)
        blocks = np.array([b.mean() for b in np.array_split(rest, max(8, int(np.ptp(at) / 1.0)))])
        least = max(0.03, 5.0 * float(blocks.std()))
        moved = sorted((k, float(size)) for k, size in zip(chosen, sizes, strict=True) if abs(size) > least)
        if not moved or rest.std() > 0.8 * first:
            continue
        leaps = any(abs(size) > 0.1 and 0.6 < (q[k] - q[k - 1]) / size < 1.6 for k, size in moved)
        listed = ", ".join(f"{size:+.3f} rad from {at[k] - t_s[1][0]:.2f} s on" for k, size in moved)
        text = f"{name} reads against its goal {listed}: one of them has another zero"
        return [Finding("zero", i, text, "refuse" if leaps else "warn")]
    if lag_s is None:
        return []
    shift = round(lag_s / period_s)
    error = joined[max(shift, 0) :, 0] - held[: n - max(shift, 0), 0]
    offset = float(np.median(error))
    if abs(offset) > 0.05 and abs(offset) > 2.0 * float(np.median(np.abs(error - offset))):
        text = f"{name} reads {offset:+.3f} rad against its goal on average: zeros differ, or a load pulls"
        return [Finding("zero", i, text, "ask" if abs(offset) > 1.0 else "warn")]
    return []


def _rates(
    t_s: tuple[np.ndarray, np.ndarray], goal: np.ndarray, position: np.ndarray, joints: Sequence[int]
) -> list[Finding]:
    """Return a finding if one side is sampled too slowly for the motion of the other."""
    findings = []
    for (t, _), (other, values), what, moved in (
        ((t_s[0], goal), (t_s[1], position), "goals", "positions"),
        ((t_s[1], position), (t_s[0], goal), "positions", "goals"),
    ):
        own = goal if what == "goals" else position
        rate_hz, other_hz = _rate(t, own[:, joints]), _rate(other, values[:, joints])
        if other_hz < 2.0 * rate_hz:
            continue
        grid = np.arange(other[0], other[-1], 1.0 / other_hz)
        power, total = 0.0, 0.0
        band = 0.0
        for i in joints:
            x = np.interp(grid, other, values[:, i])
            spectrum = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(len(x)))) ** 2
            f = np.fft.rfftfreq(len(x), 1.0 / other_hz)
            power, total = power + float(spectrum[f > 0.5 * rate_hz].sum()), total + float(spectrum.sum())
            band = max(band, float(f[np.searchsorted(np.cumsum(spectrum), 0.99 * spectrum.sum())]))
        if power > 0.02 * total:
            text = (
                f"{rate_hz:.3g} {what} a second are too few for {moved} with power up to {band:.3g} Hz: "
                f"between two {what} the motion is unknown, so delays and dynamics cannot be "
                f"identified; log {what} at {4 * band:.0f} Hz"
            )
            findings.append(Finding("rate", -1, text, "warn"))
    return findings


def _rate(t_s: np.ndarray, values: np.ndarray) -> float:
    """Return samples a second; of values that are repeated at equal times, as a table joins them, the new ones."""
    new = np.flatnonzero((np.diff(values, axis=0) != 0).any(axis=1)) + 1
    steps = np.diff(t_s[new]) if len(new) > 20 else np.diff(t_s)
    usual = float(np.median(steps))
    regular = len(new) > 20 and np.mean(np.abs(steps - usual) < 0.2 * usual) > 0.8
    return 1.0 / max(usual if regular else float(np.median(np.diff(t_s))), 1e-9)


def _scales(position: np.ndarray, names: Sequence[str]) -> list[Finding]:
    """Return a finding on a column that is far larger than the others and turns back, as one in another unit does."""
    most = np.abs(position).max(axis=0)
    findings = []
    for i, size in enumerate(most):
        others = np.delete(most, i)
        net = abs(position[-1, i] - position[0, i])
        if others.size and size > 1.0 and size > 8.0 * others.max() and net < 0.7 * np.ptp(position[:, i]):
            text = f"{names[i]} reads up to {size:.4g}, the other joints {others.max():.3g}: another unit or scale?"
            findings.append(Finding("scale", i, text, "refuse" if size > TURN_RAD else "warn"))
    return findings


def unsigned(values: np.ndarray) -> int | None:
    """Return the modulus (2^16, 2^32) or sign bit (2^15, 2^31) by which whole numbers jump; None if they do not.

    Signed counts that are read as unsigned jump from 0 to the modulus, or, with a sign bit, by the bit.

    Args:
        values: Shape ``(N,)``, as in the file.
    """
    if values.size < 3 or not np.isfinite(values).all() or np.any(values != np.round(values)):
        return None
    steps = np.abs(np.diff(values.astype(np.float64)))
    usual = float(np.quantile(steps, 0.5))
    for modulus in (1 << 32, 1 << 31, 1 << 16, 1 << 15):
        near = np.abs(steps - modulus) <= max(0.02 * modulus, 4 * usual)
        if near.any() and usual < 0.1 * modulus and np.abs(values).max() >= 0.98 * modulus:
            return modulus
    return None


def copied(t_goal: np.ndarray, t_position: np.ndarray, goal: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return whether goals are copies of positions up to 1 s before or after them, ``(joints,)``.

    Args:
        t_goal: Shape ``(N,)`` [s].
        t_position: Shape ``(M,)`` [s].
        goal: Shape ``(N, joints)``.
        position: Shape ``(M, joints)``, in the unit of the goals.
    """
    copies = np.zeros(position.shape[1], bool)
    if min(len(t_goal), len(t_position)) < 20:
        return copies
    newest = np.searchsorted(t_goal, t_position + 1e-6, side="right") - 1
    most = round(1.0 / max(float(np.median(np.diff(t_goal))), 1e-4))
    for i in range(position.shape[1]):
        q, c = position[:, i], goal[:, i]
        # Compare only rows in motion: resting columns are equal at every lag.
        moved = np.abs(np.diff(q, prepend=q[:1]))
        rows = np.flatnonzero(moved > 0.01 * moved.max(initial=0.0))
        if q.std() < 1e-9 or len(rows) < 20:
            continue
        exact = 1e-5 * q.std() + 1.1e-6 * np.abs(q).max()
        limit = max(exact, 0.51 * max(_step(c), _step(q)))
        # Look at a few rows at all shifts, and at all rows of the shifts at which the few are equal.
        shifts = np.arange(-most, most + 1)
        allowed = np.where(np.abs(shifts) <= 1, limit, exact)
        few = rows[:: max(len(rows) // 40, 1)]
        for some, share in ((few, 0.9), (rows, 0.98)):
            at = newest[some][:, None] + shifts
            inside = (at >= 0) & (at < len(c))
            off = np.abs(q[some][:, None] - c[np.clip(at, 0, len(c) - 1)]) <= allowed
            equal = (off & inside).sum(axis=0) >= share * np.maximum(inside.sum(axis=0), 1)
            keep = equal & (inside.sum(axis=0) >= min(20, len(few)))
            shifts, allowed = shifts[keep], allowed[keep]
        copies[i] = len(shifts) > 0
    return copies


def _step(values: np.ndarray) -> float:
    """Return the step of rounded values if it is small relative to their motion; else 0."""
    levels = np.unique(np.round(values, 9))
    if not 40 <= levels.size < 0.5 * values.size:
        return 0.0
    step = float(np.median(np.diff(levels)))
    return step if step < 0.05 * values.std() else 0.0


def counted(values: np.ndarray, turn: float) -> np.ndarray:
    """Return angles with counted turns, ``(N, columns)``; columns without jumps by a turn are unchanged.

    Args:
        values: Shape ``(N, columns)``; rows without a number stay so.
        turn: A turn, in the unit of the values.
    """
    result = np.array(values, np.float64)
    for column in result.T:
        finite = np.flatnonzero(np.isfinite(column))
        angles = column[finite]
        if angles.size < 3 or np.ptp(np.clip(angles, *np.quantile(angles, (0.02, 0.98)))) > 1.02 * turn:
            continue
        steps = np.diff(angles)
        # At the end of a turn, a step differs from a turn by the motion; the other steps give its size.
        motion = np.abs(steps[np.abs(steps) < 0.5 * turn])
        play = min(0.2, 0.02 + 2.0 * float(np.quantile(motion, 0.99)) / turn) * turn if motion.size else 0.0
        if (np.abs(np.abs(steps) - turn) < play).any():
            column[finite] = np.unwrap(angles, period=turn)
    return result


def turns(values: np.ndarray, turn: float) -> np.ndarray:
    """Return whether a column jumps at the end of a turn, ``(columns,)``."""
    return np.asarray((np.nan_to_num(counted(values, turn)) != np.nan_to_num(values)).any(axis=0))


def glitches(t_s: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return whether a reading leaps away from its neighbours and back, ``(N, columns)``.

    A joint cannot move farther than its highest speed allows, which is measured on the readings without leaps.

    Args:
        t_s: Shape ``(N,)``, increasing [s].
        angle: Shape ``(N, columns)``, finite, with turns counted [rad].
    """
    found = np.zeros(angle.shape, bool)
    if len(angle) < 16:
        return found
    steps_s = np.diff(t_s)
    period_s = float(np.median(steps_s))
    half = int(np.clip(np.ceil(0.05 / period_s), 2, 15))  # a glitch is shorter than 50 ms, and than 15 samples
    for i, column in enumerate(angle.T):
        middle = ndimage.median_filter(column, 2 * half + 1, mode="reflect")
        fastest = max(0.5, 1.5 * float((np.abs(np.diff(middle)) / steps_s).max()))
        off, leap = np.abs(column - middle), np.abs(np.diff(column))
        far = off > reach_rad(fastest, period_s) + 12.0 * float(np.median(off))
        edges = np.flatnonzero(np.diff(far, prepend=False, append=False)).reshape(-1, 2)
        for begin, end in edges:
            # A fast motion has several steps, a leap has one.
            ways = leap[max(begin - 1, 0) : begin], leap[end - 1 : end]
            if max(float(way.max(initial=0.0)) for way in ways) < 0.5 * off[begin:end].max():
                far[begin:end] = False
        found[:, i] = far if far.mean() <= 0.02 else False  # more of them are no glitches
    return found


def leap(t_s: np.ndarray, angle: np.ndarray) -> tuple[int, int, float] | None:
    """Return row, column and size [rad] of the first step that is too fast for a joint; None without one.

    Args:
        t_s: Shape ``(N,)``, increasing [s].
        angle: Shape ``(N, columns)``, finite, with turns counted [rad].
    """
    steps = np.abs(np.diff(angle, axis=0))
    far = steps > reach_rad(_FASTEST_RAD_S, np.diff(t_s))[:, None]
    if not far.any():
        return None
    row, column = (int(x[0]) for x in np.nonzero(far))
    return row + 1, column, float(steps[row, column])


def _on_grid(
    t_s: tuple[np.ndarray, np.ndarray],
    command: np.ndarray,
    position: np.ndarray,
    acting: np.ndarray | None,
    finer: int = 1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a grid with some rows a sample, held commands, interpolated positions, and whether commands act."""
    begin, end = max(t[0] for t in t_s), min(t[-1] for t in t_s)
    if not end > begin:
        none = np.zeros(0)
        return none, none[:, None], none[:, None], none.astype(bool)
    period_s = max(min(float(np.median(np.diff(t))) for t in t_s) / finer, (end - begin) / _MAX_ROWS)
    grid = np.arange(begin, end + 1e-9, period_s)
    newest = np.clip(np.searchsorted(t_s[0], grid + 1e-6, side="right") - 1, 0, None)
    joined = np.stack([np.interp(grid, t_s[1], column) for column in position.T], axis=1)
    live = np.ones(len(grid), bool) if acting is None else np.asarray(acting, bool)[newest]
    # Between samples of a gap the motion is unknown.
    after = np.searchsorted(t_s[1], grid).clip(1, len(t_s[1]) - 1)
    live &= (t_s[1][after] - t_s[1][after - 1]) < max(0.5, 10 * period_s)
    return grid, command[newest], joined, live
