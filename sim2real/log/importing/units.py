"""The unit of positions and goals: by their names, by a column beside them, or a question."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import checks, lerobot
from sim2real.log.importing.mapping import in_si
from sim2real.log.importing.names import meaning
from sim2real.log.importing.readers import Table
from sim2real.log.importing.signals import ImportHints, Proposal, Signal

_DEG = 180 / np.pi
_NAMED = ("rad", "deg", "rev", "mrad", "m", "mm")
"""Units that a name can have, of positions."""


def position_unit(
    measured: Signal, command: Signal, kind: str, clocks: Mapping[str, np.ndarray], signals: Sequence[Signal],
    table: Table, hints: ImportHints, draft: Proposal,
) -> tuple[str, float]:  # fmt: skip
    """Return the unit of positions, and a turn if they jump at its end."""
    at = "sensor", "position", "unit"
    unit, reason = stated_unit(measured, table, hints)
    q = measured.values
    if unit is None and not reason:
        # A jump at the end of a turn, a velocity or goals in a known unit, or the joints' ranges.
        jumps = [u for u, turn in (("rad", 2 * np.pi), ("deg", 360.0)) if _jumps(q, turn)]
        if len(jumps) == 1:
            unit, reason = jumps[0], "jumps by a turn"
        elif (found := _unit_by_rate(measured, clocks["sensor"], signals)) or (
            kind == "position" and (found := _unit_by_goal(measured, command, clocks, table, hints))
        ):
            unit, reason = found
        elif _only_rad(q, hints):
            unit, reason = "rad", "by the joints' ranges: in degrees, one would be outside"
    if unit is None:
        spans = np.nanmax(q, axis=0) - np.nanmin(q, axis=0)
        asked, why = (
            reason or '"rad" or "deg"?',
            f"they span up to {spans.max():.4g}, and no name has a unit; --unit answers, too",
        )
        draft.questions[at] = f"{asked}  # {why}"
        return "", 0.0
    draft.reasons[at] = reason
    return unit, turn_of(measured, unit, ("sensor", "position"), draft)


def stated_unit(signal: Signal, table: Table, hints: ImportHints) -> tuple[str | None, str]:
    """Return a signal's unit by flag, name or kind of file; None, and the candidates if rad and deg are none."""
    names = tuple(table.names.get(signal.whole or "", ()))
    of_columns = {meaning(name).unit for name in names}
    named = signal.meaning.unit or (of_columns.pop() if len(of_columns) == 1 else "")
    lerobots = lerobot.writes_hundredths(table.robot, names or signal.sources)
    if hints.unit:
        if hints.unit == "hundredths" and hints.calibration is None:
            raise UsageError("hundredths of a joint's range need LeRobot's calibration", hint="--calibration FILE.json")
        return hints.unit, "--unit"
    if named in _NAMED:
        return named, "by its name"
    if named == "counts":
        return None, '"counts:4096"?'
    if named == "percent":
        return None, '"counts:N" or "rad" with a scale, as percent of which angle?'
    if lerobots:
        return (
            (found, "whole counts by LeRobot's calibration")
            if (found := _lerobot_unit(signal, hints))
            else (None, '"deg" or "hundredths" (with --calibration)?')
        )
    key = (signal.whole or signal.sources[0]).lower()
    if table.format == "mcap" or re.search(r"joint_?states?|field\.(position|header)", key):
        return "rad", "messages of ROS are in radians"
    if re.search(r"qpos|dof_?pos", key):
        return "rad", "MuJoCo and Isaac are in radians"
    if hints.slides:
        return None, '"m" or "mm"?' if len(hints.slides) == len(hints.joints) else '"rad" (and m) or another?'
    return None, ""


def _lerobot_unit(signal: Signal, hints: ImportHints) -> str | None:
    """Return the unit in which positions are whole counts by LeRobot's calibration; None if unclear."""
    if hints.calibration is None:
        return None
    fits = []
    arm = [i for i, label in enumerate(signal.labels) if not lerobot.is_gripper(label)]
    for unit in lerobot.UNITS:
        scale, _ = lerobot.conversion(hints.calibration, [signal.labels[i] for i in arm], unit)
        counts = signal.values[:, arm] * np.array(scale) * 4096 / (2 * np.pi)
        off = np.abs(2 * counts - np.round(2 * counts))  # the middle of a range can be half a count
        fits.append(float(np.quantile(off, 0.95)) < 0.05)
    return lerobot.UNITS[fits.index(True)] if sum(fits) == 1 else None


