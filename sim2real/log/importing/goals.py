"""Goals: order, signs and unit of the commands, and ambiguities of commands that repeat."""

from collections.abc import Sequence

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import Following, following, on_grid
from sim2real.log.importing.evidence import DEGREES, SURE
from sim2real.log.importing.quantities import taken
from sim2real.log.importing.signals import Signal

_MIN_GOAL_R = 0.9
"""A command without a name is a goal from this correlation on."""
_SAME_S = 0.01
"""Lags of one robot's joints differ by at most this [s], plus two samples."""
_LIKELY_S = 0.3
"""A servo follows its command within this lag [s]; none is later by twice of it."""
_MAX_COMMON_S = 0.5
"""Largest common lag of several joints [s]: beyond, lags of periodic commands agree by chance."""
_SCALED = 0.5, 1.6
"""A position that follows a command closely has a slope between these, unless the command is scaled."""
_MIN_SLOPE = 0.15
"""A position follows a command from this slope on, in one unit."""
KEEP_ORDER_HINT = (
    "--as-told keeps the names, order and signs of the file; correct them in import.toml, which is written beside the "
    "log. A motion that does not repeat, such as a chirp, avoids the ambiguity"
)


def follows(relation: Following, command: Signal, path: str) -> bool:
    """Return whether positions follow a command whose name has no quantity.

    Raises:
        UsageError: When they follow it weakly, so that it is neither a goal nor unrelated.
    """
    best, moved = np.abs(relation.r).max(axis=1), relation.moved.any(axis=1)
    slopes = _slopes(relation)[moved & (best > _MIN_GOAL_R)]
    ratio = evidence.unit_ratio(slopes)
    size = float(np.median(np.abs(slopes))) / (ratio or 1.0) if slopes.size else 1.0
    # Positions that follow closely, at another size, follow a scaled quantity.
    if len(slopes) > 0.5 * moved.sum() and (ratio is None or not _SCALED[0] < size < _SCALED[1]):
        raise UsageError(
            f"positions in {path} follow {command.name!r} (r {np.median(best[moved]):.2f}), but with slopes of "
            f"{', '.join(f'{x:.3g}' for x in slopes[:3])}: it is scaled, or commands no position",
            hint="write its quantity and unit into its name, as in goal_rad, duty or torque, or write a mapping with "
            "the scale and the offset that its maker gives",
        )
    if not moved.any() or evidence.unit_ratio(_slopes(relation)[best > SURE]) is None:
        return False
    if np.mean(best[moved] > _MIN_GOAL_R) > 0.5:
        return True
    if np.mean(best[moved] > SURE) > 0.5:
        raise UsageError(
            f"does {command.name!r} in {path} command positions? They follow it, but not closely (r "
            f"{np.median(best[moved]):.2f}). Candidates: goal, duty, torque",
            hint="write its quantity into its name, as in goal_rad, duty or torque, or write a mapping",
        )
    return False


