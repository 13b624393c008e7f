"""Checks whether the data of an import agree with its mapping; they refuse, ask or confirm, and never change it.

Goals and measured positions in one unit are compared joint by joint: order, sign, lag, slope, copies, zeros, clocks.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from sim2real.graph.episode import Episode
from sim2real.later import Later
from sim2real.leaps import reach_rad
from sim2real.log.importing.names import meaning

ndimage = Later("scipy.ndimage")
TURN_RAD = 2.0 * np.pi
_MAX_ROWS = 6000
"""Most compared rows; a longer recording is thinned."""
_FINER = 4
"""Compared rows for each sample, because a fast sine changes its sign within two samples."""
LEAST = 50
"""Fewest samples that can be checked."""
_LAGS_S = (-0.3, 0.6)
_CLOCK_LAGS_S = (-1.0, 1.5)
"""Range of lags of single parts of a recording [s]; it is wider, because a clock that was set changes the lag."""
_APART_S = 60.0
"""Largest offset between two clocks that is found [s]."""
_FOLLOWS_R = 0.8
"""A position follows a command if their correlation is at least this."""
_STILL = 2e-3
"""A joint with a smaller standard deviation does not move [rad or m]."""
_CLOCK_S = 6.0
"""Shortest recording whose clocks are compared [s]."""
_MOST_STEPS = 4
"""Most steps of a joint's zero."""
_FASTEST_RAD_S = 60.0
"""Highest speed of a joint [rad/s]; a faster step is no motion."""

Weight = Literal["refuse", "ask", "warn", "note"]
"""``refuse``: data and mapping contradict each other; ``ask``: the data fit several mappings; ``warn``: imported, but
the user must know it; ``note``: evidence.
"""


@dataclass(frozen=True)
class Check:
    """A finding of the data about one joint, or about all joints.

    Attributes:
        name: A key of ``CHECKS``.
        joint: Number of the joint; -1 for all.
        text: The evidence.
    """

    name: str
    joint: int
    text: str
    weight: Weight

    @property
    def question(self) -> str:
        """The key of the mapping that answers it; empty: the file is wrong, or several keys of the mapping are."""
        return CHECKS[self.name][0]


_ONE_CLOCK = 'in a bag, stamps = "/TOPIC.log_time" is the recorder\'s clock; '
CHECKS = {
    "follows": ("unit", ""),
    "slope": ("unit", "correct the unit, or name the other joints with --joints"),
    "sign": ("scale", "change the sign of that joint's scale, such as scale = [1, -1]"),
    "order": ("source", "list the sources in the order of the positions"),
    "lag": ("", "exchange the names, or correct stamp_offset"),
    "overlap": ("", _ONE_CLOCK + "stamp_offset of the commands adds seconds to their clock, in a mapping"),
    "short": ("", "record longer"),
    "clock": ("", _ONE_CLOCK + "else stamp both streams with one clock"),
    "copy": ("", "log the commands that were sent, not the measurements"),
    "zero": ("", "cut the file where the zero moves: --samples A:B"),
    "offset": ("", "give the goals an offset in a mapping, one number for each column"),
    "scale": ("", "name the other joints with --joints, or give the column its own scale in a mapping"),
    "range": ("", "correct order, unit or zero in a mapping"),
    "rate": ("", "log both sides faster than the motion"),
    "still": ("", "move the joint"),
}
"""Name of a check -> the key of the mapping that answers it, and what else the user can do."""


def hint_for(wrong: Sequence[Check]) -> str:
    """Return a hint for checks that refuse an import."""
    hints = dict.fromkeys(CHECKS[c.name][1] or "correct the mapping" for c in wrong)
    return "; ".join(hints) + "; --as-told imports it all the same"