def _jumps(q: np.ndarray, turn: float) -> bool:
    """Return whether columns jump by a turn, and lie within -half to half a turn, or within 0 to a turn."""
    rows = q[np.isfinite(q).all(axis=1)]
    over = checks.turns(rows, turn) if len(rows) > 2 else np.zeros(1, bool)
    if not over.any():
        return False
    low, high = rows[:, over].min(axis=0) / turn, rows[:, over].max(axis=0) / turn
    ends = ((-0.5, 0.5), (0.0, 1.0))
    return any(bool((np.abs(low - a) < 0.02).all() and (np.abs(high - b) < 0.02).all()) for a, b in ends)


def _unit_by_rate(measured: Signal, t_s: np.ndarray, signals: Sequence[Signal]) -> tuple[str, str] | None:
    """Return the unit of positions by a velocity whose name has a unit."""
    for v in signals:
        if v.meaning.quantity != "velocity" or v.meaning.side == "command" or v.meaning.unit not in ("rad", "deg"):
            continue
        if v.values.shape == measured.values.shape and (slope := rate_slope(measured.values, v.values, t_s)):
            for unit, factor in (("rad", 1.0), ("deg", _DEG)):
                if 0.8 < slope / (factor / (1.0 if v.meaning.unit == "rad" else _DEG)) < 1.25:
                    return unit, f"its rate over {v.name!r} is {slope:.3g}"
    return None


def rate_slope(q: np.ndarray, v: np.ndarray, t_s: np.ndarray) -> float | None:
    """Return the slope of the rate of positions over velocities; None if they differ."""
    rows = np.isfinite(q).all(axis=1) & np.isfinite(v).all(axis=1) & np.isfinite(t_s)
    if rows.sum() < 50 or (np.diff(t_s[rows]) <= 0).any():
        return None
    rate = np.gradient(q[rows], t_s[rows], axis=0)
    kernel = np.ones(5) / 5
    rate, v = (np.stack([np.convolve(c, kernel, "same") for c in x.T], axis=1)[3:-3] for x in (rate, v[rows]))
    moving = v.std(axis=0) > 1e-9
    if not moving.any():
        return None
    x, y = v[:, moving].ravel(), rate[:, moving].ravel()
    r = np.corrcoef(x, y)[0, 1]
    return float((x @ y) / (x @ x)) if r > 0.8 else None


def _unit_by_goal(
    measured: Signal, command: Signal, clocks: Mapping[str, np.ndarray], table: Table, hints: ImportHints
) -> tuple[str, str] | None:
    """Return the unit of positions by that of goals and the slope between them."""
    unit, _ = stated_unit(command, table, hints)
    if (
        unit is None
        and command.meaning.unit == ""
        and len(jumps := [u for u, turn in (("rad", 2 * np.pi), ("deg", 360.0)) if _jumps(command.values, turn)]) == 1
    ):
        unit = jumps[0]
    if unit not in ("rad", "deg") or (slope := _slope(measured, command, clocks)) is None:
        return None
    for candidate, factor in (("rad", 1.0), ("deg", _DEG)):
        ratio = slope * (1.0 if unit == "rad" else _DEG) / factor
        if (0.6 if candidate == unit else 0.85) < ratio < (1.5 if candidate == unit else 1.15):
            return candidate, f"its slope over {command.name!r} is {slope:.3g}"
    return None


def _slope(measured: Signal, command: Signal, clocks: Mapping[str, np.ndarray]) -> float | None:
    """Return the median slope of positions over their commands, in their own units; None if they do not follow.

    Raises:
        UsageError: When a joint follows with a slope far from that of the others.
    """
    pairs = []
    for signal, t_s in ((command, clocks["actuator"]), (measured, clocks["sensor"])):
        rows = np.isfinite(signal.values).all(axis=1) & np.isfinite(t_s)
        t, values = t_s[rows], signal.values[rows]
        later = np.concatenate([[True], np.diff(t) > 0]) if len(t) else np.zeros(0, bool)
        pairs.append((t[later], values[later]))
    (t_c, c), (t_q, q) = pairs
    if min(len(t_c), len(t_q)) < 50:
        return None
    c, q = (turns_counted(x) for x in (c, q))
    # Compare in units of each side's usual spread, as the units are open.
    spread = [max(float(np.median(x.std(axis=0))), 1e-9) for x in (c, q)]
    found = checks.respond((t_c, t_q), c / spread[0], q / spread[1])
    if found is None:
        return None
    slopes = {}
    for i in np.flatnonzero((c.std(axis=0) > 0) & (q.std(axis=0) > 0)).tolist():
        r, _, slope, _ = max((found.best(i, i, s) for s in (1.0, -1.0)), key=lambda b: abs(b[0]))
        if abs(r) > 0.8:
            slopes[i] = slope * spread[1] / spread[0]
    if not slopes:
        return None
    median = float(np.median(np.abs(list(slopes.values()))))
    if odd := [i for i, slope in slopes.items() if not 1 / 3 < abs(slope) / median < 3]:
        listed = ", ".join(f"{measured.labels[i] or measured.sources[i]} {slopes[i]:.2g}" for i in odd)
        raise UsageError(
            f"joints follow {command.name!r} with a slope of {median:.3g}, but {listed}: another unit or scale",
            hint="name the other joints with --joints, or give each column its scale in a mapping",
        )
    return median


