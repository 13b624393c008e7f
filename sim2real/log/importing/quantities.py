"""The quantities of a recording in standard units: positions, velocities, gains, torque on or off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import following
from sim2real.log.importing.evidence import SURE
from sim2real.log.importing.mapping import FieldMapping
from sim2real.log.importing.signals import Signal

_EXTRA = {
    "kp": ("kp", None, ""),
    "kd": ("kd", None, ""),
    "enabled": ("enabled", None, ""),
    "goal_velocity": ("velocity", "command", "rad/s"),
    "torque": ("torque", "command", "N m"),
}
"""What else may be commanded beside a goal: field -> quantity, side where it matters, and unit."""


@dataclass(frozen=True)
class Asked:
    """What the user knows.

    Attributes:
        pipeline: Name of the pipeline that the log is for.
        rate_hz: Rate of the samples, where the file has no stamps [Hz].
        joints: Names of the robot's joints, in its order; empty: not known.
        ranges: Shape ``(joints, 2)``: from where to where they move [rad]; empty: not known.
        as_told: Keep names, order and signs as the file has them where the data leaves them open or contradicts them.
        slides: Those of the joints that are slides, whose positions are lengths.
    """

    pipeline: str
    rate_hz: float | None = None
    joints: tuple[str, ...] = ()
    ranges: np.ndarray | None = None
    as_told: bool = False
    slides: tuple[str, ...] = ()

    def hinges(self, width: int) -> np.ndarray:
        """Return which of so many columns are joints that turn, ``(width,)``: all but those that are known to slide."""
        known = len(self.joints) == width
        return np.array([not (known and self.joints[i] in self.slides) for i in range(width)], bool)


def taken(signal: Signal, places: np.ndarray) -> Signal:
    """Return a signal with some of its columns, in this order."""
    whole = signal.whole if np.array_equal(places, np.arange(signal.width)) else None
    sources, labels = (tuple(part[i] for i in places) for part in (signal.sources, signal.labels))
    return replace(signal, sources=sources, labels=labels, values=signal.values[:, places], whole=whole)


def matched(signal: Signal, measured: Signal, places: np.ndarray) -> Signal:
    """Return the columns of a signal that belong to the measured joints: by names where both have some, else by place.

    Args:
        measured: Positions, in the order of the joints.
        places: Which column is which joint, where names do not say so.
    """
    labels = measured.labels
    if all(labels) and set(labels) <= set(signal.labels):
        return taken(signal, np.array([signal.labels.index(label) for label in labels]))
    return taken(signal, places)


def clean(t_s: np.ndarray, signal: Signal) -> np.ndarray:
    """Return which rows have numbers and a stamp after all before them, ``(N,)``."""
    good = signal.finite & np.isfinite(t_s)
    latest = np.maximum.accumulate(np.where(good, t_s, -np.inf))
    return good & (t_s > np.concatenate([[-np.inf], latest[:-1]]))


def field_of(signal: Signal, unit: str, scales: Sequence[float], turn: float = 0.0) -> FieldMapping:
    """Return how a signal becomes a field of the log.

    Args:
        turn: A turn in the signal's unit, where turns are to be counted.
    """
    scale = float(scales[0]) if len(set(scales)) == 1 else tuple(scales)
    # A single column of a file is a vector of one joint, so that all robots look alike.
    sources = (signal.whole,) if signal.whole else signal.sources
    return FieldMapping(sources, unit, scale, 0.0, (signal.width,), turn=turn)


def velocities(signals: Sequence[Signal], measured: Signal) -> list[Signal]:
    """Return what may be the measured velocity."""
    return [
        s for s in signals
        if s.meaning.quantity == "velocity" and s.meaning.side != "command"
        and len(s.values) == len(measured.values) and s.width >= measured.width and s.values.ndim == 2
    ]  # fmt: skip


def velocity_of(
    signals: Sequence[Signal], measured: Signal, t_s: np.ndarray, to_rad: float, places: np.ndarray
) -> tuple[dict[str, FieldMapping], list[str], np.ndarray]:
    """Return the measured velocity, where it is that of the positions, what to say, and which samples lack numbers.

    Args:
        measured: Positions, in the order of the joints.
        t_s: Their stamps ``(N,)`` [s].
        places: Which column is which joint.
    """
    fitting = velocities(signals, measured)
    whole = np.zeros(len(measured.values), bool)
    if len(fitting) != 1:
        return (
            {},
            [f"several velocities, none is taken: {', '.join(s.name for s in fitting)}"] * (len(fitting) > 1),
            whole,
        )
    velocity = matched(fitting[0], measured, places)
    rows = np.flatnonzero(clean(t_s, measured) & velocity.finite)
    if len(rows) < 0.5 * clean(t_s, measured).sum() or len(rows) < 3:
        return {}, [f"left out: {velocity.name!r} lacks numbers"], whole
    period = float(np.median(np.diff(t_s[rows])))
    rate = np.gradient(measured.values[rows], t_s[rows], axis=0) / to_rad
    found = following(rate, velocity.values[rows], period, 0.1)
    r, slope, lag, against = (np.diag(a) for a in (found.r, found.slope, found.lag_s, found.against_s))
    # A rate and its velocity are of one time: of two signs that fit, that of the smaller lag is the right one.
    with np.errstate(invalid="ignore"):
        r, slope = (np.where(np.abs(against) < np.abs(lag), -a, a) for a in (r, slope))
    still = (rate.std(axis=0) > 0.05 * rate.std()) & (velocity.values[rows].std(axis=0) == 0)
    ratio = evidence.unit_ratio(slope[np.abs(r) > SURE])
    off = np.abs(slope / (ratio or 1.0)) if ratio else slope
    odd = still | (np.abs(r) > 0.05) & ((np.abs(r) < SURE) | (off < 0.6) | (off > 1.7))
    typical = float(np.median(slope))
    own = {1.0: "rad", evidence.DEGREES: "deg"}.get(ratio or 0.0, "")
    if ratio is None or odd.any() or velocity.meaning.unit not in ("", own):
        listed = ", ".join(f"{velocity.sources[i]} r {r[i]:.2f}, slope {slope[i]:.3g}" for i in np.flatnonzero(odd)[:3])
        why = listed or f"slope {typical:.3g}: no unit fits"
        return {}, [f"{velocity.name!r} is not the rate of {measured.name!r} ({why}): left out"], whole
    scales = [float((-1 if x < -SURE else 1) / ratio) for x in r]
    said = [
        f"{velocity.name!r} is the rate of {measured.name!r}: r {np.abs(r).max():.2f}, slope {np.median(slope):.3g}"
    ]
    turned = [s for s, x in zip(velocity.sources, r, strict=True) if x < -SURE]
    said += [f"opposite signs, velocities are turned: {', '.join(turned)}"] * bool(turned)
    return {"velocity": field_of(velocity, "rad/s", scales)}, said, ~velocity.finite


def extras(
    signals: Sequence[Signal], command: Signal, measured: Signal, places: np.ndarray, path: str, followed: bool
) -> tuple[dict[str, FieldMapping], list[str]]:
    """Return what else was commanded: gains, torque on or off, and what goes with a goal; all of it by name.

    Args:
        measured: Positions, in the order of the joints.
        places: Which column is which joint, where names do not say so.
        path: The file, for errors.

    Raises:
        UsageError: When several signals may be the same quantity.
    """
    fields, said = {}, []
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
        said += [f"left out: {s.name!r} lacks numbers" for s in named if s is not command and not s.finite.all()]
        idle = [s for s in fitting if not s.values.any() and followed]
        if idle:
            # A factor of 0 leaves its parameter open, and a recorder that does not know a gain writes 0.
            said.append(f"left out: {', '.join(repr(s.name) for s in idle)} is 0 throughout, so it is not {name}")
            fitting = [s for s in fitting if s.values.any()]
        if len(fitting) > 1:
            raise UsageError(
                f"which signal of {path} is {name}? Candidates: {', '.join(s.name for s in fitting)}",
                hint="write a mapping: the guide 'Import' has one with every key",
            )
        if fitting and not (name == "enabled" and not set(np.unique(fitting[0].values)) <= {0.0, 1.0}):
            whole = fitting[0].width == 1 or fitting[0].values.ndim == 1
            own = fitting[0] if whole else matched(fitting[0], measured, places)
            fields[name] = field_of(own, unit, [1.0] * own.width)
            values = np.unique(fitting[0].values)
            listed = ", ".join(f"{v:g}" for v in values[:4]) + (" ..." if len(values) > 4 else "")
            said.append(f"{fitting[0].name!r} is {name}: {listed}")
    return fields, said