def goal(
    measured: Signal, command: Signal, relation: Following, to_rad: float, path: str, as_told: bool
) -> tuple[Signal, list[float], list[str]]:
    """Return goals in the order of the joints, their scales, and notes on them.

    Args:
        as_told: Keep order and signs of the file if they are ambiguous.

    Raises:
        UsageError: When names and data contradict each other, or order or sign are ambiguous.
    """
    # Determine the unit from the slope, or from the name if the slope is too weak.
    slopes = _slopes(relation)
    ratio = evidence.unit_ratio(slopes[np.abs(relation.r).max(axis=1) > SURE])
    named_unit = {"rad": 1.0, "deg": DEGREES}.get(command.meaning.unit)
    if ratio is None and named_unit is None:
        raise UsageError(
            f"{measured.name!r} follows {command.name!r} in {path}, but not with a slope of radians or degrees: "
            f"slopes {', '.join(f'{s:.3g}' for s in slopes[:6])}",
            hint="write a mapping with the scale that its maker gives",
        )
    unit = to_rad / (ratio or to_rad / (named_unit or 1.0))
    if not np.isclose(unit, (1.0, DEGREES)).any():
        raise UsageError(
            f"{measured.name!r} in {path}, in {'degrees' if to_rad != 1 else 'radians'}, follows {command.name!r} with "
            f"slopes of {slopes[:3].round(4)}: then that is neither in radians nor in degrees",
            hint="end both names with their units, as in q_rad and goal_deg, or write a mapping with the scales",
        )
    if named_unit is not None and ratio is not None and not np.isclose(named_unit, unit):
        raise UsageError(
            f"{command.name!r} in {path} is in {command.meaning.unit} by its name, but {measured.name!r}, in "
            f"{'degrees' if to_rad != 1 else 'radians'}, follows it with slopes of {slopes[:3].round(3)}",
            hint="write a mapping with the scales that hold",
        )
    # Order the commands by joints, and determine their signs.
    places, notes = _command_order(measured, command, relation, to_rad / unit, path, as_told)
    ordered = relation.columns(places).by_level(to_rad / unit)
    r, slope, lag = (np.diag(a) for a in (ordered.r, ordered.slope, ordered.lag_s))
    sure = (np.abs(r) > SURE) & (np.abs(slope) * unit / to_rad > _MIN_SLOPE)
    flipped = sure & (r < 0)
    names = [label or str(i) for i, label in enumerate(measured.labels)]
    notes += _signs(names, ordered, sure, path, as_told)
    notes += _too_early(names, ordered, sure, unit / to_rad, path, as_told)
    # Scale to radians with the sign, and describe the evidence.
    scales = [float(-1 / unit if f else 1 / unit) for f in flipped]
    if sure.any():
        notes.append(
            f"{measured.name!r} follows {command.name!r}: r {np.abs(r[sure]).min():.2f} to {np.abs(r[sure]).max():.2f},"
            f" {_ms(np.median(lag[sure]))} ms later, slope {np.median(np.abs(slope[sure])):.3g}"
            + (": one is in degrees" if ratio not in (1.0, None) else "")
        )
    if flipped.any():
        notes.append(f"opposite signs, commands are turned: {', '.join(np.array(names)[flipped])}")
    if (~sure).any():
        weak = ", ".join(f"{n} ({x:.2f})" for n, x, s in zip(names, r, sure, strict=True) if not s)
        notes.append(f"no evidence of order and sign for {weak}: these joints hardly move, or do not follow")
    return taken(command, places), scales, notes


def _signs(names: Sequence[str], ordered: Following, sure: np.ndarray, path: str, as_told: bool) -> list[str]:
    """Return notes on commands that repeat; raise a UsageError if a sign is ambiguous."""
    lag, against, repeats = (np.diag(a) for a in (ordered.lag_s, ordered.against_s, ordered.repeats_s))
    # The sign of the file stands where its lag is that of a servo, and that of the opposite sign is not.
    likely = (np.diag(ordered.r) > 0) & (lag <= _LIKELY_S) & (against > 2.0 * _LIKELY_S)
    repeated = _open_signs(ordered, sure)
    ambiguous = repeated & ~likely
    if ambiguous.any():
        listed = "; ".join(
            f"{names[i]} follows {_ms(lag[i])} ms later, or with the opposite sign {_ms(against[i])} ms later"
            for i in np.flatnonzero(ambiguous).tolist()
        )
        why = f"repeat, so their signs are ambiguous: {listed}"
        if not as_told:
            raise UsageError(f"the commands of {path} {why}", hint=KEEP_ORDER_HINT)
        return [f"the commands {why}; the signs of the file are kept"]
    if repeated.any():
        first = int(np.flatnonzero(repeated)[0])
        return [
            f"commands repeat: {names[first]} follows {_ms(lag[first])} ms later, or with the opposite sign "
            f"{_ms(against[first])} ms later, which no servo is: the sign of the file is kept"
        ]
    # Mention other lags that fit equally well.
    for i in np.flatnonzero(sure & np.isfinite(repeats))[:1].tolist():
        return [
            f"commands repeat, so lags are ambiguous: {names[i]} follows {_ms(lag[i])} ms later, and "
            f"{_ms(repeats[i])} ms would fit equally well: the least lag is taken"
        ]
    return []


