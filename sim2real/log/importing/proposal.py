"""Proposes the mapping of a file of another recorder: from names and from the data, with the evidence for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import Following, following, on_grid
from sim2real.log.importing.evidence import SURE
from sim2real.log.importing.files.foreign import ForeignFile
from sim2real.log.importing.goals import follows, goal, refuse_copies
from sim2real.log.importing.mapping import FieldMapping, ImportMapping, NodeMapping
from sim2real.log.importing.pairing import Pair, find_pair
from sim2real.log.importing.plausibility import TURN_RAD
from sim2real.log.importing.positions import CheckedPositions, checked_positions, turned_commands
from sim2real.log.importing.quantities import Asked, clean, extras, field_of, matched, taken, velocity_of
from sim2real.log.importing.signal_names import meaning, same_joint
from sim2real.log.importing.signals import Signal, Stamps, collect, find_stamps

_FIELDS = {"position": "goal", "velocity": "goal_velocity", "torque": "torque", "duty": "duty", "voltage": "duty"}
_CLOSE = 0.9
"""Correlation of two streams whose clocks differ."""
_SAME_ANGLE = 0.1
"""Means that differ by whole turns but for this share of one are of the same angle."""
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

    Raises:
        UsageError: When something is ambiguous: the candidates are named.
    """
    signals, unread = collect(file)
    pair, stamps, said = _streams(file, signals, unread, asked)
    path, command = str(file.path), pair.command
    places, labels, ordered = _joint_order(pair.measured, asked, path)
    places, labels, empty = _with_numbers(pair.measured, places, labels, asked, path)
    # Positions that no joint can have had are no evidence, and would be motion to an identification.
    checked = checked_positions(file, signals, replace(pair, measured=taken(pair.measured, places)), stamps, asked)
    measured, said = checked.signal, [*said, *ordered, *empty, *checked.said]
    command, turn = turned_commands(command, checked)
    clocks, offset_s, shift = _clocks(signals, stamps, measured, command, path)
    rows = clean(clocks[0], measured), clean(clocks[1], command)
    q, c = measured.values[rows[0]], command.values[rows[1]]
    held, joined, period_s = _compared(
        [own[r] for own, r in zip(clocks, rows, strict=True)],
        c,
        q,
        _acting(signals, rows[1]),
        [measured, command],
        path,
    )
    circle = TURN_RAD * checked.to_rad if checked.hinges.any() else 0.0
    found = replace(following(held, joined, period_s), turn=circle)
    extra, others = extras(signals, command, measured, places, path, bool((np.abs(found.r) > SURE).any()))
    command, goals, more = _commanded(pair, command, checked, turn, found, (clocks, rows), places, path, asked)
    velocity, on_velocity, lacking = velocity_of(signals, measured, clocks[0], checked.to_rad, places)
    position = field_of(measured, "rad", [1 / checked.to_rad] * measured.width, checked.turn)
    said += [*more, *shift]
    nodes = {}
    for name, fields, at, lacks, offset, leapt in (
        ("actuator", goals | extra, stamps[1], ~command.finite, offset_s, np.zeros(len(command.values), bool)),
        ("sensor", {"position": position} | velocity, stamps[0], ~(measured.finite | checked.leapt) | lacking, 0.0,
         checked.leapt),
    ):  # fmt: skip
        nodes[name], policy = _node(name, fields, at, lacks, offset, leapt)
        said += policy
    said += [*on_velocity, *others, *unread, *file.notes]
    return Proposal(ImportMapping(asked.pipeline, nodes), labels, tuple(said))


def _streams(
    file: ForeignFile, signals: Sequence[Signal], unread: Sequence[str], asked: Asked
) -> tuple[Pair, list[Stamps], list[str]]:
    """Return what was measured and what was commanded, the stamps of both, and what to say of them.

    Raises:
        UsageError: When there is none, or more than one.
    """
    path = str(file.path)
    try:
        pair = find_pair(signals, path, asked.rate_hz, asked.joints)
    except UsageError as error:
        raise UsageError("; ".join([error.args[0], *unread]), hint=error.hint) from None
    sides = (pair.measured, "measured"), (pair.command, "command")
    try:
        stamps = [find_stamps(signals, signal, side, path, asked.rate_hz) for signal, side in sides]
    except UsageError:
        _require_readable_stamps(file)
        raise
    said = [*pair.said, *_on_stamps(pair.measured, stamps[0])]
    if stamps[1].source != stamps[0].source:
        said += _on_stamps(pair.command, stamps[1])
    return pair, stamps, said


