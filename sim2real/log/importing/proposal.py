"""Proposes the mapping of a file of another recorder, from names and data, with the evidence."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import evidence
from sim2real.log.importing.command_response import Following, following, on_grid
from sim2real.log.importing.evidence import SURE
from sim2real.log.importing.files.foreign import ForeignFile
from sim2real.log.importing.goals import follows, goal, refuse_copies, refuse_rates
from sim2real.log.importing.mapping import FieldMapping, ImportMapping, NodeMapping
from sim2real.log.importing.pairing import Pair, find_pair
from sim2real.log.importing.plausibility import TURN_RAD
from sim2real.log.importing.positions import CheckedPositions, checked_positions, turned_commands
from sim2real.log.importing.quantities import ImportHints, clean, extras, field_of, matched, taken, unused, velocity_of
from sim2real.log.importing.signal_names import about_torque, meaning, same_joint
from sim2real.log.importing.signals import Signal, Stamps, collect, find_stamps

_FIELDS = {"position": "goal", "velocity": "goal_velocity", "torque": "torque", "duty": "duty", "voltage": "duty"}
_MIN_FAR_R = 0.9
"""Least correlation at a lag that only differing clocks explain."""
_TURN_ERROR = 0.1
"""Means are of the same angle if they differ from whole turns by a smaller share of a turn."""
_GAP = 5.0
"""A longer pause is a gap [periods]."""


@dataclass(frozen=True)
class Proposal:
    """A mapping, and the evidence for it.

    Attributes:
        joints: Names of the columns of measured positions, in the order of the log; numbers without names.
        evidence: Sentences.
    """

    mapping: ImportMapping
    joints: tuple[str, ...]
    evidence: tuple[str, ...]


@np.errstate(over="ignore", invalid="ignore")  # damaged files can hold numbers of any size
def propose(file: ForeignFile, hints: ImportHints) -> Proposal:
    """Return the mapping that fits names and data.

    Raises:
        UsageError: When a choice is ambiguous; the message lists the candidates.
    """
    # Find measurements and commands, their stamps, and the order of the joints.
    signals, unread = collect(file)
    pair, stamps, notes = _streams(file, signals, unread, hints)
    path, command = str(file.path), pair.command
    places, labels, ordered = _joint_order(pair.measured, hints, path)
    places, labels, empty = _with_numbers(pair.measured, places, labels, hints, path)
    # Check positions first: impossible readings are no evidence, and would be motion for an identification.
    checked = checked_positions(file, signals, replace(pair, measured=taken(pair.measured, places)), stamps, hints)
    measured, notes = checked.signal, [*notes, *ordered, *empty, *checked.notes]
    command, turn = turned_commands(command, checked)
    # Compare both on one clock and one time grid.
    clocks, offset_s, shift = _clocks(signals, stamps, measured, command, path)
    rows = clean(clocks[0], measured), clean(clocks[1], command)
    q, c = measured.values[rows[0]], command.values[rows[1]]
    held, joined, period_s = _compared(
        [stamps_s[r] for stamps_s, r in zip(clocks, rows, strict=True)],
        c,
        q,
        _acting(signals, rows[1]),
        [measured, command],
        path,
    )
    circle = TURN_RAD * checked.to_rad if checked.hinges.any() else 0.0
    relation = replace(following(held, joined, period_s), turn=circle)
    # Map commands, further commands and velocity to fields.
    extra, others = extras(signals, command, measured, places, path, np.any(np.abs(relation.r) > SURE, axis=1))
    command, goals, more = _commanded(pair, command, checked, turn, relation, (clocks, rows), places, path, hints)
    velocity, on_velocity, lacking = velocity_of(signals, measured, clocks[0], checked.to_rad, places)
    position = field_of(measured, "rad", [1 / checked.to_rad] * measured.width, checked.turn)
    notes += [*more, *shift]
    nodes = {}
    for name, fields, at, lacks, offset, leapt in (
        ("actuator", goals | extra, stamps[1], ~command.finite, offset_s, np.zeros(len(command.values), bool)),
        ("sensor", {"position": position} | velocity, stamps[0], ~(measured.finite | checked.leapt) | lacking, 0.0,
         checked.leapt),
    ):  # fmt: skip
        nodes[name], policy = _node(name, fields, at, lacks, offset, leapt)
        notes += policy
    notes += about_torque({name: asdict(node) for name, node in nodes.items()})
    notes += [*on_velocity, *others, *unread, *file.notes]
    notes += unused(signals, nodes.values(), notes)
    return Proposal(ImportMapping(hints.pipeline, nodes), labels, tuple(notes))


def _streams(
    file: ForeignFile, signals: Sequence[Signal], unread: Sequence[str], hints: ImportHints
) -> tuple[Pair, list[Stamps], list[str]]:
    """Return measurements and commands, the stamps of both, and notes."""
    path = str(file.path)
    try:
        pair = find_pair(signals, path, hints.rate_hz, hints.joints)
    except UsageError as error:
        raise UsageError("; ".join([error.args[0], *unread]), hint=error.hint) from None
    sides = (pair.measured, "measured"), (pair.command, "command")
    try:
        stamps = [find_stamps(signals, signal, side, path, hints.rate_hz) for signal, side in sides]
    except UsageError:
        _require_readable_stamps(file)
        raise
    notes = [*pair.notes, *_on_stamps(pair.measured, stamps[0])]
    if stamps[1].source != stamps[0].source:
        notes += _on_stamps(pair.command, stamps[1])
    return pair, stamps, notes


def _commanded(
    pair: Pair,
    command: Signal,
    checked: CheckedPositions,
    turn: float,
    relation: Following,
    samples: tuple[Sequence[np.ndarray], Sequence[np.ndarray]],
    places: np.ndarray,
    path: str,
    hints: ImportHints,
) -> tuple[Signal, dict[str, FieldMapping], list[str]]:
    """Return commands in the order of the joints, their field, and notes.

    Args:
        command: The commands, with turns counted.
        turn: A turn in the unit of the commands if turns are counted; else 0.
        samples: Stamps [s] and compared rows, of positions and of commands.
        places: Column of each joint.
    """
    measured, (clocks, rows) = checked.signal, samples
    kind = pair.kind or (
        "position" if command.meaning.unit in ("rad", "deg") or follows(relation, command, path) else "duty"
    )
    # A command without a following position is taken by its name.
    if kind != "position":
        command = _other_command(command, measured, places)
        if not pair.kind:
            refuse_rates(command.values[rows[1]], measured.values[rows[0]], clocks, rows, command.name, path)
        unit = {"velocity": "rad/s", "torque": "N m"}.get(kind, "")
        notes = f"by its name; the largest correlation with a position is {np.abs(relation.r).max():.2f}"
        fields = {_FIELDS[kind]: field_of(command, unit, [1.0] * command.width)}
        return command, fields, [f"{command.name!r} commands {kind}: {notes}"]
    command, scales, more = goal(measured, command, relation, checked.to_rad, path, hints.as_told)
    # Compare goals and positions in radians, for turns and copies.
    in_rad = command.values[rows[1]] * scales, measured.values[rows[0]] / checked.to_rad
    turn, on_turns = _circle(command, turn, *in_rad, abs(scales[0]), checked.hinges)
    copies = evidence.copied(clocks[1][rows[1]], clocks[0][rows[0]], *in_rad)
    notes = on_turns + refuse_copies(measured, command, copies, path, hints.as_told)
    return command, {"goal": field_of(command, "rad", scales, turn)}, [*more, *notes]


def _require_readable_stamps(file: ForeignFile) -> None:
    """Raise the error of a signal with the name of a time stamp that cannot be read."""
    for key in file.keys:
        if meaning(key).quantity == "stamp":
            file.signal(key)


def _acting(signals: Sequence[Signal], rows: np.ndarray) -> np.ndarray | None:
    """Return whether torque is on in these rows of the commands; None if unknown."""
    enabled = [
        s for s in signals if s.meaning.quantity == "enabled" and len(s.values) == len(rows) and s.values.ndim == 2
    ]
    return (enabled[0].values[rows] > 0).min(axis=1) if len(enabled) == 1 else None


def _circle(
    command: Signal, turn: float, goal_rad: np.ndarray, q_rad: np.ndarray, scale: float, hinges: np.ndarray
) -> tuple[float, list[str]]:
    """Return a turn in the unit of the goals if turns are counted or differ, else 0; and notes."""
    if turn:
        return turn, [f"{command.name!r} jumps at the end of a turn: turns are counted"]
    apart = (goal_rad.mean(axis=0) - q_rad.mean(axis=0)) / TURN_RAD
    other = hinges & (np.abs(apart) > 0.5) & (np.abs(apart - np.round(apart)) < _TURN_ERROR)
    if not other.any():
        return 0.0, []
    who = ", ".join(np.array(command.sources)[other])
    return TURN_RAD / scale, [f"{who} is a turn away from its position: it is brought to the same turn"]


def _other_command(command: Signal, measured: Signal, places: np.ndarray) -> Signal:
    """Return commands other than goals, in the order of the joints."""
    if command.width != measured.width and not set(measured.labels) <= set(command.labels) - {""}:
        raise UsageError(
            f"{command.name!r} has {command.width} columns, {measured.name!r} {measured.width}",
            hint="write a mapping with the columns that belong together",
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
    """Return commands and positions on one grid of time, and its period [s]."""
    held, joined, period_s = (
        on_grid(t_s[1], command, t_s[0], q, acting) if min(map(len, t_s)) > 2 else (q[:0], q[:0], 1.0)
    )
    if len(held) < 50:
        raise UsageError(
            f"{path} has {len(held)} samples with both {pair[0].name!r} and {pair[1].name!r}",
            hint="these are too few for a correlation: write a mapping",
        )
    return held, joined, period_s


def _with_numbers(
    measured: Signal, places: np.ndarray, labels: tuple[str, ...], hints: ImportHints, path: str
) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """Return the joints that have numbers, and notes on the others."""
    with_numbers = np.asarray(np.isfinite(measured.values[:, places]).any(axis=0))
    if with_numbers.all():
        return places, labels, []
    empty = ", ".join(measured.sources[i] for i in places[~with_numbers])
    if hints.joints or not with_numbers.any():
        raise UsageError(
            f"{empty} in {path} has no number in any sample", hint="name only the other joints with --joints"
        )
    names = tuple(label for label, k in zip(labels, with_numbers.tolist(), strict=True) if k)
    return places[with_numbers], names, [f"skipped: {empty} has no number in any sample"]


def _joint_order(measured: Signal, hints: ImportHints, path: str) -> tuple[np.ndarray, tuple[str, ...], list[str]]:
    """Return the column of each joint of the robot, the joints' names, and notes."""
    in_order = np.arange(measured.width)
    labels = tuple(label or str(i) for i, label in enumerate(measured.labels))
    if not hints.joints:
        return in_order, labels, []
    # Find each joint of the robot among the names of the columns.
    places = [next((i for i, label in enumerate(measured.labels) if same_joint(label, j)), None) for j in hints.joints]
    if all(p is not None for p in places):
        selected = np.array(places)
        moved = (
            "in the robot's order"
            if (selected == in_order[: len(selected)]).all()
            else f"columns {', '.join(map(str, selected))}"
        )
        return selected, hints.joints, [f"joints by the names of columns: {moved}"]
    if any(p is not None for p in places) or len(hints.joints) != measured.width:
        labels_text = ", ".join(label or "no name" for label in measured.labels)
        raise UsageError(
            f"the {measured.width} columns of {measured.name!r} in {path} ({labels_text}) are not the robot's "
            f"{len(hints.joints)} joints: {', '.join(hints.joints)}",
            hint="name the recorded joints with --joints, in the order of the columns",
        )
    return in_order, hints.joints, [
        "columns have no names of joints, so the robot's order is assumed: "
        f"{', '.join(hints.joints[:4])}{' ...' if measured.width > 4 else ''}; --joints sets another"
    ]  # fmt: skip


