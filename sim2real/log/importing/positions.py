"""Checks measured positions: unit, turns, and readings that are impossible for a joint."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence, plausibility
from sim2real.log.importing.evidence import DEGREES
from sim2real.log.importing.files.foreign import ForeignFile
from sim2real.log.importing.files.lerobot import are_degrees
from sim2real.log.importing.pairing import Pair
from sim2real.log.importing.position_unit import units_from_signals
from sim2real.log.importing.quantities import ImportHints, clean
from sim2real.log.importing.signals import Signal, Stamps

_MAX_RAD = 2.2 * np.pi
"""Larger positions are not taken for radians or metres without evidence."""
_FAST_RAD_S, _SMALL_RAD = 30.0, 2.0
"""Positions that would be faster and larger in radians can be in degrees: their unit is ambiguous."""
_SMALL_WAY = 2.0
"""Positions that move farther can be a small motion in degrees, or a large one in radians."""
_MIXED_WAY = 0.3
"""Beside joints in degrees, a joint that moves farther than this, but stays within 3.1, can be in radians."""
_RADIAN_WORDS = {"qpos", "dof"}
"""Names that simulators give to positions in radians."""


@dataclass(frozen=True)
class CheckedPositions:
    """Checked positions.

    Attributes:
        signal: Positions with counted turns, and NaN for readings that leap.
        to_rad: Number of units in a radian.
        turn: A turn in the signal's unit if turns are counted; else 0.
        hinges: Shape ``(joints,)``: whether a joint turns; the others slide.
        leapt: Shape ``(N,)``: whether a reading of the sample leaps away and back.
        notes: Sentences.
    """

    signal: Signal
    to_rad: float
    turn: float
    hinges: np.ndarray
    leapt: np.ndarray
    notes: list[str]


def checked_positions(
    file: ForeignFile, signals: Sequence[Signal], pair: Pair, stamps: Sequence[Stamps], hints: ImportHints
) -> CheckedPositions:
    """Return measured positions with counted turns and without leaps.

    Args:
        pair: Positions, in the order of the joints, and commands.

    Raises:
        UsageError: When the unit is unclear, or positions change faster than a joint can move.
    """
    path, measured, t_s = str(file.path), pair.measured, stamps[0].t_s
    rows = np.flatnonzero(clean(t_s, measured))
    q, t = measured.values[rows], t_s[rows]
    if len(rows) < 3:
        raise UsageError(
            f"{path} has {len(rows)} samples with a number in every column of {measured.name!r}",
            hint="name only the joints with numbers with --joints",
        )
    _refuse_empty_beginning(measured, q, rows, path)
    # Guess the unit from name, jumps by a turn, and size, then find leaps in this unit.
    hinges = hints.hinges(measured.width)
    named = {"rad": 1.0, "deg": DEGREES}.get(measured.meaning.unit)
    jumping = [u for u in (1.0, DEGREES) if named in (None, u) and _over_the_end(q, u, hinges).any()]
    small = np.quantile(np.abs(q[:, hinges]), 0.99) <= _MAX_RAD if hinges.any() else True
    guess = named or next(iter(jumping), 1.0 if small else DEGREES)
    leaps = plausibility.glitches(t, _counted(q, guess, hinges), guess)
    good = ~leaps.any(axis=1)
    _refuse_no_metres(measured, q[good], hinges, hints, path)
    # Determine the unit from all evidence, and count turns in it.
    others: list[tuple[float, str]] = []
    if named is None and not jumping and hinges.all():
        others = units_from_signals(signals, measured, pair.command, [s.t_s for s in stamps], rows[good])
    samples = q[good], t[good]
    to_rad, why = _radian(file, measured, samples, hinges, hints, jumping, others) if hinges.any() else (1.0, "")
    over, values = _over_the_end(q, to_rad, hinges), _counted(measured.values, to_rad, hinges)
    turn, angle = plausibility.TURN_RAD * to_rad, values[rows]
    _refuse_turns(measured, over, angle / to_rad, hints, path)
    if to_rad != guess:
        good = ~(leaps := plausibility.glitches(t, angle, to_rad)).any(axis=1)
    # Refuse a jump without return: the zero has changed, or samples are missing.
    if (jump := plausibility.leap(t[good], angle[good], to_rad)) is not None:
        at, size = rows[good][jump[0]], f"{jump[2]:.4g} {'rad' if hinges[jump[1]] else 'm'}"
        raise UsageError(
            f"{measured.sources[jump[1]]!r} in {path} changes by {size} before sample {at}, at {t_s[at]:.6g} s, faster "
            "than a joint can: its zero has changed, samples are missing, or it is no position",
            hint="cut the file there with --samples A:B, or omit this joint from --joints",
        )
    notes = [f"{measured.name!r} is in {'degrees' if to_rad != 1 else 'radians'}: {why}"] * bool(why)
    if over.any():
        who = ", ".join(np.array(measured.sources)[over])
        notes.append(f"{who} jumps by a turn ({turn:.4g}) at its end: turns are counted")
    leapt = np.zeros(len(t_s), bool)
    leapt[rows[~good]] = True
    if leapt.any():
        notes.append(_on_leaps(measured, rows[~good], leaps[~good]))
        values[leapt] = np.nan
    return CheckedPositions(replace(measured, values=values), to_rad, turn * bool(over.any()), hinges, leapt, notes)


def _refuse_empty_beginning(measured: Signal, q: np.ndarray, rows: np.ndarray, path: str) -> None:
    """Raise a UsageError if all positions are exactly 0 until the first reading."""
    empty = int((q != 0.0).any(axis=1).argmax())
    steps = np.abs(np.diff(q[empty:], axis=0)).max(axis=1)
    if empty > 1 and steps.size and np.abs(q[empty]).max() > 3.0 * steps.max():
        raise UsageError(
            f"{measured.name!r} in {path} is 0 in its first {empty} samples and then {q[empty].round(3).tolist()}: the "
            "recorder had no reading before",
            hint=f"omit these samples with --samples {rows[empty]}: and a mapping, or leave their cells empty",
        )


def _on_leaps(measured: Signal, rows: np.ndarray, leaps: np.ndarray) -> str:
    """Return a note on the rows with readings that leap."""
    k, i = rows[0], int(leaps[0].argmax())
    return (
        f"{len(rows)} samples hold readings that leap away and back, as {measured.sources[i]!r} does to "
        f'{measured.values[k, i]:.4g} in sample {k}: a joint cannot. implausible = "drop" skips them'
    )


def turned_commands(command: Signal, checked: CheckedPositions) -> tuple[Signal, float]:
    """Return commands with counted turns if they are angles on a circle, and a turn in their unit; else 0."""
    named_unit = {"rad": 1.0, "deg": DEGREES}.get(command.meaning.unit)
    whole = checked.signal.values[~np.isnan(checked.signal.values).any(axis=1)]
    reach = np.ptp(whole[:, checked.hinges], axis=0).max(initial=0.0) / checked.to_rad
    for unit in (1.0, DEGREES) if named_unit is None else (named_unit,):
        turn = plausibility.TURN_RAD * unit
        # Do not count turns for a joint that stays within a turn: a jump of its goal is a real motion.
        if plausibility.turns(command.values, turn).any() and (checked.turn or reach > 1.1 * plausibility.TURN_RAD):
            return replace(command, values=plausibility.counted(command.values, turn)), turn
    return command, 0.0


def _radian(
    file: ForeignFile,
    measured: Signal,
    samples: tuple[np.ndarray, np.ndarray],
    hinges: np.ndarray,
    hints: ImportHints,
    jumping: list[float],
    others: Sequence[tuple[float, str]],
) -> tuple[float, str]:
    """Return the number of units in a radian, and the reason, from the file's metadata or the data."""
    path, (q, t_s) = str(file.path), samples
    if are_degrees(file.facts, _names_of(file, measured), q, path):
        return DEGREES, "its steps are those of encoders of 4096 a turn"
    ranges = hints.ranges[hinges] if hints.ranges is not None and len(hints.ranges) == len(hinges) else None
    # Small positions can have either unit, unless the format prescribes one.
    usual = "messages of ROS hold radians" if file.format == "mcap" else ""
    if {w.lower() for w in re.findall("[A-Za-z]+", measured.name)} & _RADIAN_WORDS:
        usual = "simulators that write this name use radians"
    return radian(measured, q[:, hinges], t_s, replace(hints, ranges=ranges), path, jumping, others, usual)