def _commanded(
    pair: Pair,
    command: Signal,
    checked: CheckedPositions,
    turn: float,
    found: Following,
    samples: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
    places: np.ndarray,
    path: str,
    asked: Asked,
) -> tuple[Signal, dict[str, FieldMapping], list[str]]:
    """Return commands in the order of the joints, the field that they become, and what to say of them.

    Args:
        command: The commands, with turns counted.
        turn: A turn in the unit of the commands, where turns are counted; else 0.
        samples: Stamps [s] and rows that are compared, of positions and of commands.
        places: Which column is which joint.
        path: The file, for errors.
    """
    measured, (clocks, rows) = checked.signal, samples
    kind = pair.kind or (
        "position" if command.meaning.unit in ("rad", "deg") or follows(found, command, path) else "duty"
    )
    if kind != "position":
        command = _other_command(command, measured, places)
        unit = {"velocity": "rad/s", "torque": "N m"}.get(kind, "")
        said = f"it goes by its name, no position follows it (|r| at most {np.abs(found.r).max():.2f})"
        fields = {_FIELDS[kind]: field_of(command, unit, [1.0] * command.width)}
        return command, fields, [f"{command.name!r} commands {kind}: {said}"]
    command, scales, more = goal(measured, command, found, checked.to_rad, path, asked.as_told)
    in_rad = command.values[rows[1]] * scales, measured.values[rows[0]] / checked.to_rad
    turn, circle = _circle(command, turn, *in_rad, abs(scales[0]), checked.hinges)
    copies = evidence.copied(clocks[1][rows[1]], clocks[0][rows[0]], *in_rad)
    said = circle + refuse_copies(measured, command, copies, path, asked.as_told)
    return command, {"goal": field_of(command, "rad", scales, turn)}, [*more, *said]


def _require_readable_stamps(file: ForeignFile) -> None:
    """Raise the error of a signal that is named like a time stamp, but cannot be read."""
    for key in file.keys:
        if meaning(key).quantity == "stamp":
            file.signal(key)


def _acting(signals: Sequence[Signal], rows: np.ndarray) -> np.ndarray | None:
    """Return whether torque was on in these rows of the commands; None where it is not known."""
    found = [
        s for s in signals if s.meaning.quantity == "enabled" and len(s.values) == len(rows) and s.values.ndim == 2
    ]
    return (found[0].values[rows] > 0).min(axis=1) if len(found) == 1 else None


def _circle(
    command: Signal, turn: float, goal_rad: np.ndarray, q_rad: np.ndarray, scale: float, hinges: np.ndarray
) -> tuple[float, list[str]]:
    """Return a turn in the unit of the goals, where turns are counted or differ, else 0, and what to say of it."""
    if turn:
        return turn, [f"{command.name!r} jumps at the end of a turn: turns are counted"]
    apart = (goal_rad.mean(axis=0) - q_rad.mean(axis=0)) / TURN_RAD
    other = hinges & (np.abs(apart) > 0.5) & (np.abs(apart - np.round(apart)) < _SAME_ANGLE)
    if not other.any():
        return 0.0, []
    who = ", ".join(np.array(command.sources)[other])
    return TURN_RAD / scale, [f"{who} is a turn away from its position: it is brought to the same turn"]


def _other_command(command: Signal, measured: Signal, places: np.ndarray) -> Signal:
    """Return commands that are no goals, in the order of the joints.

    Raises:
        UsageError: When they are not as many as the joints, and have no names to choose by.
    """
    if command.width != measured.width and not set(measured.labels) <= set(command.labels) - {""}:
        raise UsageError(
            f"{command.name!r} has {command.width} columns, {measured.name!r} {measured.width}",
            hint="name which belong together in a mapping",
        )
    return matched(command, measured, places)


