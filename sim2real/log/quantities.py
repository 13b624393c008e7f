"""The quantities of a recording in standard units: positions, velocities, gains, torque on or off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2real.errors import UsageError
from sim2real.log import evidence
from sim2real.log.evidence import DEGREES, SURE
from sim2real.log.mapping import FieldMapping
from sim2real.log.signals import Signal

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
    """

    pipeline: str
    rate_hz: float | None = None
    joints: tuple[str, ...] = ()
    ranges: np.ndarray | None = None


def taken(signal: Signal, places: np.ndarray) -> Signal:
    """Return a signal with some of its columns, in this order."""
    whole = signal.whole if np.array_equal(places, np.arange(signal.width)) else None
    sources, labels = (tuple(part[i] for i in places) for part in (signal.sources, signal.labels))
    return replace(signal, sources=sources, labels=labels, values=signal.values[:, places], whole=whole)


def clean(t_s: np.ndarray, signal: Signal) -> np.ndarray:
    """Return which rows have numbers and a stamp after all before them, ``(N,)``."""
    good = signal.finite & np.isfinite(t_s)
    latest = np.maximum.accumulate(np.where(good, t_s, -np.inf))
    return good & (t_s > np.concatenate([[-np.inf], latest[:-1]]))


def field_of(signal: Signal, unit: str, scales: Sequence[float]) -> FieldMapping:
    """Return how a signal becomes a field of the log.

    Args:
        signal: The signal.
        unit: Unit of the field.
        scales: Of each column.
    """
    scale = float(scales[0]) if len(set(scales)) == 1 else tuple(scales)
    # A single column of a file is a vector of one joint, so that all robots look alike.
    sources = (signal.whole,) if signal.whole else signal.sources
    return FieldMapping(sources, unit, scale, 0.0, (signal.width,))


def radian(measured: Signal, q: np.ndarray, asked: Asked, path: str) -> tuple[float, str]:
    """Return how many units a radian is, and how that is known.

    Args:
        measured: Positions.
        q: Shape ``(N, joints)``: those rows of them that have numbers.
        asked: What the user knows.
        path: The file, for errors.

    Args:
        signal: The signal.
        unit: Unit of the field.
        scales: Of each column.
    """
    if measured.meaning.unit in ("rad", "deg"):
        return (1.0 if measured.meaning.unit == "rad" else DEGREES), "by its name"
    encoders = [e for column in q.T if (e := evidence.turn(column))]
    kinds = {unit for unit, _ in encoders}
    if len(kinds) == 1:
        return (1.0 if kinds == {"rad"} else DEGREES), f"its steps are those of an encoder of {encoders[0][1]} a turn"
    if asked.ranges is not None and len(asked.ranges) == q.shape[1]:
        low, high = asked.ranges.T
        known = high > low
        room = 0.1 * (high - low)
        inside = {u: ((q / u > low - room) & (q / u < high + room))[:, known] for u in (1.0, DEGREES)}
        share = {u: float(rows.mean()) if known.any() else 1.0 for u, rows in inside.items()}
        if share[1.0] < 0.9 < share[DEGREES]:
            return DEGREES, f"as radians {1 - share[1.0]:.0%} of it would lie outside of the joints' ranges"
        if share[DEGREES] < 0.9 < share[1.0]:
            return 1.0, f"as degrees {1 - share[DEGREES]:.0%} of it would lie outside of the joints' ranges"
    most = float(np.abs(q).max())
    if most <= 2.2 * np.pi:
        return 1.0, f"it stays within {most:.3g}"
    if 30.0 < most <= 400.0 and np.abs(np.median(q, axis=0)).max() <= 200.0:
        return DEGREES, f"it reaches {most:.3g}, more than a turn in radians"
    raise UsageError(
        f"is {measured.name!r} in {path} in radians or degrees? It reaches {most:.4g}. Candidates: rad, deg",
        hint="end its name with the unit, as in q_rad, or write a mapping with a scale",
    )


def velocity_of(
    signals: Sequence[Signal], measured: Signal, t_s: np.ndarray, to_rad: float, places: np.ndarray
) -> tuple[dict[str, FieldMapping], list[str]]:
    """Return the measured velocity, where it is that of the positions.

    Args:
        signals: All of the file.
        measured: Positions, in the order of the joints.
        t_s: Their stamps ``(N,)`` [s].
        to_rad: Units of the positions in a radian.
        places: Which column is which joint.
    """
    fitting = [
        s for s in signals
        if s.meaning.quantity == "velocity" and s.meaning.side != "command"
        and len(s.values) == len(measured.values) and s.width >= measured.width and s.values.ndim == 2
    ]  # fmt: skip
    if len(fitting) != 1:
        return {}, [f"several velocities, none is taken: {', '.join(s.name for s in fitting)}"] * (len(fitting) > 1)
    velocity = taken(fitting[0], places)
    rows = np.flatnonzero(clean(t_s, measured) & velocity.finite)
    period = float(np.median(np.diff(t_s[rows])))
    rate = np.gradient(measured.values[rows], t_s[rows], axis=0) / to_rad
    found = evidence.following(rate, velocity.values[rows], period, 0.1)
    r, slope = np.diag(found.r), np.diag(found.slope)
    ratio = evidence.unit_ratio(slope[np.abs(r) > SURE])
    off = np.abs(slope / (ratio or 1.0)) if ratio else slope
    odd = (np.abs(r) > 0.05) & ((np.abs(r) < SURE) | (off < 0.6) | (off > 1.7))
    if ratio is None or odd.any():
        listed = ", ".join(f"{velocity.sources[i]} r {r[i]:.2f}, slope {slope[i]:.3g}" for i in np.flatnonzero(odd)[:3])
        return {}, [f"{velocity.name!r} is not the rate of {measured.name!r} ({listed or 'no unit fits'}): left out"]
    scales = [float((-1 if x < -SURE else 1) / ratio) for x in r]
    said = [
        f"{velocity.name!r} is the rate of {measured.name!r}: r {np.abs(r).max():.2f}, slope {np.median(slope):.3g}"
    ]
    turned = [s for s, x in zip(velocity.sources, r, strict=True) if x < -SURE]
    said += [f"opposite signs, velocities are turned: {', '.join(turned)}"] * bool(turned)
    return {"velocity": field_of(velocity, "rad/s", scales)}, said


def extras(
    signals: Sequence[Signal], command: Signal, places: np.ndarray, path: str
) -> tuple[dict[str, FieldMapping], list[str]]:
    """Return what else was commanded: gains, torque on or off, and what goes with a goal; all of it by name.

    Args:
        signals: All of the file.
        command: The commands.
        places: Which column is which joint.
        path: The file, for errors.
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
        if len(fitting) > 1:
            raise UsageError(
                f"which signal of {path} is {name}? Candidates: {', '.join(s.name for s in fitting)}",
                hint="write a mapping: the guide 'Import' has one with every key",
            )
        if fitting and not (name == "enabled" and not set(np.unique(fitting[0].values)) <= {0.0, 1.0}):
            own = fitting[0] if fitting[0].width == 1 or fitting[0].values.ndim == 1 else taken(fitting[0], places)
            fields[name] = field_of(own, unit, [1.0] * own.width)
            values = np.unique(fitting[0].values)
            listed = ", ".join(f"{v:g}" for v in values[:4]) + (" ..." if len(values) > 4 else "")
            said.append(f"{fitting[0].name!r} is {name}: {listed}")
    return fields, said
