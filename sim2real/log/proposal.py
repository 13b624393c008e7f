"""Proposes the mapping of a file of another recorder: from names and from the data, with the evidence for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log import evidence
from sim2real.log.evidence import DEGREES, SURE, Following
from sim2real.log.foreign import ForeignFile
from sim2real.log.lerobot import are_degrees
from sim2real.log.mapping import FieldMapping, ImportMapping, NodeMapping
from sim2real.log.names import meaning, same_joint
from sim2real.log.pairing import find_pair
from sim2real.log.quantities import Asked, clean, extras, field_of, radian, taken, velocity_of
from sim2real.log.signals import Signal, Stamps, collect, find_stamps

_FIELDS = {"position": "goal", "velocity": "goal_velocity", "torque": "torque", "duty": "duty", "voltage": "duty"}
_CLOSE = 0.9
"""Correlation of two streams whose clocks differ."""
_GAP = 5.0
"""A pause of this many periods is a gap."""


@dataclass(frozen=True)
class Proposal:
    """A mapping, and why.

    Attributes:
        mapping: The mapping.
        joints: Names of the columns of measured positions, in the order of the log; numbers where there are no names.
        evidence: Sentences.
    """

    mapping: ImportMapping
    joints: tuple[str, ...]
    evidence: tuple[str, ...]


@np.errstate(over="ignore", invalid="ignore")  # damaged files hold numbers of any size
def propose(file: ForeignFile, asked: Asked) -> Proposal:
    """Return the mapping that names and data speak for.

    Args:
        file: The file.
        asked: What the user knows.

    Raises:
        UsageError: When something is ambiguous: the candidates are named.
    """
    signals = collect(file)
    pair = find_pair(signals, str(file.path), asked.rate_hz)
    path, said = str(file.path), list(pair.said)
    measured, command = pair.measured, pair.command
    try:
        stamps = [find_stamps(signals, s, side, path, asked.rate_hz)
                  for s, side in ((measured, "measured"), (command, "command"))]  # fmt: skip
    except UsageError:
        _require_readable_stamps(file)
        raise
    said += _on_stamps(measured, stamps[0]) + (
        _on_stamps(command, stamps[1]) if stamps[1].source != stamps[0].source else []
    )
    places, labels, ordered = _joint_order(measured, asked, path)
    measured, said = taken(measured, places), said + ordered
    clocks, offset_s, shift = _clocks(stamps, measured, command)
    rows = clean(clocks[0], measured), clean(clocks[1], command)
    q, c = measured.values[rows[0]], command.values[rows[1]]
    extra, others = extras(signals, command, places, path)
    held, joined, period_s = evidence.on_grid(clocks[1][rows[1]], c, clocks[0][rows[0]], q, _acting(signals, rows[1]))
    if len(held) < 50:
        raise UsageError(
            f"{path} has {len(held)} samples at which both {measured.name!r} and {command.name!r} are known",
            hint="that is too few to tell what follows what: write a mapping",
        )
    found = evidence.following(held, joined, period_s)
    fields: dict[str, dict[str, FieldMapping]] = {"actuator": {}, "sensor": {}}
    proven = are_degrees(file.facts, _names_of(file, measured), q, path)
    to_rad, why = (
        (DEGREES, "its steps are those of encoders of 4096 a turn") if proven else radian(measured, q, asked, path)
    )
    said.append(f"{measured.name!r} is in {'degrees' if to_rad != 1 else 'radians'}: {why}")
    fields["sensor"]["position"] = field_of(measured, "rad", [1 / to_rad] * measured.width)
    kind = pair.kind or ("position" if command.meaning.unit in ("rad", "deg") or _follows(found) else "duty")
    if kind == "position":
        command, scales, more = _goal(measured, command, found, to_rad, path)
        fields["actuator"]["goal"] = field_of(command, "rad", scales)
    else:
        if command.width != measured.width:
            raise UsageError(
                f"{command.name!r} has {command.width} columns, {measured.name!r} {measured.width}",
                hint="name which belong together in a mapping",
            )
        unit = {"velocity": "rad/s", "torque": "N m"}.get(kind, "")
        fields["actuator"][_FIELDS[kind]] = field_of(taken(command, places), unit, [1.0] * command.width)
        more = [f"{command.name!r} commands {kind}: it goes by its name, no position follows it (|r| at most "
                f"{np.abs(found.r).max():.2f})"]  # fmt: skip
    said += more + shift
    velocity, more = velocity_of(signals, measured, clocks[0], to_rad, places)
    fields["sensor"] |= velocity
    fields["actuator"] |= extra
    nodes = {}
    for name, at, signal, offset in (("actuator", stamps[1], command, offset_s), ("sensor", stamps[0], measured, 0.0)):
        nodes[name], policy = _node(name, fields[name], at, signal, offset)
        said += policy
    mapping = ImportMapping(asked.pipeline, nodes)
    return Proposal(mapping, labels, tuple(said + more + others + list(file.notes)))


def _require_readable_stamps(file: ForeignFile) -> None:
    """Raise the error of a signal that is named like a time stamp, but cannot be read."""
    for key in file.keys:
        if meaning(key).quantity == "stamp":
            file.signal(key)


def _names_of(file: ForeignFile, signal: Signal) -> list[str]:
    """Return the names of a signal's columns as the file has them."""
    own = file.columns.get(signal.sources[0].partition("[")[0], ())
    places = [s.rpartition("[:,")[2].rstrip("]") for s in signal.sources]
    return [
        own[int(p)] if p.isdigit() and int(p) < len(own) else s for p, s in zip(places, signal.sources, strict=True)
    ]