def _open_signs(ordered: Following, sure: np.ndarray) -> np.ndarray:
    """Return whether both signs fit a joint, and the lags of the other joints do not exclude one, ``(joints,)``.

    A periodic command fits with the opposite sign half a period later. Joints of one robot have similar lags, so a
    joint with another period, or without one, excludes the wrong sign.
    """
    same, other = _lags(ordered)
    margin, joints = 2.0 * ordered.period_s + _SAME_S, np.flatnonzero(sure)
    ambiguous = np.zeros(len(sure), bool)
    for i in (i for i in joints if other[i].size):
        rest = [np.concatenate([same[k], other[k]]) for k in joints if k != i]
        # The farthest of the other joints counts, at the lag of each candidate.
        off = [
            min(max(np.abs(lags - late).min() for lags in rest) for late in candidates) if rest else 0.0
            for candidates in (same[i], other[i])
        ]
        ambiguous[i] = off[0] + margin > 0.5 * off[1]
    return ambiguous


def _lags(ordered: Following) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return the lags [s] that fit each joint with the selected sign, and those with the opposite sign."""
    lag, against, repeats = (np.diag(a) for a in (ordered.lag_s, ordered.against_s, ordered.repeats_s))
    periods = np.where(np.isfinite(repeats), repeats - lag, 2.0 * np.abs(against - lag))
    same, other = ([_repeated(*each) for each in zip(first, periods, strict=True)] for first in (lag, against))
    return same, other


def _repeated(first: float, period: float) -> np.ndarray:
    """Return a lag, and the lags whole periods later, up to ``_MAX_COMMON_S``; empty without a lag [s]."""
    if not np.isfinite(first):
        return np.zeros(0)
    later = np.arange(first + period, _MAX_COMMON_S, period) if period > 0 else np.zeros(0)
    return np.array([first, *later])


def _too_early(
    names: Sequence[str], ordered: Following, sure: np.ndarray, scale: float, path: str, as_told: bool
) -> list[str]:
    """Return a warning of joints that move before their commands."""
    lag = np.diag(ordered.lag_s)
    early = sure & (lag < -1.5 * ordered.period_s)
    if not early.any():
        return []
    # A swinging load can lead the goal of a weak motor; a position that equals its goal earlier does not follow it.
    r, slope = (np.abs(np.diag(a)) for a in (ordered.r, ordered.slope))
    equal = early & (r > evidence.EQUAL_R) & (slope * scale > evidence.EQUAL_SLOPE)
    listed = ", ".join(f"{names[i]} by {_ms(-lag[i])} ms" for i in np.flatnonzero(early).tolist())
    if equal.any() and not as_told:
        raise UsageError(
            f"positions in {path} move before their commands: {listed}. The names of measurements and commands are "
            "exchanged, commands are late copies of measurements, or their stamps are of clocks that do not agree",
            hint="correct the names; --as-told imports the file without this check",
        )
    return [f"warning: positions move before their commands: {listed}"]


def refuse_copies(measured: Signal, command: Signal, copies: np.ndarray, path: str, as_told: bool) -> list[str]:
    """Return a warning of commands that are copies of the measurements.

    Args:
        command: Goals, in the order of the joints.
        copies: Whether commands are copies, ``(joints,)``.

    Raises:
        UsageError: When there is one, as copies contain no information on the drive.
    """
    if not copies.any():
        return []
    listed = ", ".join(f"{command.sources[i]} is {measured.sources[i]}" for i in np.flatnonzero(copies))
    if not as_told:
        raise UsageError(
            f"commands in {path} are copies of the measurements: {listed}. They contain no information on the drive",
            hint="record the commands that are sent to the motors, not their answers; --joints can omit a joint",
        )
    return [f"warning: commands are copies of the measurements: {listed}"]


def refuse_rates(
    command: np.ndarray,
    measured: np.ndarray,
    clocks: Sequence[np.ndarray],
    rows: Sequence[np.ndarray],
    name: str,
    path: str,
) -> None:
    """Raise a UsageError if the speeds of the joints follow a command whose name has no quantity."""
    t, c = clocks[0][rows[0]], clocks[1][rows[1]]
    held, joined, period_s = on_grid(c, command, t, np.gradient(measured, t, axis=0))
    r = np.abs(np.diag(following(held, joined, period_s).r))
    if r.size and np.median(r) > _MIN_GOAL_R:
        raise UsageError(
            f"does {name!r} in {path} command velocities or duty? The speeds follow it (r {np.median(r):.2f})",
            hint="write its quantity into its name, as in goal_velocity or duty, or write a mapping",
        )


def _ms(seconds: float | np.ndarray) -> str:
    return f"{round(1e3 * float(seconds))}"


def _slopes(relation: Following) -> np.ndarray:
    """Return the slope of each position over the goal that it follows best; its own goal wins a tie."""
    size = np.abs(relation.r)
    if size.shape[0] <= size.shape[1]:
        size = size + 0.05 * np.eye(*size.shape)
    best = np.argmax(size, axis=1)
    return relation.slope[np.arange(len(best)), best]


def _command_order(
    measured: Signal, command: Signal, relation: Following, scale: float, path: str, as_told: bool
) -> tuple[np.ndarray, list[str]]:
    """Return the command of each joint."""
    if command.width < measured.width:
        raise UsageError(
            f"{command.name!r} in {path} has {command.width} columns for {measured.width} joints",
            hint="name the commanded joints with --joints, or write a mapping",
        )
    # Choose by names if both have names.
    places, labelled = np.arange(measured.width), [label for label in measured.labels if label]
    by_name = [command.labels.index(label) if label in command.labels else None for label in labelled]
    named = len(labelled) == measured.width and all(p is not None for p in by_name)
    if command.width != measured.width and not named:
        raise UsageError(
            f"{command.name!r} in {path} has {command.width} columns for {measured.width} joints, and no names to "
            "choose by",
            hint="choose them in a mapping: goal = { source = [...] }",
        )
    first = np.array(by_name) if named else places
    # Compare with the order that fits the data best.
    best = first[evidence.order(relation.columns(first), scale)]
    if not named:
        _refuse_open_order(relation, best, scale, [measured.sources, command.sources], path, as_told)
    if (best == first).all():
        return first, []
    wrong = np.flatnonzero(best != first)
    pairs = ", ".join(f"{measured.sources[i]} follows {command.sources[best[i]]}" for i in wrong)
    # The data contradicts the order: keep it on request, or refuse a contradiction with names.
    if as_told:
        return first, [f"the data shows another order, the file's order is kept: {pairs}"]
    if named:
        raise UsageError(
            f"names and data of {path} contradict each other: by the data, {pairs}",
            hint="correct the names, or write a mapping with the right columns",
        )
    resting = [i for i in wrong if not relation.moved[i].any()]
    if resting:
        raise UsageError(
            f"the order of {command.name!r} in {path} is not that of {measured.name!r}, and for joints that did not "
            f"move it is unknown: {', '.join(measured.sources[i] for i in resting)}",
            hint=f"write the order into a mapping; candidates: {', '.join(command.sources[best[i]] for i in resting)}",
        )
    return best, [f"commands are in another order: {pairs}"]


def _refuse_open_order(
    relation: Following, best: np.ndarray, scale: float, sources: Sequence[Sequence[str]], path: str, as_told: bool
) -> None:
    """Raise a UsageError if commands without names fit two different joints equally well, unless ``as_told``."""
    ambiguous = [] if as_told else evidence.open_pairs(relation.columns(best), scale)
    if ambiguous:
        i, k = ambiguous[0]
        raise UsageError(
            f"the order of commands in {path} is ambiguous: {sources[0][i]} follows {sources[1][best[i]]} and "
            f"{sources[1][best[k]]} equally well, and {sources[0][k]} does, too, as commands repeat or look alike",
            hint="write the joints into the names, as in goal_pan and q_pan; " + KEEP_ORDER_HINT,
        )