def check(
    t_s: tuple[np.ndarray, np.ndarray],
    goal: np.ndarray,
    position: np.ndarray,
    names: Sequence[str],
    by_name: bool = True,
    acting: np.ndarray | None = None,
    unit: str = "rad",
) -> list[Check]:
    """Compare goals and positions of the same joints in one unit.

    Args:
        t_s: Stamps of goals ``(N,)`` and of positions ``(M,)`` [s].
        goal: Shape ``(N, joints)`` [rad or m].
        position: Shape ``(M, joints)``, in the same unit.
        names: Names of the joints.
        by_name: Whether names assign goals to positions; otherwise their order does, and the data must confirm it.
        acting: Shape ``(N,)``: whether goals act; None: all do.
        unit: Unit of both; empty for a robot with hinges and slides.
    """
    found = respond(t_s, goal, position, acting)
    if found is None and (samples := min(map(len, t_s))) < LEAST:
        return [Check("short", -1, f"{samples} samples are fewer than {LEAST}: nothing is checked", "refuse")]
    if found is None:
        text = "the stamps of goals and positions overlap in fewer than 50 samples: nothing is checked"
        return [Check("overlap", -1, text, "refuse")]
    both_s, shorter_s = min(t[-1] for t in t_s) - max(t[0] for t in t_s), min(float(np.ptp(t)) for t in t_s)
    if both_s < 0.5 * shorter_s:  # by chance a short part fits
        text = f"the stamps of goals and positions overlap in {both_s:.3g} of {shorter_s:.3g} s"
        return [Check("overlap", -1, f"{text}: are they of one clock?", "refuse")]
    after_s = -1.5 * found.sample_s
    fits = found.fit(1.0, after_s), found.fit(-1.0, after_s), found.fit(1.0, _LAGS_S[0])
    judged = [_judge(found, fits, i, names, by_name, t_s, goal, position) for i in range(len(names))]
    findings = [wrong for wrong, _ in judged if wrong is not None]
    following = [i for i, (wrong, _) in enumerate(judged) if wrong is None]
    moving = [i for i, (_, moves) in enumerate(judged) if moves]
    lag_s = np.diag(fits[0].lag_s).tolist()
    opposed = {f.joint for f in findings if f.weight == "refuse" and f.name in ("sign", "order")}
    begin_s = {i: lag_s[i] if i in following else None for i in following or moving if i not in opposed}
    clock = _clock(t_s, goal, position, begin_s, acting)
    rates = _rates(t_s, goal[:, moving], position[:, moving]) if moving else []
    if any(f.weight == "refuse" for f in clock):
        findings = [f for f in findings if f.name not in ("follows", "lag")]
    elif moving and not following and not opposed and (apart := _apart(t_s, goal[:, moving], position[:, moving])):
        findings = [f for f in findings if f.name not in ("follows", "lag")] + apart
    elif moving and not following and not any(f.weight in ("refuse", "ask") for f in findings):
        rates = [replace(f, weight="refuse") for f in rates]  # the cause of other findings of other findings
        text = "no position follows its goal: units, signs, order and clocks are unproven"
        findings += [] if rates else [Check("follows", -1, text, "ask")]
    findings += clock
    if following:
        slopes = np.diag(fits[0].slope)
        late = ", ".join(
            f"{names[i]} {1e3 * lag_s[i]:.0f} ms{f' (slope {slopes[i]:.2f})' if abs(slopes[i] - 1) > 0.05 else ''}"
            for i in following[:6]
        )
        text = f"positions follow their goals: {late}" + " ..." * (len(following) > 6)
        findings.append(Check("follows", -1, text, "note"))
    if not any(f.weight == "refuse" for f in findings):
        for i in np.flatnonzero(found.spread[1] > _STILL).tolist():
            known_s = lag_s[i] if i in following else None
            findings += _zero(t_s, goal[:, i], position[:, i], i, names[i], known_s, unit)
    return [*findings, *rates, *odd_columns(position, names)]


def check_episode(episode: Episode, joints: Sequence[str] = (), by_name: bool = True) -> list[Check]:
    """Compare the goals and positions of an imported episode; see ``check``."""
    sensed, commands = episode.outputs.get("sensor", {}), episode.outputs.get("actuator", {})
    units = {**episode.units.get("actuator", {}), **episode.units.get("sensor", {})}
    enabled = [values for name, values in commands.items() if meaning(name).quantity == "enabled"]
    acting = np.asarray((enabled[0].reshape(len(enabled[0]), -1) > 0).all(axis=1)) if len(enabled) == 1 else None
    findings: list[Check] = []
    for (name, position), (goal, values) in itertools.product(sensed.items(), commands.items()):
        named = meaning(goal)
        if meaning(name).quantity != "position" or named.side != "command" or named.quantity not in ("", "position"):
            continue
        flat = values.reshape(len(values), -1), position.reshape(len(position), -1)
        if units.get(goal) == units.get(name) and flat[0].shape[1] == flat[1].shape[1]:
            names = (
                joints if len(joints) == flat[1].shape[1] and all(joints) else list(map(str, range(flat[1].shape[1])))
            )
            names = [f"joint {name}" if name.isdigit() else name for name in names]
            t_s = episode.steps["actuator"].begun_s, episode.steps["sensor"].begun_s
            findings += check(t_s, *flat, names, by_name, acting, units.get(name, ""))
    return findings


def slow_sides(episode: Episode) -> list[str]:
    """Return a sentence if commands, or positions, are logged too seldom for the motion of an episode."""
    return [finding.text for finding in check_episode(episode) if finding.name == "rate"]


# -- measures of goals and positions


