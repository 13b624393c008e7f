"""Which command is whose goal: order, signs and unit of commands, and what a command that repeats leaves open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import Following
from sim2real.log.importing.evidence import DEGREES, SURE
from sim2real.log.importing.quantities import taken
from sim2real.log.importing.signals import Signal

_CLOSE = 0.9
"""Correlation from which a command without a name is a goal."""
_SAME_S = 0.01
"""Lags of joints of one robot differ by so much [s], and by two samples."""
_WEAK = 0.15
"""Below this slope, in one unit, a position does not follow."""
AS_TOLD = (
    "--as-told keeps names, order and signs as the file has them; import.toml, written beside the log, is where they "
    "are corrected. A motion that does not repeat, such as a chirp, settles it"
)


def follows(found: Following, command: Signal, path: str) -> bool:
    """Return whether positions follow a command whose name does not say what it commands.

    Args:
        path: The file, for errors.

    Raises:
        UsageError: When they follow it a little: neither a goal nor unrelated.
    """
    best, moved = np.abs(found.r).max(axis=1), found.moved.any(axis=1)
    if not moved.any() or evidence.unit_ratio(_slopes(found)[best > SURE]) is None:
        return False
    if np.mean(best[moved] > _CLOSE) > 0.5:
        return True
    if np.mean(best[moved] > SURE) > 0.5:
        raise UsageError(
            f"does {command.name!r} in {path} command positions? They follow it, but not closely (r "
            f"{np.median(best[moved]):.2f}). Candidates: goal, duty, torque",
            hint="name it so that it shows, as in goal_rad, duty or torque, or write a mapping",
        )
    return False


def goal(
    measured: Signal, command: Signal, found: Following, to_rad: float, path: str, as_told: bool
) -> tuple[Signal, list[float], list[str]]:
    """Return goals in the order of the joints, their scales, and what to say of them.

    Args:
        path: The file, for errors.
        as_told: Keep order and signs as they are where the data leaves them open.

    Raises:
        UsageError: When names and data contradict each other, or a command that repeats leaves order or sign open.
    """
    slopes = _slopes(found)
    ratio = evidence.unit_ratio(slopes[np.abs(found.r).max(axis=1) > SURE])
    told = {"rad": 1.0, "deg": DEGREES}.get(command.meaning.unit)
    if ratio is None and told is None:
        raise UsageError(
            f"{measured.name!r} follows {command.name!r} in {path}, but neither in radians nor in degrees: "
            f"slopes {', '.join(f'{s:.3g}' for s in slopes[:6])}",
            hint="write a mapping with the scale that its maker gives",
        )
    unit = to_rad / (ratio or to_rad / (told or 1.0))
    if not np.isclose(unit, (1.0, DEGREES)).any():
        raise UsageError(
            f"{measured.name!r} in {path}, in {'degrees' if to_rad != 1 else 'radians'}, follows {command.name!r} with "
            f"slopes of {slopes[:3].round(4)}: then that is neither in radians nor in degrees",
            hint="end both names with their units, as in q_rad and goal_deg, or write a mapping with the scales",
        )
    if told is not None and ratio is not None and not np.isclose(told, unit):
        raise UsageError(
            f"{command.name!r} in {path} is in {command.meaning.unit} by its name, but {measured.name!r}, in "
            f"{'degrees' if to_rad != 1 else 'radians'}, follows it with slopes of {slopes[:3].round(3)}",
            hint="write a mapping with the scales that hold",
        )
    places, said = _command_order(measured, command, found, to_rad / unit, path, as_told)
    own = found.columns(places).by_level(to_rad / unit)
    r, slope, lag = (np.diag(a) for a in (own.r, own.slope, own.lag_s))
    sure = (np.abs(r) > SURE) & (np.abs(slope) * unit / to_rad > _WEAK)
    flipped = sure & (r < 0)
    names = [label or str(i) for i, label in enumerate(measured.labels)]
    said += _signs(names, own, sure, path, as_told)
    said += _too_early(names, own, sure, unit / to_rad, path, as_told)
    scales = [float(-1 / unit if f else 1 / unit) for f in flipped]
    if sure.any():
        said.append(
            f"{measured.name!r} follows {command.name!r}: r {np.abs(r[sure]).min():.2f} to {np.abs(r[sure]).max():.2f},"
            f" {_ms(np.median(lag[sure]))} ms later, slope {np.median(np.abs(slope[sure])):.3g}"
            + (": one is in degrees" if ratio not in (1.0, None) else "")
        )
    if flipped.any():
        said.append(f"opposite signs, commands are turned: {', '.join(np.array(names)[flipped])}")
    if (~sure).any():
        weak = ", ".join(f"{n} ({x:.2f})" for n, x, s in zip(names, r, sure, strict=True) if not s)
        said.append(f"no evidence of order and sign for {weak}: they hardly moved, or did not follow")
    return taken(command, places), scales, said


def _signs(names: Sequence[str], own: Following, sure: np.ndarray, path: str, as_told: bool) -> list[str]:
    """Return what to say of commands that repeat.

    Raises:
        UsageError: When the opposite sign fits as well, with a smaller lag.
    """
    lag, against, repeats = (np.diag(a) for a in (own.lag_s, own.against_s, own.repeats_s))
    with np.errstate(invalid="ignore"):
        open_ = sure & ((against < lag) | _others_agree(own, sure))
    if open_.any():
        listed = "; ".join(
            f"{names[i]} follows {_ms(lag[i])} ms later, or with the opposite sign {_ms(against[i])} ms later"
            for i in np.flatnonzero(open_).tolist()
        )
        if not as_told:
            raise UsageError(f"the commands of {path} repeat, so the data cannot tell signs: {listed}", hint=AS_TOLD)
        return [f"the commands repeat, so the data cannot tell signs: {listed}; they are kept as the file has them"]
    again = sure & (np.isfinite(against) | np.isfinite(repeats))
    for i in np.flatnonzero(again)[:1].tolist():
        others = ((repeats[i], ""), (against[i], " with the opposite sign"))
        fits = [f"{_ms(late)} ms{sign}" for late, sign in others if np.isfinite(late)]
        return [
            f"commands repeat, so the data alone cannot tell lags and signs: {names[i]} follows {_ms(lag[i])} ms "
            f"later, and {' and '.join(fits)} would fit as well: the least lag and the same sign are taken"
        ]
    return []


def _others_agree(own: Following, sure: np.ndarray) -> np.ndarray:
    """Return which joints have the lag of the others with the opposite sign, but not with theirs, ``(joints,)``."""
    lag, against, repeats = (np.diag(a) for a in (own.lag_s, own.against_s, own.repeats_s))
    options = np.stack([lag, repeats, against])[:, sure]
    most = 2.0 * own.period_s + _SAME_S
    found = np.zeros(len(lag), bool)
    for common in options[np.isfinite(options)]:
        off = np.abs(options - common)
        # Lags that were taken agree on it, too, at least that of one joint.
        if (np.nanmin(off, axis=0) <= most).all() and (off[0] <= most).any():
            found[sure] |= (off[2] <= most) & (off[0] > 2.0 * most)
    return found


def _too_early(
    names: Sequence[str], own: Following, sure: np.ndarray, scale: float, path: str, as_told: bool
) -> list[str]:
    """Return a warning of joints that move before their commands.

    Raises:
        UsageError: When there are any: the names are exchanged, or the clocks do not agree.
    """
    lag = np.diag(own.lag_s)
    early = sure & (lag < -1.5 * own.period_s)
    if not early.any():
        return []
    # A load that swings may lead the goal of a weak motor; what equals its goal, only earlier, does not follow it.
    r, slope = (np.abs(np.diag(a)) for a in (own.r, own.slope))
    equal = early & (r > evidence.EQUAL_R) & (slope * scale > evidence.EQUAL_SLOPE)
    listed = ", ".join(f"{names[i]} by {_ms(-lag[i])} ms" for i in np.flatnonzero(early).tolist())
    if equal.any() and not as_told:
        raise UsageError(
            f"positions in {path} move before they are told to: {listed}. The names of what was measured and what was "
            "commanded are exchanged, or their stamps are of clocks that do not agree",
            hint="correct the names; --as-told imports it all the same",
        )
    return [f"warning: positions move before they are told to: {listed}"]


def refuse_copies(measured: Signal, command: Signal, copies: np.ndarray, path: str, as_told: bool) -> list[str]:
    """Return a warning of commands that are the measurements.

    Args:
        command: Goals, in the order of the joints.
        copies: Which commands are copies, ``(joints,)``.
        path: The file, for errors.

    Raises:
        UsageError: When there are any: nothing can be identified from them.
    """
    if not copies.any():
        return []
    listed = ", ".join(f"{command.sources[i]} is {measured.sources[i]}" for i in np.flatnonzero(copies))
    if not as_told:
        raise UsageError(
            f"commands in {path} are the measurements themselves: {listed}. Nothing about the drive can be "
            "identified from them",
            hint="record what was sent to the motors, not what they answered; --joints leaves a joint out",
        )
    return [f"warning: commands are the measurements themselves: {listed}"]


def _ms(seconds: float | np.ndarray) -> str:
    return f"{round(1e3 * float(seconds))}"


def _slopes(found: Following) -> np.ndarray:
    """Return the slope of each position over the goal that it follows best, of equally good ones over its own."""
    size = np.abs(found.r)
    if size.shape[0] <= size.shape[1]:
        size = size + 0.05 * np.eye(*size.shape)
    best = np.argmax(size, axis=1)
    return found.slope[np.arange(len(best)), best]


def _command_order(
    measured: Signal, command: Signal, found: Following, scale: float, path: str, as_told: bool
) -> tuple[np.ndarray, list[str]]:
    """Return the command of each joint."""
    if command.width < measured.width:
        raise UsageError(
            f"{command.name!r} in {path} has {command.width} columns for {measured.width} joints",
            hint="name the joints that were commanded with --joints, or write a mapping",
        )
    own, labelled = np.arange(measured.width), [label for label in measured.labels if label]
    byname = [command.labels.index(label) if label in command.labels else None for label in labelled]
    named = len(labelled) == measured.width and all(p is not None for p in byname)
    if command.width != measured.width and not named:
        raise UsageError(
            f"{command.name!r} in {path} has {command.width} columns for {measured.width} joints, and no names to "
            "choose by",
            hint="choose them in a mapping: goal = { source = [...] }",
        )
    first = np.array(byname) if named else own
    best = first[evidence.order(found.columns(first), scale)]
    if not named:
        _refuse_open_order(found, best, scale, [measured.sources, command.sources], path, as_told)
    if (best == first).all():
        return first, []
    wrong = np.flatnonzero(best != first)
    pairs = ", ".join(f"{measured.sources[i]} follows {command.sources[best[i]]}" for i in wrong)
    if as_told:
        return first, [f"the data says another order, the file's is kept: {pairs}"]
    if named:
        raise UsageError(
            f"names and data of {path} contradict each other: by the data, {pairs}",
            hint="correct the names, or say in a mapping which columns belong together",
        )
    still = [i for i in wrong if not found.moved[i].any()]
    if still:
        raise UsageError(
            f"the order of {command.name!r} in {path} is not that of {measured.name!r}, and for joints that did not "
            f"move it cannot be told: {', '.join(measured.sources[i] for i in still)}",
            hint=f"say it in a mapping; candidates: {', '.join(command.sources[best[i]] for i in still)}",
        )
    return best, [f"commands are in another order: {pairs}"]


def _refuse_open_order(
    found: Following, best: np.ndarray, scale: float, sources: Sequence[Sequence[str]], path: str, as_told: bool
) -> None:
    """Refuse commands without names that fit two joints equally well although they are not alike.

    Raises:
        UsageError: When there are any, and the file's order is not said to be right.
    """
    pairs = [] if as_told else evidence.open_pairs(found.columns(best), scale)
    if pairs:
        i, k = pairs[0]
        raise UsageError(
            f"the data of {path} cannot tell the order of commands: {sources[0][i]} follows {sources[1][best[i]]} and "
            f"{sources[1][best[k]]} equally well, and {sources[0][k]} does, too, as commands repeat or look alike",
            hint="names of joints settle it, as in goal_pan and q_pan; " + AS_TOLD,
        )
