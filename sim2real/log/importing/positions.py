"""Measured positions: their unit, turns that are to be counted, and readings that no joint can have had."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence, plausibility
from sim2real.log.importing.evidence import DEGREES
from sim2real.log.importing.files.foreign import ForeignFile
from sim2real.log.importing.files.lerobot import are_degrees
from sim2real.log.importing.pairing import Pair
from sim2real.log.importing.position_unit import told_units
from sim2real.log.importing.quantities import Asked, clean
from sim2real.log.importing.signals import Signal, Stamps

_MOST_RAD = 2.2 * np.pi
"""What reaches farther is not taken for radians, nor for metres, without evidence."""
_FAST_RAD_S, _SMALL_RAD = 30.0, 2.0
"""What moves faster, as radians, and farther is asked about: it may be in degrees."""


@dataclass(frozen=True)
class CheckedPositions:
    """Positions that can be believed.

    Attributes:
        signal: With turns counted, and NaN in readings that leap.
        to_rad: How many units a radian is.
        turn: A turn in the signal's unit, where turns are counted; else 0.
        hinges: Shape ``(joints,)``: which joints turn; the others slide.
        leapt: Shape ``(N,)``: whether a reading of the sample leaps away and back.
        said: What was found: sentences.
    """

    signal: Signal
    to_rad: float
    turn: float
    hinges: np.ndarray
    leapt: np.ndarray
    said: list[str]


def checked_positions(
    file: ForeignFile, signals: Sequence[Signal], pair: Pair, stamps: Sequence[Stamps], asked: Asked
) -> CheckedPositions:
    """Return measured positions with their turns counted and without leaps.

    Args:
        pair: Positions, in the order of the joints, and what was commanded.

    Raises:
        UsageError: When the unit is not clear, or positions change by more than a joint can move.
    """
    path, measured, t_s = str(file.path), pair.measured, stamps[0].t_s
    rows = np.flatnonzero(clean(t_s, measured))
    q, t = measured.values[rows], t_s[rows]
    if len(rows) < 3:
        raise UsageError(
            f"{path} has {len(rows)} samples with a number in every column of {measured.name!r}",
            hint="leave out the joint that lacks them: --joints names those that count",
        )
    hinges = asked.hinges(measured.width)
    named = {"rad": 1.0, "deg": DEGREES}.get(measured.meaning.unit)
    jumping = [u for u in (1.0, DEGREES) if named in (None, u) and _over_the_end(q, u, hinges).any()]
    small = np.quantile(np.abs(q[:, hinges]), 0.99) <= _MOST_RAD if hinges.any() else True
    guess = named or next(iter(jumping), 1.0 if small else DEGREES)
    leaps = plausibility.glitches(t, _counted(q, guess, hinges), guess)
    kept = ~leaps.any(axis=1)
    _refuse_no_metres(measured, q[kept], hinges, asked, path)
    others: list[tuple[float, str]] = []
    if named is None and not jumping and hinges.all():
        others = told_units(signals, measured, pair.command, [s.t_s for s in stamps], rows[kept])
    samples = q[kept], t[kept]
    to_rad, why = _radian(file, measured, samples, hinges, asked, jumping, others) if hinges.any() else (1.0, "")
    over, values = _over_the_end(q, to_rad, hinges), _counted(measured.values, to_rad, hinges)
    turn, angle = plausibility.TURN_RAD * to_rad, values[rows]
    _refuse_turns(measured, over, angle / to_rad, asked, path)
    if to_rad != guess:
        kept = ~(leaps := plausibility.glitches(t, angle, to_rad)).any(axis=1)
    if (jump := plausibility.leap(t[kept], angle[kept], to_rad)) is not None:
        at, size = rows[kept][jump[0]], f"{jump[2]:.4g} {'rad' if hinges[jump[1]] else 'm'}"
        raise UsageError(
            f"{measured.sources[jump[1]]!r} in {path} changes by {size} before sample {at}, at {t_s[at]:.6g} s, as no "
            "joint can: its zero has changed, samples are missing, or it is no position",
            hint="cut the file there with --samples A:B, or leave this joint out",
        )
    said = [f"{measured.name!r} is in {'degrees' if to_rad != 1 else 'radians'}: {why}"] * bool(why)
    if over.any():
        who = ", ".join(np.array(measured.sources)[over])
        said.append(f"{who} jumps by a turn ({turn:.4g}) at its end: turns are counted")
    leapt = np.zeros(len(t_s), bool)
    leapt[rows[~kept]] = True
    if leapt.any():
        said.append(_on_leaps(measured, rows[~kept], leaps[~kept]))
        values[leapt] = np.nan
    return CheckedPositions(replace(measured, values=values), to_rad, turn * bool(over.any()), hinges, leapt, said)


def _on_leaps(measured: Signal, rows: np.ndarray, leaps: np.ndarray) -> str:
    """Return what to say of these rows, in which readings leap."""
    k, i = rows[0], int(leaps[0].argmax())
    return (
        f"{len(rows)} samples hold readings that leap away and back, as {measured.sources[i]!r} does to "
        f'{measured.values[k, i]:.4g} in sample {k}: no joint can. implausible = "drop" leaves them out'
    )


def turned_commands(command: Signal, checked: CheckedPositions) -> tuple[Signal, float]:
    """Return commands with their turns counted, where they are angles on a circle, and a turn in their unit; else 0."""
    known = {"rad": 1.0, "deg": DEGREES}.get(command.meaning.unit)
    whole = checked.signal.values[~np.isnan(checked.signal.values).any(axis=1)]
    reach = np.ptp(whole[:, checked.hinges], axis=0).max(initial=0.0) / checked.to_rad
    for unit in (1.0, DEGREES) if known is None else (known,):
        turn = plausibility.TURN_RAD * unit
        # A joint within a turn may well be sent from one end to the other: then it goes all the way.
        if plausibility.turns(command.values, turn).any() and (checked.turn or reach > 1.1 * plausibility.TURN_RAD):
            return replace(command, values=plausibility.counted(command.values, turn)), turn
    return command, 0.0


def _radian(
    file: ForeignFile,
    measured: Signal,
    samples: tuple[np.ndarray, np.ndarray],
    hinges: np.ndarray,
    asked: Asked,
    jumping: list[float],
    others: Sequence[tuple[float, str]],
) -> tuple[float, str]:
    """Return how many units a radian is, and how that is known, by what the file says of itself or by the data."""
    path, (q, t_s) = str(file.path), samples
    if are_degrees(file.facts, _names_of(file, measured), q, path):
        return DEGREES, "its steps are those of encoders of 4096 a turn"
    ranges = asked.ranges[hinges] if asked.ranges is not None and len(asked.ranges) == len(hinges) else None
    return radian(measured, q[:, hinges], t_s, replace(asked, ranges=ranges), path, jumping, others)


def radian(
    measured: Signal,
    q: np.ndarray,
    t_s: np.ndarray,
    asked: Asked,
    path: str,
    jumping: list[float],
    others: Sequence[tuple[float, str]],
) -> tuple[float, str]:
    """Return how many units a radian is, and how that is known.

    Args:
        q: Shape ``(N, joints)``: those rows of them that have numbers.
        t_s: Shape ``(N,)``: their stamps [s].
        path: The file, for errors.
        jumping: Units in a radian by whose turn the positions jump.
        others: Units in a radian by other signals, and how they say so.

    Raises:
        UsageError: When it is not clear.
    """
    if measured.meaning.unit in ("rad", "deg"):
        return (1.0 if measured.meaning.unit == "rad" else DEGREES), "by its name"
    if len(jumping) == 1:
        return jumping[0], f"it jumps by a turn of {2 * np.pi * jumping[0]:.4g}"
    encoders = [e for column in q.T if (e := evidence.turn(column))]
    kinds = {unit for unit, _ in encoders}
    if len(kinds) == 1:
        return (1.0 if kinds == {"rad"} else DEGREES), f"its steps are those of an encoder of {encoders[0][1]} a turn"
    if len({unit for unit, _ in others}) > 1:
        raise UsageError(
            f"is {measured.name!r} in {path} in radians or degrees? Other signals contradict each other: "
            f"{'; '.join(said for _, said in others)}",
            hint="correct their names, or write a mapping with the scales",
        )
    if others:
        return others[0]
    if told := _by_ranges(q, asked):
        return told
    most = float(np.abs(q).max())
    speed = float(np.quantile(np.abs(np.diff(q, axis=0)) / np.diff(t_s)[:, None], 0.99))
    if most <= _MOST_RAD and (speed <= _FAST_RAD_S or most <= _SMALL_RAD):
        return 1.0, f"it stays within {most:.3g}"
    if 30.0 < most <= 400.0 and speed > 2.0 * _FAST_RAD_S:
        return DEGREES, f"as radians it would move at {speed:.3g} rad/s"
    # A joint that turns on and on reaches as much in radians.
    onward = np.abs(q[-1] - q[0]).max() > 0.7 * np.ptp(q, axis=0).max()
    if 30.0 < most <= 400.0 and np.abs(np.median(q, axis=0)).max() <= 200.0 and not onward:
        return DEGREES, f"it reaches {most:.3g}, more than a turn in radians"
    raise UsageError(
        f"is {measured.name!r} in {path} in radians or degrees? It reaches {most:.4g}, at up to {speed:.3g} a second. "
        "Candidates: rad, deg",
        hint="end its name with the unit, as in q_rad, or write a mapping with a scale",
    )


def _counted(values: np.ndarray, to_rad: float, hinges: np.ndarray) -> np.ndarray:
    """Return positions whose turns are counted, where they are angles, ``(N, joints)``."""
    found = np.array(values, np.float64)
    found[:, hinges] = plausibility.counted(values[:, hinges], plausibility.TURN_RAD * to_rad)
    return found


def _over_the_end(values: np.ndarray, to_rad: float, hinges: np.ndarray) -> np.ndarray:
    """Return which joints jump at the end of a turn, ``(joints,)``."""
    return plausibility.turns(values, plausibility.TURN_RAD * to_rad) & hinges


def _refuse_no_metres(measured: Signal, q: np.ndarray, hinges: np.ndarray, asked: Asked, path: str) -> None:
    """Refuse positions of slides in another unit than metres.

    Raises:
        UsageError: When a slide's range, or what is usual, says that they are none.
    """
    for i in np.flatnonzero(~hinges):
        low, high = asked.ranges[i] if asked.ranges is not None else (0.0, 0.0)
        # A log may count from another zero than the model.
        way = float(np.ptp(np.quantile(q[:, i], (0.02, 0.98))))
        far = way > 1.1 * (high - low) if low < high else np.abs(q[:, i]).max() > _MOST_RAD
        if far or (measured.meaning.unit == "deg" and not hinges.any()):
            limits = f", and its range is {low:.3g} to {high:.3g} m" if low < high else ""
            raise UsageError(
                f"{asked.joints[i]} slides, but {measured.sources[i]!r} in {path} is not in metres: it goes from "
                f"{q[:, i].min():.4g} to {q[:, i].max():.4g}{limits}",
                hint="write a mapping with the scales to m and to rad: 0.001 for mm, 0.0174533 for degrees",
            )


def _names_of(file: ForeignFile, signal: Signal) -> list[str]:
    """Return the names of a signal's columns as the file has them."""
    own = file.columns.get(signal.sources[0].partition("[")[0], ())
    places = [s.rpartition("[:,")[2].rstrip("]") for s in signal.sources]
    return [
        own[int(p)] if p.isdigit() and int(p) < len(own) else s for p, s in zip(places, signal.sources, strict=True)
    ]