def turns_counted(values: np.ndarray) -> np.ndarray:
    """Return angles with counted turns, in radians or degrees, where they jump at the end of one."""
    for turn in (2 * np.pi, 360.0):
        if _jumps(values, turn):
            return checks.counted(values, turn)
    return values


def _only_rad(q: np.ndarray, hints: ImportHints) -> bool:
    """Return whether positions are within the joints' ranges in radians alone."""
    if hints.ranges is None or len(hints.ranges) != q.shape[1] or hints.slides:
        return False
    limited = np.ptp(hints.ranges, axis=1) > 0
    low, high = hints.ranges.T
    inside = lambda x: ((np.nanmin(x, 0) > low - 0.2) & (np.nanmax(x, 0) < high + 0.2))[limited]  # noqa: E731
    return bool(limited.any() and inside(q).all() and not inside(q / _DEG).all())


def goal_unit(
    command: Signal, measured: Signal, unit: str, clocks: Mapping[str, np.ndarray], hints: ImportHints, draft: Proposal
) -> str:
    """Return the unit of goals: by name, else that of the positions if the slope between them agrees."""
    at = "actuator", "goal", "unit"
    if hints.unit:
        draft.reasons[at] = "--unit"
        return hints.unit
    named = command.meaning.unit
    if named in _NAMED:
        draft.reasons[at] = "by its name"
        return named
    if named in ("counts", "percent"):
        asked = '"counts:4096"?' if named == "counts" else '"rad" with a scale, as percent of which angle?'
        draft.questions[at] = f"{asked}  # --unit answers, too"
        return ""
    if ("sensor", "position", "unit") in draft.questions:
        draft.questions[at] = (
            draft.questions["sensor", "position", "unit"].partition("  #")[0] + "  # as that of the positions?"
        )
        return ""
    slope = _slope(measured, command, clocks)
    factor, si = in_si(unit) if not unit.startswith("hundredths") else (1.0, "rad")
    if slope is None:
        if unit == "hundredths" or (command.whole and measured.whole and re.sub("action", "", command.whole) == ""):
            draft.reasons[at] = "as the positions"
            return unit
        draft.questions[at] = (
            f'"{unit}" or another?  # no position follows it, so its unit is open; --unit answers, too'
        )
        return ""
    for candidate in dict.fromkeys((unit, "rad", "deg")):
        other = 1.0 if candidate == "hundredths" else in_si(candidate)[0]
        ratio = slope * factor / other
        if (0.5 if candidate == unit else 0.85) < ratio < (1.6 if candidate == unit else 1.15):
            draft.reasons[at] = f"positions follow it with a slope of {slope:.3g}"
            return candidate
    draft.questions[at] = (
        f'"{si}" with a scale?  # positions follow it with a slope of {slope:.3g}: it is in another unit, or scaled'
    )
    return ""


def scales_of(signal: Signal, unit: str, hints: ImportHints) -> dict[str, Any]:
    """Return scale and offset of a signal of LeRobot by the calibration."""
    if hints.calibration is None or unit not in lerobot.UNITS:
        return {}
    scale, offset = lerobot.conversion(hints.calibration, signal.labels, unit)
    return {"scale": tuple(scale), "offset": tuple(offset)}


def turn_of(signal: Signal, unit: str, at: tuple[str, str], draft: Proposal) -> float:
    """Return a turn in the signal's unit if it jumps at its end, else 0."""
    factor, si = in_si(unit)
    if si != "rad" or unit == "hundredths":
        return 0.0
    turn = 2 * np.pi / factor
    rows = signal.values[np.isfinite(signal.values).all(axis=1)]
    if len(rows) < 3 or not checks.turns(rows, turn).any():
        return 0.0
    draft.reasons[(*at, "turn")] = "it jumps at the end of a turn: turns are counted"
    return float(turn)