def _acting(signals: Sequence[Signal], rows: np.ndarray) -> np.ndarray | None:
    """Return whether torque was on in these rows of the commands; None where it is not known."""
    found = [
        s for s in signals if s.meaning.quantity == "enabled" and len(s.values) == len(rows) and s.values.ndim == 2
    ]
    return (found[0].values[rows] > 0).min(axis=1) if len(found) == 1 else None


def _follows(found: Following) -> bool:
    best, moved = np.abs(found.r).max(axis=1), found.moved.any(axis=1)
    ratio = evidence.unit_ratio(_at_best(found)[best > SURE])
    return bool(moved.any() and (best[moved] > SURE).mean() > 0.5) and ratio is not None


def _at_best(found: Following) -> np.ndarray:
    best = np.argmax(np.abs(found.r), axis=1)
    return found.slope[np.arange(len(best)), best]


def _joint_order(measured: Signal, asked: Asked, path: str) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """Return which column is which joint of the robot, the joints' names, and what to say of it."""
    own = np.arange(measured.width)
    labels = tuple(label or str(i) for i, label in enumerate(measured.labels))
    if not asked.joints:
        return own, labels, []
    places = [next((i for i, label in enumerate(measured.labels) if same_joint(label, j)), None) for j in asked.joints]
    if all(p is not None for p in places):
        kept = np.array(places)
        moved = "in the robot's order" if (kept == own[: len(kept)]).all() else f"columns {', '.join(map(str, kept))}"
        return kept, asked.joints, [f"joints by the names of columns: {moved}"]
    if any(p is not None for p in places) or len(asked.joints) != measured.width:
        found = ", ".join(label or "no name" for label in measured.labels)
        raise UsageError(
            f"the {measured.width} columns of {measured.name!r} in {path} ({found}) are not the robot's "
            f"{len(asked.joints)} joints: {', '.join(asked.joints)}",
            hint="name the joints that were recorded with --joints, in the order of the columns",
        )
    return own, asked.joints, [
        "columns have no names of joints: they are taken to be in the robot's order, "
        f"{', '.join(asked.joints[:4])}{' ...' if measured.width > 4 else ''}; --joints says another"
    ]  # fmt: skip


def _clocks(stamps: Sequence[Stamps], measured: Signal, command: Signal) -> tuple[list[np.ndarray], float, list[str]]:
    """Return both streams' times, the offset of the commands' clock, and what to say of it."""
    t, c = (s.t_s for s in stamps)
    if stamps[0].source == stamps[1].source and len(t) == len(c):
        return [t, t], 0.0, []
    rows = clean(t, measured), clean(c, command)
    period_s = float(np.median(np.diff(t[rows[0]])))
    overlap = min(t[rows[0]][-1], c[rows[1]][-1]) - max(t[rows[0]][0], c[rows[1]][0])
    apart = overlap < 0.5 * min(np.ptp(t[rows[0]]), np.ptp(c[rows[1]]))
    coarse = float(t[rows[0]][0] - c[rows[1]][0]) if apart else 0.0
    held, joined, _ = evidence.on_grid(
        c[rows[1]] + coarse, command.values[rows[1]], t[rows[0]], measured.values[rows[0]]
    )
    near = evidence.following(held, joined, period_s)
    far = evidence.following(held, joined, period_s, 0.4 * len(joined) * period_s)
    best, farthest = (np.abs(f.r).max(initial=0.0) for f in (near, far))
    if max(best, farthest) < SURE:
        return [t, c], 0.0, ["no measurement follows a command: whether the clocks agree is not known"]
    # Far away a likeness may be chance: it must be close, and much closer than what is near.
    found = far if apart or (farthest > _CLOSE and best < _CLOSE * farthest) else near
    lag_s = float(np.median(found.lag_s[np.abs(found.r) >= 0.98 * np.abs(found.r).max()]))
    if not apart and found is near and lag_s > -0.5 * period_s:
        return [t, c], 0.0, [f"clocks of both streams agree: measurements follow {1e3 * lag_s:.0f} ms later"]
    # Nothing moves before it is told to: one period is left as the least delay that a computer can have.
    offset = coarse + lag_s - period_s
    said = (
        f"the commands' clock is {-offset:.4f} s ahead of the measurements' (r {np.abs(found.r).max():.2f}): "
        "stamp_offset aligns them; what is left of the true delay cannot be told from the clocks"
    )
    return [t, c + offset], offset, [said]