def _by_ranges(q: np.ndarray, asked: Asked) -> tuple[float, str] | None:
    """Return how many units a radian is where positions fit the joints' ranges in one unit only, and what to say."""
    if asked.ranges is None or len(asked.ranges) != q.shape[1]:
        return None
    low, high = asked.ranges.T
    known = high > low
    room = 0.1 * (high - low)
    inside = {u: ((q / u > low - room) & (q / u < high + room))[:, known] for u in (1.0, DEGREES)}
    share = {u: float(rows.mean()) if known.any() else 1.0 for u, rows in inside.items()}
    if share[1.0] < 0.9 < share[DEGREES]:
        return DEGREES, f"as radians {1 - share[1.0]:.0%} of it would lie outside of the joints' ranges"
    if share[DEGREES] < 0.9 < share[1.0]:
        return 1.0, f"as degrees {1 - share[DEGREES]:.0%} of it would lie outside of the joints' ranges"
    return None


def _refuse_turns(measured: Signal, over: np.ndarray, angle_rad: np.ndarray, asked: Asked, path: str) -> None:
    """Refuse jumps by a turn of a joint that cannot turn.

    Raises:
        UsageError: When a model's joint has a range, which it would leave.
    """
    if asked.ranges is None or len(asked.ranges) != len(over):
        return
    for i in np.flatnonzero(over):
        low, high = asked.ranges[i]
        if low < high and np.ptp(angle_rad[:, i]) > 1.1 * (high - low):
            raise UsageError(
                f"{measured.sources[i]!r} in {path} jumps by a turn, but the range of its joint is {low:.3g} to "
                f"{high:.3g} rad",
                hint="is it this joint's column? --joints names joints in the order of the columns",
            )