def _clocks(
    signals: Sequence[Signal], stamps: Sequence[Stamps], measured: Signal, command: Signal, path: str
) -> tuple[list[np.ndarray], float, list[str]]:
    """Return both streams' times, the offset of the commands' clock [s], and notes."""
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
        return [t, c], 0.0, ["no measurement follows a command, so the agreement of the clocks is unknown"]
    # A correlation at a large lag can be chance: it must be high, and much higher than at small lags.
    relation = far if apart or (farthest > _MIN_FAR_R and best < _MIN_FAR_R * farthest) else near
    sure = np.abs(relation.r) >= 0.98 * np.abs(relation.r).max()
    lag_s = float(np.median(relation.lag_s[sure]))
    # Stamps of one recorder are of one clock: `goal` reports positions that move first on it.
    one_clock = all((s.source or "").endswith(".log_time") for s in stamps)
    if not apart and (one_clock or (relation is near and lag_s > -0.5 * period_s)):
        return (
            [t, c],
            0.0,
            [f"clocks of both streams agree: measurements follow {1e3 * lag_s:.0f} ms later"] * (not one_clock),
        )
    if not apart and _leads_on_recorder(signals, (measured, command), rows):
        return [t, c], 0.0, []  # a difference of clocks does not explain the lead
    if (np.isfinite(relation.against_s) | np.isfinite(relation.repeats_s) | relation.either)[sure].all():
        raise UsageError(
            f"the clocks of {measured.name!r} and {command.name!r} in {path} do not agree, and their "
            "offset is ambiguous, as the commands repeat",
            hint="write it into a mapping as stamp_offset, or record a motion that does not repeat",
        )
    # A measurement follows its command: keep one period, the least delay of a computer.
    offset = coarse + lag_s - period_s
    notes = (
        f"the commands' clock is {-offset:.4f} s ahead of the measurements' (r {np.abs(relation.r).max():.2f}), unless "
        "their names are exchanged: stamp_offset aligns them; the clocks do not determine the true delay"
    )
    return [t, c + offset], offset, [notes]