def radian(
    measured: Signal,
    q: np.ndarray,
    t_s: np.ndarray,
    hints: ImportHints,
    path: str,
    jumping: list[float],
    others: Sequence[tuple[float, str]],
    usual: str = "",
) -> tuple[float, str]:
    """Return the number of units in a radian, and the reason.

    Args:
        q: Shape ``(N, joints)``: rows with numbers.
        t_s: Shape ``(N,)``: stamps of these rows [s].
        jumping: Units whose turn is the size of jumps in the positions.
        others: Units from other signals, with the reasons.
        usual: Reason why the file's format has radians; empty without one.

    Raises:
        UsageError: When the unit is unclear.
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
            f"{'; '.join(notes for _, notes in others)}",
            hint="correct their names, or write a mapping with the scales",
        )
    if others:
        return others[0]
    if by_ranges := _by_ranges(q, hints):
        return by_ranges
    return _by_size(measured, q, t_s, path, usual)


def _by_size(measured: Signal, q: np.ndarray, t_s: np.ndarray, path: str, usual: str) -> tuple[float, str]:
    """Return the number of units in a radian from the size and speed of positions, and the reason."""
    largest = float(np.abs(q).max())
    speed = float(np.quantile(np.abs(np.diff(q, axis=0)) / np.diff(t_s)[:, None], 0.99))
    way, slow = float(np.ptp(q, axis=0).max()), speed <= _FAST_RAD_S or largest <= _SMALL_RAD
    if largest <= _MAX_RAD and slow and usual:
        return 1.0, f"it stays within {largest:.3g}, and {usual}"
    if largest <= _MAX_RAD and way <= _SMALL_WAY:
        return 1.0, f"as degrees it would move by {way:.2g} degrees only"
    # A joint that moves by less than a turn in radians could be in radians beside others in degrees.
    mixed = [i for i, x in enumerate(q.T) if np.ptp(x) > _MIXED_WAY and np.abs(x).max() <= np.pi]
    if mixed and largest > 30.0:
        listed = ", ".join(f"{measured.sources[i]} moves by {np.ptp(q[:, i]):.3g}" for i in mixed[:3])
        raise UsageError(
            f"are all joints of {measured.name!r} in {path} in degrees? They reach {largest:.4g}, but {listed}",
            hint="end all names with the unit, as in q_deg, give the robot's model with --mjcf, or write a mapping",
        )
    if 30.0 < largest <= 400.0 and speed > 2.0 * _FAST_RAD_S:
        return DEGREES, f"as radians it would move at {speed:.3g} rad/s"
    # A joint that turns without limit has such values also in radians.
    turns_on = np.abs(q[-1] - q[0]).max() > 0.7 * np.ptp(q, axis=0).max()
    if 30.0 < largest <= 400.0 and np.abs(np.median(q, axis=0)).max() <= 200.0 and not turns_on:
        return DEGREES, f"it reaches {largest:.3g}, more than a turn in radians"
    raise UsageError(
        f"is {measured.name!r} in {path} in radians or degrees? It reaches {largest:.4g}, at up to {speed:.3g} a "
        "second. Candidates: rad, deg",
        hint="end its name with the unit, as in q_rad, give the robot's model with --mjcf, or write a mapping with a "
        "scale",
    )


def _counted(values: np.ndarray, to_rad: float, hinges: np.ndarray) -> np.ndarray:
    """Return positions with counted turns of the joints that turn, ``(N, joints)``."""
    counted = np.array(values, np.float64)
    counted[:, hinges] = plausibility.counted(values[:, hinges], plausibility.TURN_RAD * to_rad)
    return counted


def _over_the_end(values: np.ndarray, to_rad: float, hinges: np.ndarray) -> np.ndarray:
    """Return whether a joint jumps at the end of a turn, ``(joints,)``."""
    return plausibility.turns(values, plausibility.TURN_RAD * to_rad) & hinges


def _refuse_no_metres(measured: Signal, q: np.ndarray, hinges: np.ndarray, hints: ImportHints, path: str) -> None:
    """Raise a UsageError if a slide's positions cannot be metres, by its range or their size."""
    for i in np.flatnonzero(~hinges):
        low, high = hints.ranges[i] if hints.ranges is not None else (0.0, 0.0)
        # Compare ranges, as log and model can have different zeros.
        way = float(np.ptp(np.quantile(q[:, i], (0.02, 0.98))))
        far = way > 1.1 * (high - low) if low < high else np.abs(q[:, i]).max() > _MAX_RAD
        if far or (measured.meaning.unit == "deg" and not hinges.any()):
            limits = f", and its range is {low:.3g} to {high:.3g} m" if low < high else ""
            raise UsageError(
                f"{hints.joints[i]} slides, but {measured.sources[i]!r} in {path} is not in metres: it goes from "
                f"{q[:, i].min():.4g} to {q[:, i].max():.4g}{limits}",
                hint="write a mapping with the scales to m and to rad: 0.001 for mm, 0.0174533 for degrees",
            )