def _goal(
    measured: Signal, command: Signal, found: Following, to_rad: float, path: str
) -> tuple[Signal, list[float], list[str]]:
    """Return goals in the order of the joints, their scales, and what to say of them."""
    ratio = evidence.unit_ratio(_at_best(found)[np.abs(found.r).max(axis=1) > SURE])
    told = {"rad": 1.0, "deg": DEGREES}.get(command.meaning.unit)
    if ratio is None and told is None:
        raise UsageError(
            f"{measured.name!r} follows {command.name!r} in {path}, but neither in radians nor in degrees: "
            f"slopes {', '.join(f'{s:.3g}' for s in _at_best(found)[:6])}",
            hint="write a mapping with the scale that its maker gives",
        )
    unit = to_rad / (ratio or to_rad / (told or 1.0))
    if told is not None and ratio is not None and not np.isclose(told, unit):
        raise UsageError(
            f"{command.name!r} in {path} is in {command.meaning.unit} by its name, but {measured.name!r}, in "
            f"{'degrees' if to_rad != 1 else 'radians'}, follows it with slopes of {_at_best(found)[:3].round(3)}",
            hint="write a mapping with the scales that hold",
        )
    places, said = _command_order(measured, command, found, to_rad / unit, path)
    at = np.arange(len(places)), places
    r, slope, lag = found.r[at], found.slope[at], found.lag_s[at]
    flipped = (r < -SURE) & (np.abs(slope) * unit / to_rad > 0.15)
    scales = [float(-1 / unit if f else 1 / unit) for f in flipped]
    sure = np.abs(r) > SURE
    if sure.any():
        said.append(
            f"{measured.name!r} follows {command.name!r}: r {np.abs(r[sure]).min():.2f} to {np.abs(r[sure]).max():.2f},"
            f" {1e3 * abs(np.median(lag[sure])):.0f} ms later, slope {np.median(np.abs(slope[sure])):.3g}"
            + (": one is in degrees" if ratio not in (1.0, None) else "")
        )
    names = [label or str(i) for i, label in enumerate(measured.labels)]
    if flipped.any():
        said.append(
            f"opposite signs, commands are turned: {', '.join(n for n, f in zip(names, flipped, strict=True) if f)}"
        )
    if (~sure).any():
        weak = ", ".join(f"{n} ({x:.2f})" for n, x, s in zip(names, r, sure, strict=True) if not s)
        said.append(f"no evidence of order and sign for {weak}: they hardly moved, or did not follow")
    return taken(command, places), scales, said


def _command_order(
    measured: Signal, command: Signal, found: Following, scale: float, path: str
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
    best = first[evidence.order(_columns(found, first), scale)]
    if (best == first).all():
        return first, []
    wrong = np.flatnonzero(best != first)
    pairs = ", ".join(f"{measured.sources[i]} follows {command.sources[best[i]]}" for i in wrong)
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


def _columns(found: Following, places: np.ndarray) -> Following:
    spread, mean = ((pair[0], pair[1][places]) for pair in (found.spread, found.mean))
    return Following(found.r[:, places], found.lag_s[:, places], found.slope[:, places], spread, mean)


def _node(
    name: str, fields: dict[str, FieldMapping], stamps: Stamps, signal: Signal, offset_s: float
) -> tuple[NodeMapping, list[str]]:
    """Return a node's mapping, with policies only where the data needs them, and what to say of those."""
    said = []
    missing, repeated = "refuse", "refuse"
    good = signal.finite & np.isfinite(stamps.t_s)
    if not good.all():
        missing = "drop"
        said.append(
            f'{name}: {int((~good).sum())} of {len(good)} samples lack a number: missing = "drop" leaves them out'
        )
    if stamps.repeated:
        repeated = "first"
        said.append(f'{name}: {stamps.repeated} stamps repeat: repeated = "first" keeps the first sample of each')
    steps = np.diff(stamps.t_s[good])
    if stamps.backward:
        k = int(np.argmax(steps < 0))
        raise UsageError(
            f"{stamps.backward} stamps of {stamps.source!r} are earlier than the one before, first that of sample "
            f"{np.flatnonzero(good)[k + 1]}, by {-steps[k]:.4g} s: a clock that was set, or files that were joined in "
            "the wrong order",
            hint="cut the file there, and import the parts one by one",
        )
    long = steps > _GAP * np.median(steps)
    if long.any():
        said.append(
            f"{name}: {int(long.sum())} gaps, the longest {steps.max():.3g} s: they stay gaps, nothing is invented"
        )
    order = int(name == "actuator")
    node = NodeMapping(
        fields, stamps.rate_hz, stamps.source, stamps.unit, order,
        missing=missing, repeated=repeated, stamp_offset=offset_s,
    )  # fmt: skip
    return node, said


def _on_stamps(signal: Signal, stamps: Stamps) -> list[str]:
    if stamps.source is None:
        return [f"{signal.name!r} has no stamps: generated at {stamps.rate_hz:g} Hz ({stamps.said})"]
    return [f"stamps of {signal.name!r} are {stamps.source!r}, in {stamps.unit}: {stamps.said}"]


def pipeline_name(path: Path) -> str:
    """Return a name for the pipeline of a file or a model: letters, digits and underscores."""
    name = "".join(c if c.isalnum() else "_" for c in path.stem.lower()).strip("_")
    return name or "robot"