class Response(NamedTuple):
    """How positions follow commands at each lag."""

    lag_s: np.ndarray  # (L,)
    r: np.ndarray  # (L, joints, commands): correlation
    slope: np.ndarray  # (L, joints, commands): slope of positions over commands
    mean: tuple[np.ndarray, np.ndarray]  # standard deviations of commands and positions, (joints,)
    spread: tuple[np.ndarray, np.ndarray]
    sample_s: float  # period of the faster of the two streams

    def fit(self, sign: float, begin_s: float) -> Fit:
        """Return how each position fits each command, or with ``sign`` -1 its negative, at the best lag."""
        rows = np.flatnonzero(self.lag_s >= begin_s)
        k = rows[np.argmax(sign * self.r[rows], axis=0)]
        r, slope = (np.take_along_axis(x, k[None], axis=0)[0] for x in (self.r, self.slope))
        spread = np.maximum(self.spread[1], 1e-9)[:, None]
        size, level = self.spread[0] / spread, (self.mean[1][:, None] - sign * self.mean[0]) / spread
        misfit = np.sqrt(np.maximum(1 + size**2 - 2 * sign * r * size, 0.0) + level**2)
        return Fit(r, self.lag_s[k], slope, misfit)


class Fit(NamedTuple):
    """How each position fits each command at one lag; shape ``(joints, commands)``."""

    r: np.ndarray  # correlation
    lag_s: np.ndarray
    slope: np.ndarray  # slope of positions over commands
    misfit: np.ndarray  # error of the command as a prediction, relative to the position's standard deviation


def respond(
    t_s: tuple[np.ndarray, np.ndarray],
    command: np.ndarray,
    position: np.ndarray,
    acting: np.ndarray | None = None,
    lags_s: tuple[float, float] = _LAGS_S,
) -> Response | None:
    """Compare commands and positions on one grid of time; None if they overlap in fewer than 50 samples.

    Args:
        t_s: Stamps of commands ``(N,)`` and of positions ``(M,)`` [s].
        command: Shape ``(N, joints)``.
        position: Shape ``(M, joints)``.
        acting: Shape ``(N,)``: whether commands act; None: all do.
        lags_s: Smallest and largest lag [s].
    """
    grid, held, joined, live = _on_grid(t_s, command, position, acting, _FINER)
    sample_s = min(float(np.median(np.diff(t))) for t in t_s)
    if len(grid) < 2 or live.sum() * (grid[1] - grid[0]) < 50 * sample_s:
        return None
    period_s = float(grid[1] - grid[0])
    lags = np.arange(round(lags_s[0] / period_s), round(lags_s[1] / period_s) + 1)
    least = round(50 * sample_s / period_s)
    lags = lags[np.abs(lags) < len(grid) - least]
    # For each lag, sum over the rows where both the earlier command and the position are known; by FFT, for all lags.
    mean, spread = ([f(x[live], axis=0) for x in (held, joined)] for f in (np.mean, np.std))
    c, q = (np.where(live[:, None], x - m, 0.0) for x, m in zip((held, joined), mean, strict=True))
    size = 1 << (2 * len(grid) - 1).bit_length()
    ones, x, xx, y, yy = (np.fft.rfft(v, size, axis=0) for v in (live[:, None].astype(float), c, c * c, q, q * q))

    def sums(now: np.ndarray, then: np.ndarray) -> np.ndarray:
        return np.fft.irfft(now * np.conj(then), size, axis=0)[lags]

    count = np.maximum(sums(ones, ones), 1.0)
    mx, my = sums(ones, x) / count, sums(y, ones) / count
    vx, vy = (np.maximum(v / count - m**2, 1e-18) for v, m in ((sums(ones, xx), mx), (sums(yy, ones), my)))
    both = np.stack([sums(y[:, j : j + 1], x) for j in range(q.shape[1])], axis=1)
    cov = both / count[:, :, None] - my[:, :, None] * mx[:, None, :]
    r = cov / np.sqrt(vx[:, None, :] * vy[:, :, None])
    r[count[:, 0] < least] = 0.0
    return Response(lags * period_s, r, cov / vx[:, None, :], (mean[0], mean[1]), (spread[0], spread[1]), sample_s)