def _names_of(file: ForeignFile, signal: Signal) -> list[str]:
    """Return the names of a signal's columns as the file has them."""
    names = file.columns.get(signal.sources[0].partition("[")[0], ())
    places = [s.rpartition("[:,")[2].rstrip("]") for s in signal.sources]
    return [
        names[int(p)] if p.isdigit() and int(p) < len(names) else s for p, s in zip(places, signal.sources, strict=True)
    ]


def _by_ranges(q: np.ndarray, hints: ImportHints) -> tuple[float, str] | None:
    """Return the number of units in a radian, and the reason, if positions fit the joints' ranges in one unit only."""
    if hints.ranges is None or len(hints.ranges) != q.shape[1]:
        return None
    low, high = hints.ranges.T
    limited = high > low
    room = 0.1 * (high - low)
    inside = {u: ((q / u > low - room) & (q / u < high + room))[:, limited] for u in (1.0, DEGREES)}
    share = {u: float(rows.mean()) if limited.any() else 1.0 for u, rows in inside.items()}
    if share[1.0] < 0.9 < share[DEGREES]:
        return DEGREES, f"as radians {1 - share[1.0]:.0%} of it would lie outside of the joints' ranges"
    if share[DEGREES] < 0.9 < share[1.0]:
        return 1.0, f"as degrees {1 - share[DEGREES]:.0%} of it would lie outside of the joints' ranges"
    return None


def _refuse_turns(measured: Signal, over: np.ndarray, angle_rad: np.ndarray, hints: ImportHints, path: str) -> None:
    """Raise a UsageError if a joint jumps by a turn and would leave the range of the model's joint."""
    if hints.ranges is None or len(hints.ranges) != len(over):
        return
    for i in np.flatnonzero(over):
        low, high = hints.ranges[i]
        if low < high and np.ptp(angle_rad[:, i]) > 1.1 * (high - low):
            raise UsageError(
                f"{measured.sources[i]!r} in {path} jumps by a turn, but the range of its joint is {low:.3g} to "
                f"{high:.3g} rad",
                hint="check the order: --joints names joints in the order of the columns",
            )
