"""Finds measurements and commands among the signals of a file, by their names or by their lag."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing.command_response import following, on_grid
from sim2real.log.importing.signal_names import OTHER_UNITS, Meaning, same_joint
from sim2real.log.importing.signals import Signal, find_stamps

_SURE = 0.8
_MAX_UNNAMED, _MAX_LISTED = 50, 20
_KINDS = ("position", "velocity", "torque", "duty", "voltage")


@dataclass(frozen=True)
class Pair:
    """Measured positions and their commands.

    Attributes:
        measured: Positions.
        command: Commands with the same or a larger number of columns.
        kind: ``position``, ``velocity``, ``torque``, ``duty`` or ``voltage``; empty if the names do not determine it.
        notes: Sentences on the evidence.
    """

    measured: Signal
    command: Signal
    kind: str
    notes: tuple[str, ...]


def find_pair(signals: Sequence[Signal], path: str, rate_hz: float | None, joints: Sequence[str] = ()) -> Pair:
    """Return measured positions and their commands.

    Args:
        rate_hz: Rate of samples without stamps [Hz].
        joints: Names of the robot's joints; empty if unknown.

    Raises:
        UsageError: When there are no candidates, or several; the message lists them.
    """
    series = [
        s for s in signals if s.values.ndim == 2 and s.width and s.meaning.quantity != "stamp" and len(s.values) > 2
    ]
    varying = [s for s in series if _varies(s)] or series
    measured, command = _by_names(series, varying, path, joints)
    if measured is not None and command is not None:
        names = f"{measured.name!r} is measured and {command.name!r} commanded, by their names"
        return Pair(measured, command, _kind(command), (names,))
    unnamed = [s for s in varying if s.meaning == Meaning(label=s.meaning.label) and s is not measured and _moves(s)]
    if measured is None and command is None:
        return _by_data(_together(unnamed), path, rate_hz, signals)
    # One of both has a name: search the other among unnamed signals that correlate with it.
    named_signal, side = (measured, "command") if measured is not None else (command or varying[0], "measured position")
    followers = [
        s for s in _together(unnamed) if s.width == named_signal.width and len(s.values) == len(named_signal.values)
    ]
    linked = [s for s in followers if _link(s, named_signal, signals, path, rate_hz)[0] > _SURE]
    other = _one(linked, side, path)
    if other is None:
        named = [s for s in varying if s.meaning.quantity in ("torque", "duty") and s.meaning.side == ""]
        other = _one(named, side, path) if measured is not None else None
    if other is None:
        torques = [s for s in varying if (s.meaning.side, s.meaning.quantity) == ("measured", "torque")]
        no_command = f". A measured torque is no command: {_names(torques)}" if torques and side == "command" else ""
        raise UsageError(
            f"no signal of {path} is a {side} by its name or by the data{no_command}. Available: {_names(signals)}",
            hint="write quantity and side into the names of columns, as in q_rad and goal_rad, or write a mapping",
        )
    r, _ = _link(other, named_signal, signals, path, rate_hz)
    if measured is None:
        note = f"{other.name!r} follows {named_signal.name!r} (r {r:.2f}), so it is measured"
        return Pair(other, named_signal, _kind(named_signal), (note,))
    note = f"{measured.name!r} follows {other.name!r} (r {r:.2f}), which is the command"
    return Pair(measured, other, _kind(other), (note,))


def _by_names(
    series: Sequence[Signal], varying: Sequence[Signal], path: str, joints: Sequence[str]
) -> tuple[Signal | None, Signal | None]:
    """Return measured positions and commands that have names of such; None for each without one."""
    positions = [s for s in series if s.meaning.quantity == "position" and s.meaning.side != "command"]
    positions = positions or [s for s in series if s.meaning.side == "measured" and not s.meaning.quantity]
    named = [s for s in series if s.meaning.side == "command" and s.meaning.quantity in ("", *_KINDS)]
    # Take a command that never changes if there is no other: `check` reports it.
    commands = [s for s in named if any(s is other for other in varying)] or named
    # Prefer goals: a feed-forward beside a goal is no separate command.
    goals = [s for s in commands if s.meaning.quantity in ("", "position")]
    if not joints and len(goals or commands) == 1:
        joints = (goals or commands)[0].labels  # commanded joints are measured
        joints = joints if all(joints) else ()
    measured = _one(_of_joints(positions, joints), "measured position", path)
    command = _one(_of_joints(goals or commands, joints), "command", path)
    for chosen in (measured, command):
        if chosen is not None and chosen.meaning.unit in OTHER_UNITS:
            raise UsageError(
                f"{chosen.name!r} in {path} is in {chosen.meaning.unit} by its name",
                hint="convert it to radians or degrees, or write a mapping with a scale",
            )
    return measured, command


def _kind(command: Signal) -> str:
    return command.meaning.quantity if command.meaning.quantity in _KINDS else ""


def _one(fitting: Sequence[Signal], what: str, path: str) -> Signal | None:
    """Return the only candidate, or the only one with the better name; None without candidates."""
    # Narrow the candidates by the quality of their names.
    for better in (
        lambda s: True, lambda s: s.meaning.unit != "raw", lambda s: s.meaning.side != "",
        lambda s: s.meaning.unit != "", lambda s: s.meaning.quantity != "",
    ):  # fmt: skip
        left = [s for s in fitting if better(s)]
        fitting = left or fitting
        if len(fitting) == 1:
            return fitting[0]
    if not fitting:
        return None
    raise UsageError(
        f"which signal of {path} is the {what}? Candidates: {', '.join(repr(s.name) for s in fitting)}",
        hint="name the joints with --joints, write a mapping, or remove the other signals from the file",
    )


def _of_joints(signals: Sequence[Signal], joints: Sequence[str]) -> Sequence[Signal]:
    """Return the signals whose names have all the joints; all signals if no signal has them."""
    if not joints or len(signals) < 2:
        return signals
    return [
        s for s in signals if all(any(same_joint(label, joint) for label in s.labels) for joint in joints)
    ] or signals


def _varies(signal: Signal) -> bool:
    columns = [column[np.isfinite(column)] for column in signal.values.T]
    return any(column.size and np.ptp(column) > 0 for column in columns)


def _moves(signal: Signal) -> bool:
    good = signal.values[signal.finite]
    return bool(len(good) and (good.std(axis=0) > 0).any() and not (np.diff(good[:, 0]) > 0).all())


def _together(signals: Sequence[Signal]) -> list[Signal]:
    """Return the signals, and all single columns of one length as a further signal."""
    single: dict[int, list[Signal]] = {}
    for s in signals:
        if s.width == 1:
            single.setdefault(len(s.values), []).append(s)
    rows = [_joined(group) for group in single.values() if len(group) > 1]
    return [*signals, *rows]


def _joined(parts: Sequence[Signal]) -> Signal:
    sources, labels = (sum((getattr(p, name) for p in parts), ()) for name in ("sources", "labels"))
    return Signal(sources, labels, Meaning(), np.concatenate([p.values for p in parts], axis=1))


def _link(a: Signal, b: Signal, signals: Sequence[Signal], path: str, rate_hz: float | None) -> tuple[float, float]:
    """Return the least correlation of the moving columns of two signals, and the delay of ``a`` [s]."""
    t = find_stamps(signals, a, "measured", path, rate_hz).t_s
    good = a.finite & b.finite & np.isfinite(t)
    good[1:] &= np.diff(np.maximum.accumulate(np.where(np.isfinite(t), t, -np.inf))) > 0
    held, joined, period = on_grid(t[good], b.values[good], t[good], a.values[good])
    relation = following(held, joined, period)
    best = np.abs(relation.r).max(axis=1)
    if not (best > 0).any():
        return 0.0, 0.0
    at = np.arange(len(best)), np.abs(relation.r).argmax(axis=1)
    return float(best[best > 0].min()), float(np.median(relation.lag_s[at][best > 0]))


def _by_data(candidates: Sequence[Signal], path: str, rate_hz: float | None, signals: Sequence[Signal]) -> Pair:
    """Return the pair among signals without meaningful names: the one that follows is measured, the other commanded."""
    if len(candidates) > _MAX_UNNAMED:
        raise UsageError(
            f"names in {path} do not distinguish measurements and commands, and {len(candidates)} signals are "
            f"too many to compare each with each (at most {_MAX_UNNAMED}): {_names(candidates)}",
            hint="write quantity and side into the names of columns, as in q_rad and goal_rad, or write a mapping",
        )
    pairs = []
    for i, a in enumerate(candidates):
        for b in candidates[:i]:
            if a.width == b.width and len(a.values) == len(b.values):
                r, lag = _link(a, b, signals, path, rate_hz)
                if r > _SURE:
                    pairs.append((a, b, r, lag))
    pairs += [
        pair for s in candidates if s.width > 2 and s.width % 2 == 0 and (pair := _halves(s, signals, path, rate_hz))
    ]
    # Take the widest pair: a pair of single columns is a part of it.
    widest = max((a.width for a, *_ in pairs), default=0)
    pairs = [f for f in pairs if f[0].width == widest]
    if len(pairs) != 1:
        listed = "; ".join(f"{a.name} and {b.name}" for a, b, *_ in pairs[:_MAX_LISTED]) or _names(signals)
        raise UsageError(
            f"names in {path} do not distinguish measurements and commands, "
            f"and {'several pairs follow each other' if pairs else 'no signal follows another'}. Candidates: {listed}",
            hint="write quantity and side into the names of columns, as in q_rad and goal_rad, or write a mapping",
        )
    a, b, r, lag = pairs[0]
    if abs(lag) < 1e-9:
        raise UsageError(
            f"{a.name!r} and {b.name!r} in {path} move alike at the same time: which one is the command?",
            hint="write quantity and side into the names of columns, as in q_rad and goal_rad, or write a mapping",
        )
    measured, command = (a, b) if lag > 0 else (b, a)
    note = f"{measured.name!r} follows {command.name!r} {1e3 * abs(lag):.0f} ms later (r {r:.2f}), so it is measured"
    return Pair(replace(measured, meaning=replace(measured.meaning, quantity="position")), command, "position", (note,))


def _halves(
    signal: Signal, signals: Sequence[Signal], path: str, rate_hz: float | None
) -> tuple[Signal, Signal, float, float] | None:
    """Split columns into leaders and followers if each has a partner that is closest in both directions; else None."""
    t = find_stamps(signals, signal, "measured", path, rate_hz).t_s
    good = signal.finite
    held, joined, period = on_grid(t[good], signal.values[good], t[good], signal.values[good])
    relation = following(held, joined, period)
    distance = relation.distance() + np.diag(np.full(signal.width, np.inf))
    # Each column needs a partner, and half of the columns must follow theirs.
    partner = distance.argmin(axis=1)
    places = np.arange(signal.width)
    r = np.abs(relation.r[places, partner])
    if not (partner[partner] == places).all() or r.min() < _SURE:
        return None
    late = relation.lag_s[places, partner] > 0
    if late.sum() * 2 != signal.width:
        return None
    followers = places[late]
    parts = [
        Signal(tuple(signal.sources[i] for i in at), ("",) * len(at), Meaning(), signal.values[:, at])
        for at in (followers, partner[followers])
    ]  # fmt: skip
    return parts[0], parts[1], float(r.min()), float(np.median(relation.lag_s[followers, partner[followers]]))


def _names(signals: Sequence[Signal]) -> str:
    more = f" and {len(signals) - _MAX_LISTED} more" if len(signals) > _MAX_LISTED else ""
    return ", ".join(repr(s.name) for s in signals[:_MAX_LISTED]) + more or "nothing"