def _judge(
    found: Response, fits: tuple[Fit, Fit, Fit], i: int, names: Sequence[str], by_name: bool,
    t_s: tuple[np.ndarray, np.ndarray], goal: np.ndarray, position: np.ndarray,
) -> tuple[Check | None, bool]:  # fmt: skip
    """Return the finding about a joint's goals and positions, None if it follows; and whether it moves.

    Args:
        fits: Fits of positions to earlier goals, to earlier negative goals, and to goals at any lag.
    """
    name, (own, opposite, leading) = names[i], fits
    moves = bool(min(s[i] for s in found.spread) > _STILL)
    # A resting joint: compare its position and goal. A weak servo sags, by less than half of its goal.
    level, held = float(np.median(position[:, i])), float(np.median(goal[:, i]))
    is_elsewhere = (
        not moves and np.ptp(goal[:, i]) < 4 * _STILL and abs(held) > 0.1 and abs(level - held) > abs(held) / 2
    )
    r, against = float(own.r[i, i]), float(opposite.r[i, i])
    best, slope = max(r, -against), float(own.slope[i, i] if r > -against else -opposite.slope[i, i])
    misfit, mirror = float(own.misfit[i, i]), float(opposite.misfit[i, i])
    # The sign is 0 if both fit: a sine half a period later is its negative.
    sign = _is_clear(r, -against, misfit, mirror) - _is_clear(-against, r, mirror, misfit)
    lead_r, lead_s = float(leading.r[i, i]), float(leading.lag_s[i, i])
    leads = lead_r > 0.9
    if best >= _FOLLOWS_R:
        leads = -lead_s > 1.5 * found.sample_s and 1 - r > 3 * (1 - lead_r) + 0.005
    # Compare with goals of other joints, except goals equal to this joint's goal or its negative.
    mine = goal[:, i : i + 1]
    unlike = moves & ~np.any([np.isclose(mine, s * goal, 1e-6, 1e-9).all(axis=0) for s in (1, -1)], axis=0)
    others = np.where(unlike, np.maximum(own.r[i], -opposite.r[i]), 0.0)
    other, other_r = int(np.argmax(others)), float(others.max())
    theirs = np.minimum(own.misfit[i], opposite.misfit[i])
    by_level = (min(misfit, mirror) < 0.5 * theirs) & (theirs > 0.1)
    alike = unlike & ~by_level & ((1 - others <= 3 * (1 - best) + 0.02) | (others > best + 0.02))
    is_unclear = not by_name and bool(alike.any()) and max(best, other_r) >= _FOLLOWS_R
    rival = int(np.argmax(alike))
    copied = moves and lead_r > 0.95 and is_copy(t_s, goal[:, i], position[:, i], lead_s)
    away = f"{name} is held at {level:.3g} by a goal of {held:.3g}: another sign, unit or zero"
    follows = f"{name} follows its goal (r {r:.2f}) with a slope of {slope:.3g}"
    scale = f"{follows}: unit or scale of one of them is wrong"
    weak = f"{follows}: another unit or scale, or a drive too weak for its load?"
    resting = f"{name}'s goal" if found.spread[1][i] > _STILL else name
    before = f"{name} moves {-lead_s:.3g} s before its goal: names are exchanged, or the clocks do not agree"
    table: list[tuple[str, Weight, bool, str]] = [
        ("copy", "refuse", copied,
         f"{name}: its goals are copies of its measurements, so they hold no information on the drive"),
        ("sign", "ask", is_elsewhere and abs(level + held) < 0.3 * abs(held), away),
        ("slope", "ask", is_elsewhere, away),
        ("still", "warn", not moves,
         f"{resting} hardly moves: sign, order and unit are not checked"),
        ("order", "refuse", other_r > 0.9 and best < 0.6,
         f"{name} follows the goal of {names[other]} (r {other_r:.2f}), not its own (r {best:.2f})"),
        ("order", "ask", is_unclear,
         f"{name} follows its own goal and that of {names[rival]} alike (r {best:.2f} and {others[rival]:.2f})"),
        ("lag", "refuse", best < _FOLLOWS_R and leads, before),
        ("follows", "warn", best < _FOLLOWS_R,
         f"{name} does not follow its goal (r {best:.2f} at most): sign, unit and order are not checked"),
        # A weak servo stays far short of its goal, but no servo goes far beyond it.
        ("slope", "refuse", not 0.15 < slope < 4.0, scale),
        ("sign", "refuse", sign < 0, f"{name} moves against its goal (r {against:.2f}): a sign of scale is wrong"),
        ("slope", "ask", sign > 0 and not 0.5 < slope < 1.6, weak),
        ("lag", "refuse", leads, before),
        ("sign", "ask", sign == 0, f"{name} fits its goal with either sign (r {r:.2f} and {against:.2f}): "
         "the motion repeats"),
    ]  # fmt: skip
    wrong = next((Check(name, i, text, weight) for name, weight, holds, text in table if holds), None)
    return wrong, moves


def _is_clear(r: float, other_r: float, misfit: float, other_misfit: float) -> bool:
    """Return whether a goal fits clearly better than another goal: by its correlation, or by its misfit."""
    by_level = misfit < 0.5 * other_misfit and other_misfit > 0.1
    return 1 - other_r > 3 * (1 - r) + 0.02 or (by_level and r > _FOLLOWS_R)