def _leads_on_recorder(
    signals: Sequence[Signal], pair: tuple[Signal, Signal], rows: tuple[np.ndarray, np.ndarray]
) -> bool:
    """Return whether positions move before their commands also on the recorder's clock, which both share."""
    names = [s.sources[0].partition(".")[0] + ".log_time" for s in pair]
    log_times = [s.values[:, 0] * 1e-9 for name in names for s in signals if s.name == name]
    if [len(x) for x in log_times] != [len(r) for r in rows]:
        return False
    q, c = (s.values[r] for s, r in zip(pair, rows, strict=True))
    held, joined, period_s = on_grid(log_times[1][rows[1]], c, log_times[0][rows[0]], q)
    relation = following(held, joined, period_s)
    sure = np.abs(relation.r) > SURE
    return bool(sure.any() and np.median(relation.lag_s[sure]) < -1.5 * period_s)


def _node(
    name: str, fields: dict[str, FieldMapping], stamps: Stamps, lacks: np.ndarray, offset_s: float, leapt: np.ndarray
) -> tuple[NodeMapping, list[str]]:
    """Return a node's mapping, with the policies that its data needs, and notes on them."""
    notes = []
    missing, repeated = "refuse", "refuse"
    # Choose policies for samples without numbers and with repeated stamps.
    good = ~lacks & np.isfinite(stamps.t_s)
    if not good.all():
        missing = "drop"
        notes.append(f'{name}: {int((~good).sum())} of {len(good)} samples lack a number: missing = "drop" skips them')
    if stamps.repeated:
        repeated = "first"
        notes.append(f'{name}: {stamps.repeated} stamps repeat: repeated = "first" keeps the first sample of each')
    steps = np.diff(stamps.t_s[good])
    # A clock that steps back leaves the order of the samples open.
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
        notes.append(f"{name}: {int(long.sum())} gaps, the longest {steps.max():.3g} s: they stay gaps")
    order = int(name == "actuator")
    node = NodeMapping(
        fields, stamps.rate_hz, stamps.source, stamps.unit, order,
        missing=missing, repeated=repeated, stamp_offset=offset_s,
        implausible="drop" if leapt.any() else "refuse",
    )  # fmt: skip
    return node, notes


def _on_stamps(signal: Signal, stamps: Stamps) -> list[str]:
    if stamps.source is None:
        return [f"{signal.name!r} has no stamps: generated at {stamps.rate_hz:g} Hz ({stamps.reason})"]
    return [f"stamps of {signal.name!r} are {stamps.source!r}, in {stamps.unit}: {stamps.reason}"]


def pipeline_name(path: Path) -> str:
    """Return a name for the pipeline of a file or a model: letters, digits and underscores."""
    name = "".join(c if c.isalnum() else "_" for c in path.stem.lower()).strip("_")
    return name or "robot"
