"""The quantities of a recording in standard units: positions, velocities, gains, torque on or off."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import following
from sim2real.log.importing.evidence import SURE
from sim2real.log.importing.mapping import FieldMapping, NodeMapping
from sim2real.log.importing.signals import Signal

_EXTRA = {
    "kp": ("kp", None, ""),
    "kd": ("kd", None, ""),
    "enabled": ("enabled", None, ""),
    "goal_velocity": ("velocity", "command", "rad/s"),
    "torque": ("torque", "command", "N m"),
    "payload": ("payload", None, "kg"),
    "payload_reach": ("reach", None, "m"),
}
"""Commands beside a goal: field -> quantity, side or None for any, and unit."""
_MOTION, _OTHER_COMMANDS = ("position", "velocity"), ("torque", "duty", "voltage", "kp", "kd")
_MAX_LISTED = 20
_GAINS = ("kp", "kd", "enabled")
"""Factors of a drive: one that is 0 throughout contradicts a position that follows its goal."""


@dataclass(frozen=True)
class ImportHints:
    """The user's information on a file.

    Attributes:
        pipeline: Name of the log's pipeline.
        rate_hz: Rate of the samples if the file has no stamps [Hz].
        joints: Names of the robot's joints, in its order; empty if unknown.
        ranges: Shape ``(joints, 2)``: limits of the joints [rad]; None if unknown.
        as_told: Keep names, order and signs of the file, even if they are ambiguous or contradict the data.
        slides: Names of the sliding joints, whose positions are lengths.
    """

    pipeline: str
    rate_hz: float | None = None
    joints: tuple[str, ...] = ()
    ranges: np.ndarray | None = None
    as_told: bool = False
    slides: tuple[str, ...] = ()

    def hinges(self, width: int) -> np.ndarray:
        """Return whether a column is a joint that turns, ``(width,)``: False for a slide."""
        have_names = len(self.joints) == width
        return np.array([not (have_names and self.joints[i] in self.slides) for i in range(width)], bool)


def taken(signal: Signal, places: np.ndarray) -> Signal:
    """Return a signal with some of its columns, in this order."""
    whole = signal.whole if np.array_equal(places, np.arange(signal.width)) else None
    sources, labels = (tuple(part[i] for i in places) for part in (signal.sources, signal.labels))
    return replace(signal, sources=sources, labels=labels, values=signal.values[:, places], whole=whole)


def matched(signal: Signal, measured: Signal, places: np.ndarray) -> Signal:
    """Return the columns of a signal for the measured joints: by names if both have names, else by place.

    Args:
        measured: Positions, in the order of the joints.
        places: Column of each joint, for signals without names.
    """
    labels = measured.labels
    if all(labels) and set(labels) <= set(signal.labels):
        return taken(signal, np.array([signal.labels.index(label) for label in labels]))
    return taken(signal, places)


def unused(signals: Sequence[Signal], nodes: Iterable[NodeMapping], notes: Sequence[str]) -> list[str]:
    """Return notes on columns of commands, and of measured positions and velocities, that no field of a node takes.

    Args:
        notes: Sentences so far; a column that they name needs no further one.
    """
    sources = {source for node in nodes for field in node.fields.values() for source in field.source}
    taken_names: dict[tuple[str, str], str] = {}
    left: dict[str, list[tuple[str, str]]] = {"commands": [], "measurements": []}
    # Distribute the columns: those that a field takes, and those that no field takes.
    for signal in signals:
        side = "commands" if signal.meaning.side == "command" else "measurements"
        quantities = _MOTION + (_OTHER_COMMANDS if side == "commands" else ())
        if signal.meaning.quantity not in quantities and not (signal.meaning.side and not signal.meaning.quantity):
            continue
        columns = list(zip(signal.sources, signal.labels, strict=True))
        in_use = [signal.whole in sources or source in sources for source, _ in columns]
        taken_names |= {
            (side, label): signal.whole or source for (source, label), used in zip(columns, in_use, strict=True) if used
        }
        if not any(f"'{signal.name}'" in note or f" {signal.sources[0]}" in note for note in notes):
            whole = [(signal.whole, signal.labels[0])] if signal.whole and not any(in_use) else None
            left[side] += whole or [column for column, used in zip(columns, in_use, strict=True) if not used]
    # Name the column of the same joint that is taken instead.
    texts = []
    for side, columns in left.items():
        names = [
            f"{name} ({f'joint {label} has ' if label else 'instead: '}{taken_names[side, label]})"
            if (side, label) in taken_names
            else name
            for name, label in columns
        ]
        more = f" and {len(names) - _MAX_LISTED} more" if len(names) > _MAX_LISTED else ""
        texts += [f"{side} that are not imported: {', '.join(names[:_MAX_LISTED])}{more}"] if names else []
    return texts


def clean(t_s: np.ndarray, signal: Signal) -> np.ndarray:
    """Return whether a row has numbers and a stamp later than all before, ``(N,)``."""
    good = signal.finite & np.isfinite(t_s)
    latest = np.maximum.accumulate(np.where(good, t_s, -np.inf))
    return good & (t_s > np.concatenate([[-np.inf], latest[:-1]]))


def field_of(signal: Signal, unit: str, scales: Sequence[float], turn: float = 0.0) -> FieldMapping:
    """Return the mapping of a signal to a field of the log.

    Args:
        turn: A turn in the signal's unit if turns are counted; else 0.
    """
    scale = float(scales[0]) if len(set(scales)) == 1 else tuple(scales)
    # Map a single column to a vector of one joint, so that all robots have vectors.
    sources = (signal.whole,) if signal.whole else signal.sources
    return FieldMapping(sources, unit, scale, 0.0, (signal.width,), turn=turn)


def velocities(signals: Sequence[Signal], measured: Signal) -> list[Signal]:
    """Return the candidates for the measured velocity."""
    return [
        s for s in signals
        if s.meaning.quantity == "velocity" and s.meaning.side != "command"
        and len(s.values) == len(measured.values) and s.width >= measured.width and s.values.ndim == 2
    ]  # fmt: skip


def velocity_of(
    signals: Sequence[Signal], measured: Signal, t_s: np.ndarray, to_rad: float, places: np.ndarray
) -> tuple[dict[str, FieldMapping], list[str], np.ndarray]:
    """Return the field of the measured velocity if it fits the positions, notes, and whether a sample lacks numbers.

    Args:
        measured: Positions, in the order of the joints.
        t_s: Their stamps ``(N,)`` [s].
        places: Column of each joint.
    """
    fitting = velocities(signals, measured)
    complete = np.zeros(len(measured.values), bool)
    if len(fitting) != 1:
        return (
            {},
            [f"several velocities, none is taken: {', '.join(s.name for s in fitting)}"] * (len(fitting) > 1),
            complete,
        )
    velocity = matched(fitting[0], measured, places)
    rows = np.flatnonzero(clean(t_s, measured) & velocity.finite)
    if len(rows) < 0.5 * clean(t_s, measured).sum() or len(rows) < 3:
        return {}, [f"skipped: {velocity.name!r} lacks numbers"], complete
    period = float(np.median(np.diff(t_s[rows])))
    rate = np.gradient(measured.values[rows], t_s[rows], axis=0) / to_rad
    relation = following(rate, velocity.values[rows], period, 0.1)
    r, slope, lag, against = (np.diag(a) for a in (relation.r, relation.slope, relation.lag_s, relation.against_s))
    # A rate and its velocity have the same time, so the sign with the smaller lag is right.
    with np.errstate(invalid="ignore"):
        r, slope = (np.where(np.abs(against) < np.abs(lag), -a, a) for a in (r, slope))
    resting = (rate.std(axis=0) > 0.05 * rate.std()) & (velocity.values[rows].std(axis=0) == 0)
    ratio = evidence.unit_ratio(slope[np.abs(r) > SURE])
    error = np.abs(slope / (ratio or 1.0)) if ratio else slope
    wrong = resting | (np.abs(r) > 0.05) & ((np.abs(r) < SURE) | (error < 0.6) | (error > 1.7))
    typical = float(np.median(slope))
    unit = {1.0: "rad", evidence.DEGREES: "deg"}.get(ratio or 0.0, "")
    if ratio is None or wrong.any() or velocity.meaning.unit not in ("", unit):
        listed = ", ".join(
            f"{velocity.sources[i]} r {r[i]:.2f}, slope {slope[i]:.3g}" for i in np.flatnonzero(wrong)[:3]
        )
        why = listed or f"slope {typical:.3g}: no unit fits"
        return {}, [f"{velocity.name!r} is not the rate of {measured.name!r} ({why}): skipped"], complete
    scales = [float((-1 if x < -SURE else 1) / ratio) for x in r]
    notes = [
        f"{velocity.name!r} is the rate of {measured.name!r}: r {np.abs(r).max():.2f}, slope {np.median(slope):.3g}"
    ]
    turned = [s for s, x in zip(velocity.sources, r, strict=True) if x < -SURE]
    notes += [f"opposite signs, velocities are turned: {', '.join(turned)}"] * bool(turned)
    return {"velocity": field_of(velocity, "rad/s", scales)}, notes, ~velocity.finite


def extras(
    signals: Sequence[Signal], command: Signal, measured: Signal, places: np.ndarray, path: str, followed: np.ndarray
) -> tuple[dict[str, FieldMapping], list[str]]:
    """Return the fields of further commands, found by name: gains, torque on or off, velocity and torque beside a goal.

    Args:
        measured: Positions, in the order of the joints.
        places: Column of each joint, for signals without names.
        followed: Whether positions follow a command, ``(joints,)``.

    Raises:
        UsageError: When several signals can be the same quantity.
    """
    fields, notes = {}, []
    for name, (quantity, side, unit) in _EXTRA.items():
        named = [s for s in signals if s.meaning.quantity == quantity and side in (None, s.meaning.side)]
        fitting = [
            s
            for s in named
            if s is not command
            and s.finite.all()
            and s.width in (1, command.width)
            and (s.values.ndim == 1 or len(s.values) == len(command.values))
        ]
        notes += [f"skipped: {s.name!r} lacks numbers" for s in named if s is not command and not s.finite.all()]
        idle = [s for s in fitting if not s.values.any() and followed.any()]
        if idle:
            # Skip zeros: a factor of 0 leaves its parameter open, and recorders write 0 for an unknown gain.
            notes.append(f"skipped: {', '.join(repr(s.name) for s in idle)} is 0 throughout, so it is not {name}")
            fitting = [s for s in fitting if s.values.any()]
        if len(fitting) > 1:
            raise UsageError(
                f"which signal of {path} is {name}? Candidates: {', '.join(s.name for s in fitting)}",
                hint="write a mapping: the guide 'Import' has one with every key",
            )
        if fitting and not (name == "enabled" and not set(np.unique(fitting[0].values)) <= {0.0, 1.0}):
            columns = fitting[0] if fitting[0].width == 1 else matched(fitting[0], measured, places)
            if name in _GAINS and (zero := followed & ~columns.values.any(axis=0)).any():
                listed = ", ".join(np.array(measured.sources)[zero])
                notes.append(f"skipped: {fitting[0].name!r} is 0 throughout for {listed}, so it is not {name}")
                continue
            fields[name] = field_of(columns, unit, [1.0] * columns.width)
            values = np.unique(fitting[0].values)
            listed = ", ".join(f"{v:g}" for v in values[:4]) + (" ..." if len(values) > 4 else "")
            notes.append(f"{fitting[0].name!r} is {name}: {listed}")
    return fields, notes