def _clock(
    t_s: tuple[np.ndarray, np.ndarray],
    goal: np.ndarray,
    position: np.ndarray,
    lag_s: Mapping[int, float | None],
    acting: np.ndarray | None,
) -> list[Check]:
    """Return a finding if the lag grows: two clocks run at different rates.

    Args:
        lag_s: Joint -> the lag that fits the whole recording [s]; None if none does.
    """
    joints = list(lag_s)
    sent_s = t_s[0] if acting is None else t_s[0][acting]
    if not len(sent_s):
        return []
    begin, end = max(sent_s[0], t_s[1][0]), min(t[-1] for t in t_s)
    if end - begin < _CLOCK_S or not joints:
        return []
    count = int(np.clip((end - begin) / 3.0, 4, 10))
    parts = list(itertools.pairwise(np.linspace(begin, end, count + 1).tolist()))
    lags = np.full((count, len(joints)), np.nan)
    curves: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    for row, (low, high) in enumerate(parts):
        sent = np.flatnonzero((t_s[0] >= low - 1.0) & (t_s[0] <= high + 1.0))
        read = np.flatnonzero((t_s[1] >= low) & (t_s[1] <= high))
        if min(len(sent), len(read)) < 60:
            continue
        c, q = goal[sent][:, joints], position[read][:, joints]
        acts = None if acting is None else acting[sent]
        part = respond((t_s[0][sent], t_s[1][read]), c, q, acts, _CLOCK_LAGS_S)
        if part is None:
            continue
        for k, joint in enumerate(joints):
            # A periodic motion fits at many lags: prefer a lag near that of the part before.
            known = lags[np.isfinite(lags[:, k]), k]
            last, r = known[-1] if len(known) else lag_s[joint], part.r[:, k, k]
            best = int(np.argmax(r if last is None else np.where(np.abs(part.lag_s - last) < 0.15, r, -1.0)))
            best = best if r[best] > 0.9 else int(np.argmax(r))
            if r[best] > 0.9 and min(s[k] for s in part.spread) > _STILL:
                lags[row, k], curves[row, k] = part.lag_s[best], (part.lag_s, r)
    # Fit one clock rate for all joints, and one lag for each joint.
    known = [(row, k) for row, k in curves if np.isfinite(lags[:, k]).mean() > 0.7]
    if not known:
        return []
    rows, of = np.array(known).T
    seconds, found = np.mean(parts, axis=1)[rows], lags[rows, of]
    usual, middle = (np.array([x[of == k].mean() for k in of]) for x in (found, seconds))
    seconds = seconds - middle
    rate = float(seconds @ (found - usual) / (seconds @ seconds))
    rest = found - usual - rate * seconds
    # A slow motion also fits its usual lag.
    best, fixed = (
        np.mean([1 - np.interp(lag, *curves[at]) for at, lag in zip(known, x, strict=True)]) for x in (found, usual)
    )
    grown = rate * (end - begin)
    least = max(0.02, *(float(np.median(np.diff(t))) for t in t_s))
    if fixed < 1.5 * best + 1e-4:
        return []
    if abs(grown) >= least and rest.std() <= 0.15 * abs(grown):
        text = (
            f"the lag of positions behind goals grows by {1e3 * rate:.1f} ms each second ({1e3 * grown:.0f} ms in all):"
            " the clocks of the two streams run at different rates"
        )
    else:
        # Or the lag steps once.
        sides = [(found[rows < m], found[rows >= m], m) for m in range(1, count)]
        fitting = [(float(np.var(a) * a.size + np.var(b) * b.size), m) for a, b, m in sides if a.size and b.size]
        if not fitting:
            return []
        error, m = min(fitting)
        grown = float(np.median(found[rows >= m]) - np.median(found[rows < m]))
        if abs(grown) < 1.5 * least or np.sqrt(error / found.size) > 0.25 * abs(grown):
            return []
        text = (
            f"the lag of positions behind goals changes by {1e3 * grown:.0f} ms about {parts[m][0] - t_s[1][0]:.0f} s "
            "after the start: one of the two clocks was set"
        )
    # In a sweep, the lag of a servo also changes with the frequency, but less.
    return [Check("clock", -1, text, "refuse" if abs(grown) > 0.15 else "warn")]