def _compared(
    t_s: Sequence[np.ndarray],
    command: np.ndarray,
    q: np.ndarray,
    acting: np.ndarray | None,
    pair: Sequence[Signal],
    path: str,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return commands and positions on one grid of time, and its period [s].

    Raises:
        UsageError: When they have too little time in common.
    """
    held, joined, period_s = (
        on_grid(t_s[1], command, t_s[0], q, acting) if min(map(len, t_s)) > 2 else (q[:0], q[:0], 1.0)
    )
    if len(held) < 50:
        raise UsageError(
            f"{path} has {len(held)} samples at which both {pair[0].name!r} and {pair[1].name!r} are known",
            hint="that is too few to tell what follows what: write a mapping",
        )
    return held, joined, period_s


def _with_numbers(
    measured: Signal, places: np.ndarray, labels: tuple[str, ...], asked: Asked, path: str
) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """Return the joints that have numbers, and what to say of the others.

    Raises:
        UsageError: When a joint that was asked for has none.
    """
    kept = np.asarray(np.isfinite(measured.values[:, places]).any(axis=0))
    if kept.all():
        return places, labels, []
    empty = ", ".join(measured.sources[i] for i in places[~kept])
    if asked.joints or not kept.any():
        raise UsageError(
            f"{empty} in {path} has no number in any sample",
            hint="leave that joint out: --joints names those that count",
        )
    names = tuple(label for label, k in zip(labels, kept.tolist(), strict=True) if k)
    return places[kept], names, [f"left out: {empty} has no number in any sample"]


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


def _clocks(
    signals: Sequence[Signal], stamps: Sequence[Stamps], measured: Signal, command: Signal, path: str
) -> tuple[list[np.ndarray], float, list[str]]:
    """Return both streams' times, the offset of the commands' clock, and what to say of it.

    Raises:
        UsageError: When the clocks differ, and a command that repeats leaves open by how much.
    """
    t, c = (s.t_s for s in stamps)
    if stamps[0].source == stamps[1].source and len(t) == len(c):
        return [t, t], 0.0, []
    rows = clean(t, measured), clean(c, command)
    if min(r.sum() for r in rows) < 3:
        return [t, c], 0.0, []
    period_s = float(np.median(np.diff(t[rows[0]])))
    overlap = min(t[rows[0]][-1], c[rows[1]][-1]) - max(t[rows[0]][0], c[rows[1]][0])
    apart = overlap < 0.5 * min(np.ptp(t[rows[0]]), np.ptp(c[rows[1]]))
    coarse = float(t[rows[0]][0] - c[rows[1]][0]) if apart else 0.0
    held, joined, _ = on_grid(c[rows[1]] + coarse, command.values[rows[1]], t[rows[0]], measured.values[rows[0]])
    near = following(held, joined, period_s)
    far = following(held, joined, period_s, 0.4 * len(joined) * period_s)
    best, farthest = (np.abs(f.r).max(initial=0.0) for f in (near, far))
    if max(best, farthest) < SURE:
        return [t, c], 0.0, ["no measurement follows a command: whether the clocks agree is not known"]
    # Far away a likeness may be chance: it must be close, and much closer than what is near.
    found = far if apart or (farthest > _CLOSE and best < _CLOSE * farthest) else near
    sure = np.abs(found.r) >= 0.98 * np.abs(found.r).max()
    lag_s = float(np.median(found.lag_s[sure]))
    # One recorder's clock is one clock: what moves first on it is said where signs and lags are.
    one = all((s.source or "").endswith(".log_time") for s in stamps)
    if not apart and (one or (found is near and lag_s > -0.5 * period_s)):
        return (
            [t, c],
            0.0,
            [f"clocks of both streams agree: measurements follow {1e3 * lag_s:.0f} ms later"] * (not one),
        )
    if not apart and _leads_on_recorder(signals, (measured, command), rows):
        return [t, c], 0.0, []  # no clock explains it
    if (np.isfinite(found.against_s) | np.isfinite(found.repeats_s) | found.either)[sure].all():
        raise UsageError(
            f"the clocks of {measured.name!r} and {command.name!r} in {path} do not agree, and commands that repeat "
            "leave open by how much",
            hint="say it in a mapping: stamp_offset, or record a motion that does not repeat",
        )
    # Nothing moves before it is told to: one period is left as the least delay that a computer can have.
    offset = coarse + lag_s - period_s
    said = (
        f"the commands' clock is {-offset:.4f} s ahead of the measurements' (r {np.abs(found.r).max():.2f}), unless "
        "their names are exchanged: stamp_offset aligns them; what is left of the true delay cannot be told by clocks"
    )
    return [t, c + offset], offset, [said]


def _leads_on_recorder(
    signals: Sequence[Signal], pair: tuple[Signal, Signal], rows: tuple[np.ndarray, np.ndarray]
) -> bool:
    """Return whether positions move before their commands by the recorder's clock, too, which is one for both."""
    names = [s.sources[0].partition(".")[0] + ".log_time" for s in pair]
    found = [s.values[:, 0] * 1e-9 for name in names for s in signals if s.name == name]
    if [len(x) for x in found] != [len(r) for r in rows]:
        return False
    q, c = (s.values[r] for s, r in zip(pair, rows, strict=True))
    held, joined, period_s = on_grid(found[1][rows[1]], c, found[0][rows[0]], q)
    own = following(held, joined, period_s)
    sure = np.abs(own.r) > SURE
    return bool(sure.any() and np.median(own.lag_s[sure]) < -1.5 * period_s)


def _node(
    name: str, fields: dict[str, FieldMapping], stamps: Stamps, lacks: np.ndarray, offset_s: float, leapt: np.ndarray
) -> tuple[NodeMapping, list[str]]:
    """Return a node's mapping, with policies only where the data needs them, and what to say of those."""
    said = []
    missing, repeated = "refuse", "refuse"
    good = ~lacks & np.isfinite(stamps.t_s)
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
        implausible="drop" if leapt.any() else "refuse",
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