def _apart(t_s: tuple[np.ndarray, np.ndarray], goal: np.ndarray, position: np.ndarray) -> list[Check]:
    """Return a finding if positions follow their goals at an impossible lag: the clocks have an offset."""
    span_s = min(_APART_S, 0.4 * (min(t[-1] for t in t_s) - max(t[0] for t in t_s)))
    found = respond(t_s, goal, position, lags_s=(-span_s, span_s))
    if found is None or span_s < 2 * _LAGS_S[1]:
        return []
    r = np.diagonal(found.r, axis1=1, axis2=2).mean(axis=1)
    k, robots = int(np.argmax(r)), (found.lag_s >= _LAGS_S[0]) & (found.lag_s <= _LAGS_S[1])
    if r[k] < 0.9 or r[robots].max() > _FOLLOWS_R:
        return []
    text = (
        f"positions follow their goals {found.lag_s[k]:.3g} s later (r {r[k]:.2f}): the two clocks are set apart, by "
        "that less the robot's own lag"
    )
    return [Check("overlap", -1, text, "refuse")]


def _zero(
    t_s: tuple[np.ndarray, np.ndarray], goal: np.ndarray, position: np.ndarray, i: int, name: str,
    lag_s: float | None, unit: str,
) -> list[Check]:  # fmt: skip
    """Return findings on a zero that steps, or an offset between goal and position.

    Args:
        lag_s: Lag of the position behind its goal [s]; None if it does not follow: then only steps are looked for.
        unit: Unit of both.
    """
    one = 0.1 if unit == "m" else 1.0  # thresholds in rad for a hinge hold for a slide with 0.1 m for 1 rad
    grid, held, joined, _ = _on_grid(t_s, goal[:, None], position[:, None], None)
    n, period_s = len(grid), float(grid[1] - grid[0])
    # Predict the position from the last goals; the error shows the zero.
    span = max(1, round(((lag_s or 0.2) + 0.3) / period_s / 12))
    if n - 12 * span < 200:
        return []
    past = np.stack([held[12 * span - k * span : n - k * span, 0] for k in range(13)], axis=1)
    q, at, rows = joined[12 * span :, 0], grid[12 * span :], np.arange(n - 12 * span)

    def fitted(steps: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return the sizes of the steps, and the positions minus goals and steps."""
        known = np.concatenate([past, rows[:, None] >= np.asarray(steps, int)[None, :]], axis=1)
        known = known - known.mean(axis=0)
        gram = known.T @ known
        gram += 1e-9 * (np.trace(gram) / len(gram) + 1e-12) * np.eye(len(gram))
        weights = np.linalg.solve(gram, known.T @ (q - q.mean()))
        return weights[13:], q - q.mean() - known @ weights

    # Add the step that explains most of the error, up to a few steps: slips, or moving zeros.
    steps: list[int] = []
    _, rest = fitted(steps)
    first, edge = float(rest.std()), max(len(q) // 20, 1)
    for _ in range(_MOST_STEPS):
        total, count = np.cumsum(rest), rows + 1.0
        far = int(np.argmax((np.abs(total) / np.sqrt(count * (len(q) - count) + 1.0))[edge:-edge])) + edge + 1
        # A step of the goals can hide a step of the zero.
        leapt = int(np.argmax(np.abs(np.diff(past[edge:-edge, 0])))) + edge + 1
        near = {m for k in (far, leapt) for m in range(max(k - 3, 1), min(k + 4, len(q) - 1))} - {*steps}
        left, k = min(((float(fitted([*steps, m])[1].std()), m) for m in near), default=(np.inf, 0))
        if left > 0.9 * rest.std():
            break
        steps.append(k)
        _, rest = fitted(steps)
    # A slip is one step, or several small steps.
    for chosen in (steps, steps[:1]):
        sizes, rest = fitted(chosen)
        blocks = np.array([b.mean() for b in np.array_split(rest, max(8, int(np.ptp(at) / 1.0)))])
        least = max(0.03 * one, 5.0 * float(blocks.std()))
        moved = sorted((k, float(size)) for k, size in zip(chosen, sizes, strict=True) if abs(size) > least)
        if moved and rest.std() <= 0.8 * first:
            leaps = any(abs(size) > 0.1 * one and 0.6 < (q[k] - q[k - 1]) / size < 1.6 for k, size in moved)
            listed = ", ".join(
                f"{size:+.3f} {unit}".rstrip() + f" from {at[k] - t_s[1][0]:.2f} s on" for k, size in moved
            )
            cause = "one of them has another zero" if leaps else "a zero has moved, or a load pulls"
            text = f"{name} reads against its goal {listed}: {cause}"
            return [Check("zero", i, text, "refuse" if leaps else "warn")]
    if lag_s is None:
        return []
    shift = max(round(lag_s / period_s), 0)
    error = joined[shift:, 0] - held[: n - shift, 0]
    offset = float(np.median(error))
    if abs(offset) > 0.05 * one and abs(offset) > 2.0 * float(np.median(np.abs(error - offset))):
        size = f"{offset:+.3f} {unit}".rstrip()
        text = f"{name} reads {size} against its goal on average: zeros differ, or a load pulls"
        return [Check("offset", i, text, "ask" if abs(offset) > one else "warn")]
    return []


def _rates(t_s: tuple[np.ndarray, np.ndarray], goal: np.ndarray, position: np.ndarray) -> list[Check]:
    """Return a finding if goals or positions are sampled too slowly for the motion of the other."""
    findings = []
    sides = ("goals", t_s[0], goal), ("positions", t_s[1], position)
    for (slow, t, own), (fast, other, values) in (sides, sides[::-1]):
        rate_hz, fast_hz = _rate(t, own), _rate(other, values)
        if fast_hz < 2.0 * rate_hz:
            continue
        grid = np.arange(other[0], other[-1], 1.0 / fast_hz)
        x = np.stack([np.interp(grid, other, column) for column in values.T], axis=1)
        power = (np.abs(np.fft.rfft((x - x.mean(axis=0)) * np.hanning(len(x))[:, None], axis=0)) ** 2).sum(axis=1)
        f = np.fft.rfftfreq(len(x), 1.0 / fast_hz)
        if power[f > 0.5 * rate_hz].sum() > 0.02 * power.sum():
            band = float(f[np.searchsorted(np.cumsum(power), 0.99 * power.sum())])
            text = (
                f"{rate_hz:.3g} {slow} a second are too few for {fast} with power up to {band:.3g} Hz: between two "
                f"{slow} the motion is unknown, so delays and dynamics cannot be identified; log {slow} at "
                f"{4 * band:.0f} Hz"
            )
            findings.append(Check("rate", -1, text, "warn"))
    return findings


def _rate(t_s: np.ndarray, values: np.ndarray) -> float:
    """Return the samples per second [Hz]; values that a table repeats at equal intervals count once."""
    new = np.flatnonzero((np.diff(values, axis=0) != 0).any(axis=1)) + 1
    steps = np.diff(t_s[new]) if len(new) > 20 else np.diff(t_s)
    usual = float(np.median(steps))
    regular = len(new) > 20 and np.mean(np.abs(steps - usual) < 0.2 * usual) > 0.8
    steps = np.diff(t_s)
    rest = steps[steps <= 10 * np.median(steps)]  # ignore pauses
    return 1.0 / max(usual if regular else float(rest.mean()), 1e-9)


def odd_columns(position: np.ndarray, names: Sequence[str]) -> list[Check]:
    """Return a check on a column that is far larger than the others and turns back, as if in another unit."""
    most = np.abs(position).max(axis=0)
    findings = []
    for i, size in enumerate(most):
        others = np.delete(most, i)
        net = abs(position[-1, i] - position[0, i])
        if others.size and size > 1.0 and size > 8.0 * others.max() and net < 0.7 * np.ptp(position[:, i]):
            text = f"{names[i]} reads up to {size:.4g}, the other joints {others.max():.3g}: another unit or scale?"
            findings.append(Check("scale", i, text, "refuse" if size > TURN_RAD else "warn"))
    return findings


def beyond(position: np.ndarray, names: Sequence[str], ranges: Mapping[str, tuple[float, float]]) -> list[Check]:
    """Return a check for each joint that is outside of its range in the model for most of the time.

    Args:
        ranges: Joint -> lowest and highest position [rad or m].
    """
    findings = []
    for i, name in enumerate(names):
        low, high = ranges.get(name, (-np.inf, np.inf))
        middle, spare = float(np.median(position[:, i])), 0.05 * min(high - low, 1.0)
        if not low - spare <= middle <= high + spare:
            text = f"{name} reads {middle:.3g} most of the time, its range in the model is {low:.3g} to {high:.3g}"
            findings.append(Check("range", i, f"{text}: another order, sign, unit or zero?", "warn"))
    return findings


def _on_grid(
    t_s: tuple[np.ndarray, np.ndarray],
    command: np.ndarray,
    position: np.ndarray,
    acting: np.ndarray | None,
    finer: int = 1,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a time grid, ``finer`` than the samples; held commands; interpolated positions; whether commands act."""
    begin, end = max(t[0] for t in t_s), min(t[-1] for t in t_s)
    if not end > begin:
        none = np.zeros(0)
        return none, none[:, None], none[:, None], none.astype(bool)
    period_s = max(min(float(np.median(np.diff(t))) for t in t_s) / finer, (end - begin) / _MAX_ROWS)
    grid = np.arange(begin, end + 1e-9, period_s)
    newest = np.clip(np.searchsorted(t_s[0], grid + 1e-6, side="right") - 1, 0, None)
    joined = np.stack([np.interp(grid, t_s[1], column) for column in position.T], axis=1)
    live = np.ones(len(grid), bool) if acting is None else np.asarray(acting, bool)[newest]
    # In a gap between samples the motion is unknown.
    after = np.searchsorted(t_s[1], grid).clip(1, len(t_s[1]) - 1)
    live &= (t_s[1][after] - t_s[1][after - 1]) < max(0.5, 10 * period_s)
    return grid, command[newest], joined, live


# -- checks of single columns


def is_rate(t_s: np.ndarray, angle: np.ndarray, velocity: np.ndarray) -> bool:
    """Return whether velocities ``(N, joints)`` are the derivative of angles, in the same unit."""
    rows = np.isfinite(angle).all(axis=1) & np.isfinite(velocity).all(axis=1) & np.isfinite(t_s)
    if rows.sum() < 50 or (np.diff(t_s[rows]) <= 0).any():
        return False
    rate = np.gradient(angle[rows], t_s[rows], axis=0)
    rate, v = (ndimage.uniform_filter1d(x, 5, axis=0)[3:-3] for x in (rate, velocity[rows]))
    moving = v.std(axis=0) > 1e-9
    x, y = v[:, moving].ravel(), rate[:, moving].ravel()
    return bool(moving.any() and np.corrcoef(x, y)[0, 1] > 0.8 and 0.8 < (x @ y) / (x @ x) < 1.25)


def unsigned(values: np.ndarray) -> int | None:
    """Return the modulus (2^16, 2^32) or sign bit (2^15, 2^31) by which whole numbers jump; None without jumps.

    Signed counts that are read as unsigned jump from 0 to the modulus; with a sign bit, they jump by the bit's value.

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


def is_copy(t_s: tuple[np.ndarray, np.ndarray], goal: np.ndarray, position: np.ndarray, lag_s: float) -> bool:
    """Return whether goals ``(N,)`` equal the positions ``(M,)`` that were measured ``lag_s`` earlier or later."""
    period_s = max(float(np.median(np.diff(t_s[0]))), 1e-6)
    newest = np.searchsorted(t_s[0], t_s[1] + 1e-6, side="right") - 1
    # Compare only rows in motion: resting columns are equal at every lag.
    moved = np.abs(np.diff(position, prepend=position[:1]))
    rows = np.flatnonzero(moved > 0.01 * moved.max(initial=0.0))
    exact = 1e-5 * position.std() + 1.1e-6 * np.abs(position).max()
    for shift in round(lag_s / period_s) + np.arange(-1, 2):
        at = newest[rows] - shift
        inside = (at >= 0) & (at < len(goal))
        off = np.abs(position[rows] - goal[np.clip(at, 0, len(goal) - 1)])[inside]
        rounded = 0.51 * max(_step(goal), _step(position)) if abs(shift) <= 1 else 0.0
        if off.size >= 20 and np.mean(off <= max(exact, rounded)) >= 0.98:
            return True
    return False


def _step(values: np.ndarray) -> float:
    """Return the resolution of rounded values, if it is small relative to their motion; else 0."""
    levels = np.unique(np.round(values, 9))
    if not 40 <= levels.size < 0.5 * values.size:
        return 0.0
    step = float(np.median(np.diff(levels)))
    return step if step < 0.05 * values.std() else 0.0


def counted(values: np.ndarray, turn: float) -> np.ndarray:
    """Return angles with counted turns, ``(N, columns)``; columns without jumps by a turn are unchanged.

    Args:
        values: Shape ``(N, columns)``; rows without a number stay so.
        turn: Size of a turn, in the unit of the values.
    """
    result = np.array(values, np.float64)
    for column in result.T:
        finite = np.flatnonzero(np.isfinite(column))
        angles = column[finite]
        if angles.size < 3 or np.ptp(np.clip(angles, *np.quantile(angles, (0.02, 0.98)))) > 1.02 * turn:
            continue
        steps = np.diff(angles)
        # At the end of a turn, a step is a turn plus the motion, whose size the other steps show.
        motion = np.abs(steps[np.abs(steps) < 0.5 * turn])
        play = min(0.2, 0.02 + 2.0 * float(np.quantile(motion, 0.99)) / turn) * turn if motion.size else 0.0
        if (np.abs(np.abs(steps) - turn) < play).any():
            column[finite] = np.unwrap(angles, period=turn)
    return result


def glitches(t_s: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return whether a reading leaps away from its neighbours and back, ``(N, columns)``.

    A leap is faster than the joint's highest speed, which is measured on the readings without leaps.

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
            # A fast motion has several large steps in a row, a leap has one.
            ways = leap[max(begin - 1, 0) : begin], leap[end - 1 : end]
            if max(float(way.max(initial=0.0)) for way in ways) < 0.5 * off[begin:end].max():
                far[begin:end] = False
        found[:, i] = far if far.mean() <= 0.02 else False  # more leaps are no glitches
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
