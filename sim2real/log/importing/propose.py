"""Proposes the mapping of a file from its names; what they leave open becomes a question; data only check it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import checks, lerobot
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.mapping import FieldMapping, ImportMapping, NodeMapping, in_si
from sim2real.log.importing.names import Meaning, about_torque, are_numbers, columns_of, meaning
from sim2real.log.importing.readers import Table
from sim2real.log.importing.signals import ImportHints, Proposal, Signal, collect, require_overlap, stamped

_FIELDS = {"position": "goal", "velocity": "goal_velocity", "torque": "torque", "duty": "duty", "voltage": "duty"}
_EXTRA = {
    "kp": ("kp", None, ""),
    "kd": ("kd", None, ""),
    "enabled": ("enabled", None, ""),
    "torque": ("torque", "command", "N m"),
    "payload": ("payload", None, "kg"),
    "payload_reach": ("reach", None, "m"),
}
"""Commands beside a goal: field -> quantity, side or None for any, and unit."""
_ANGLES_AND_LENGTHS = ("rad", "deg", "rev", "mrad", "m", "mm")


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # damaged files can hold numbers of any size
def propose(table: Table, hints: ImportHints) -> Proposal:
    """Return the mapping that names and units give, checked against the data.

    Raises:
        UsageError: When names do not match those of the robot, or the data contradict the names.
    """
    signals, notes = collect(table)
    draft = Proposal(ImportMapping(hints.pipeline, {}), evidence=[*table.notes, *notes])
    # Which columns are the positions and the commands, and of which joints.
    measured = _choose(signals, "measured", table, hints, draft)
    command = _choose([s for s in signals if s is not measured], "command", table, hints, draft, measured)
    places, draft.joints = _joint_order(measured, hints, table, draft)
    measured = measured.taken(places)
    command, by_name = _matched(command, measured, places, draft, table)
    # Their clocks and units.
    sides = {"actuator": command, "sensor": measured}
    nodes, clocks = {}, {}
    for node, signal in sides.items():
        nodes[node], clocks[node] = stamped(signals, signal, node, table, hints, draft)
    require_overlap(clocks, draft)
    kind = command.meaning.quantity or "position"
    goal = _FIELDS[kind]
    angles = {("sensor", "position"): measured} | ({("actuator", goal): command} if kind == "position" else {})
    units, inferred = _units(angles, table, hints, draft)
    fields = {
        "actuator": {goal: command.mapped({"velocity": "rad/s", "torque": "N m", "voltage": "V"}.get(kind, ""))},
        "sensor": {},
    }
    for (node, name), signal in angles.items():
        fields[node][name] = _angle(signal, units[node], hints, (node, name), draft)
    if kind != "position":
        draft.reasons["actuator", goal, "source"] = f"commands {kind}, by its name"
    _extras(signals, command, measured, places, fields, clocks, draft)
    for node, signal in sides.items():
        _policies(node, nodes[node], fields[node].get("position"), signal, clocks[node], draft)
    draft.mapping = ImportMapping(
        hints.pipeline, {n: NodeMapping(_in_lengths(fields[n], hints), **nodes[n]) for n in nodes}
    )
    draft.evidence += about_torque({n: msgspec.to_builtins(node) for n, node in draft.mapping.nodes.items()})
    draft.evidence += _unused(signals, draft)
    if not draft.questions:
        _check(table, draft, by_name, inferred, hints)
    return draft


# -- positions, commands, and their joints


def _choose(
    signals: Sequence[Signal],
    side: str,
    table: Table,
    hints: ImportHints,
    draft: Proposal,
    other: Signal | None = None,
) -> Signal:
    """Return the measured positions, or the commands, by their names; ask if names do not decide."""
    series = [s for s in signals if s.values.ndim == 2 and len(s.values) > 2]
    ranked = {s.name: rank for s in series if (rank := _rank(s.meaning, side)) is not None}
    best = [s for s in series if ranked.get(s.name) == min(ranked.values())] if ranked else []
    # Of several, take those of the robot's joints, or as wide as the other side; equal ones are the same.
    if len(best) > 1 and hints.joints:
        best = [s for s in best if columns_of(hints.joints, s.labels)] or best
    if len(best) > 1 and other is not None:
        named = [s for s in best if set(other.labels) == set(s.labels) != {""}]
        best = named or [s for s in best if s.width == other.width] or best
    unlike: list[Signal] = []
    for s in best:
        if not any(np.array_equal(s.values, b.values, equal_nan=True) for b in unlike):
            unlike.append(s)
    if len(unlike) == 1:
        return unlike[0]
    choices = unlike or [s for s in series if s.meaning.quantity in ("", "position")]
    if other is not None:  # the likeliest first
        choices.sort(key=lambda s: (set(s.labels) != set(other.labels), s.width != other.width))
    if not choices:
        raise UsageError(
            f"{table.path} has no {'measured positions' if side == 'measured' else 'commands'}. "
            f"Columns: {', '.join(table.keys[:40]) or 'none'}" + "".join(f"; {note}" for note in draft.evidence[:5]),
            hint="name them by quantity and joint, such as q_hip_rad and goal_hip_rad, or write a mapping",
        )
    listed = " or ".join(
        f'"{s.whole or s.sources[0]}"' if s.whole or s.width == 1 else f'["{s.sources[0]}", ...]' for s in choices[:12]
    )
    at, what = (
        (("sensor", "position", "source"), "which are the measured positions")
        if side == "measured"
        else (("actuator", "goal", "source"), "which commands drove the joints")
    )
    draft.questions[at] = f"{listed}?  # {what}: names do not say"
    return choices[0]


def _rank(named: Meaning, side: str) -> int | None:
    """Return how well a name fits the measured positions or the commands, 0 best; None: not at all."""
    position = named.quantity == "position"
    if side == "measured":
        if not position and named.quantity:
            return None
        return {("measured", True): 0, ("", True): 1, ("measured", False): 2}.get((named.side, position))
    if named.side == "command" and (position or not named.quantity):
        return 0 if position else 1
    if named.side == "command" and named.quantity in _FIELDS:
        return 2
    return {"duty": 3, "voltage": 3, "torque": 4}.get(named.quantity) if not named.side else None


def _joint_order(
    measured: Signal, hints: ImportHints, table: Table, draft: Proposal
) -> tuple[list[int], tuple[str, ...]]:
    """Return the column of each joint of the robot, and the joints' names."""
    labels, in_order = measured.labels, list(range(measured.width))
    if not hints.joints:
        finite = [bool(np.isfinite(column).any()) for column in measured.values.T]
        if not all(finite):
            empty = ", ".join(measured.sources[i] for i in in_order if not finite[i])
            draft.evidence.append(f"skipped: {empty} has no number in any sample")
        kept = [i for i in in_order if finite[i]]
        return kept, tuple(labels[i] or str(i) for i in kept)
    at = "sensor", "position", "source"
    if any(labels) and (found := columns_of(hints.joints, labels)) is not None:
        places, draft.reasons[at] = found
        if found[1] != "by name":
            pairs = ", ".join(f"{labels[i]} is {joint}" for joint, i in zip(hints.joints, places, strict=True))
            draft.evidence.append(f"joints {found[1]}: {pairs}")
        return places, hints.joints
    named = any(labels) and not are_numbers(labels)
    if (named and not hints.as_told) or len(hints.joints) != measured.width:
        raise UsageError(
            f"the {measured.width} columns of {measured.name!r} in {table.path} "
            f"({', '.join(label or 'no name' for label in labels)}) are not the robot's {len(hints.joints)} joints: "
            f"{', '.join(hints.joints)}",
            hint="name the recorded joints as the file does, or list the sources in a mapping in the robot's order"
            + ("; --as-told takes the file's order for the robot's" if len(hints.joints) == measured.width else ""),
        )
    draft.reasons[at] = "no names of joints: the robot's order is assumed"
    draft.evidence.append(
        f"columns have no names of joints, so the robot's order is assumed: {', '.join(hints.joints)}; --joints sets "
        "another"
    )
    return in_order, hints.joints


def _matched(
    command: Signal, measured: Signal, places: Sequence[int], draft: Proposal, table: Table
) -> tuple[Signal, bool]:
    """Return the commands in the order of the joints, and whether names match them."""
    if all(measured.labels) and set(measured.labels) <= set(command.labels):
        return command.taken([command.labels.index(label) for label in measured.labels]), True
    if ("actuator", "goal", "source") in draft.questions:
        return command, True
    for joints in (measured.labels, draft.joints):
        if all(joints) and any(command.labels) and (found := columns_of(joints, command.labels)) is not None:
            if found[1] != "by name":
                draft.evidence.append(f"commands belong to positions {found[1]}")
            return command.taken(found[0]), True
    named = all(measured.labels) and all(command.labels)
    if named and not (are_numbers(measured.labels) and are_numbers(command.labels)):
        raise UsageError(
            f"the commands {command.name!r} in {table.path} are of {', '.join(command.labels)}, the positions "
            f"{measured.name!r} of {', '.join(measured.labels)}",
            hint="give the joints the same names on both sides, or write a mapping with the sources in one order",
        )
    if command.width == measured.width:
        ordered = command
    elif command.width > max(places, default=0) and not any(command.labels):
        ordered = command.taken(places)
    else:
        raise UsageError(
            f"{command.name!r} in {table.path} has {command.width} columns, {measured.name!r} {measured.width}",
            hint="write a mapping with the columns that belong together",
        )
    if measured.width > 1:
        draft.evidence.append(f"{command.name!r} and {measured.name!r} belong together by their order")
    return ordered, measured.width == 1


# -- units


def _units(
    angles: Mapping[tuple[str, str], Signal], table: Table, hints: ImportHints, draft: Proposal
) -> tuple[dict[str, str], list[tuple[str, str]]]:
    """Return node -> unit of its positions or goals, empty for a question, and the fields whose unit no name has."""
    found = {at: _unit(signal, table, hints) for at, signal in angles.items()}
    known = {unit for unit, _ in found.values() if unit}
    units, inferred = {}, []
    for (node, name), (unit, reason) in found.items():
        if not unit and not reason and len(known) == 1:
            (unit,) = known
            reason = f"as the {'goals' if node == 'sensor' else 'positions'}: its own name has none"
            inferred.append((node, name))
        if unit:
            draft.reasons[node, name, "unit"] = reason
        else:
            q = angles[node, name].values
            spans = np.nanmax(q, axis=0) - np.nanmin(q, axis=0)
            draft.questions[node, name, "unit"] = (
                f'{reason or """"rad" or "deg"?"""}  # it spans up to {spans.max():.4g}, and its name has no unit; '
                "--unit answers, too"
            )
        units[node] = unit
    return units, inferred


def _unit(signal: Signal, table: Table, hints: ImportHints) -> tuple[str, str]:
    """Return a signal's unit by flag, name or kind of file, and the reason; without a unit the candidates, if known."""
    names = tuple(table.names.get(signal.whole or "", ()))
    of_columns = {meaning(name).unit for name in names}
    named = signal.meaning.unit or (of_columns.pop() if len(of_columns) == 1 else "")
    if hints.unit:
        if hints.unit == "hundredths" and hints.calibration is None:
            raise UsageError("hundredths of a joint's range need LeRobot's calibration", hint="--calibration FILE.json")
        percent = [x for x in signal.labels if lerobot.is_gripper(x)] if table.robot and not hints.calibration else []
        if percent:
            raise UsageError(
                f"LeRobot writes {', '.join(percent)} as 0 to 100 of its range, which is in no unit of angle",
                hint="--calibration FILE.json converts it",
            )
        return hints.unit, "--unit"
    if named in _ANGLES_AND_LENGTHS:
        return named, "by its name"
    if named in ("counts", "percent"):
        return "", '"counts:4096"?' if named == "counts" else '"rad" with a scale, as percent of which angle?'
    if lerobot.writes_hundredths(table.robot, names or signal.sources):
        unit = lerobot.unit_of(hints.calibration, signal.labels, signal.values) if hints.calibration else None
        if unit:
            return unit, "whole counts by LeRobot's calibration"
        return "", '"deg" or "hundredths" (with --calibration)?'
    key = (signal.whole or signal.sources[0]).lower()
    if table.format == "mcap" or re.search(r"joint_?states?|field\.(position|header)", key):
        return "rad", "messages of ROS are in radians"
    if re.search(r"qpos|dof_?pos", key):
        return "rad", "MuJoCo and Isaac are in radians"
    if hints.slides:
        return "", '"m" or "mm"?' if len(hints.slides) == len(hints.joints) else '"rad" (and m) or another?'
    return "", ""


def _angle(signal: Signal, unit: str, hints: ImportHints, at: tuple[str, str], draft: Proposal) -> FieldMapping:
    """Return the field of positions or goals: by LeRobot's calibration, and with a turn if they jump at its end."""
    if hints.calibration is not None and unit in lerobot.UNITS:
        scale, offset = lerobot.conversion(hints.calibration, signal.labels, unit)
        return signal.mapped("rad", scale=tuple(scale), offset=tuple(offset))
    factor, si = in_si(unit)
    rows = signal.values[np.isfinite(signal.values).all(axis=1)]
    if si != "rad" or len(rows) < 3 or not checks.turns(rows, 2 * np.pi / factor).any():
        return signal.mapped(unit)
    draft.reasons[(*at, "turn")] = "it jumps at the end of a turn: turns are counted"
    return signal.mapped(unit, turn=2 * np.pi / factor)


def _in_lengths(fields: Mapping[str, FieldMapping], hints: ImportHints) -> dict[str, FieldMapping]:
    """Return fields with the units of slides: lengths, or none where a robot has hinges and slides."""
    found = dict(fields)
    for name, how in fields.items() if hints.slides else ():
        si = in_si(how.unit)[1]
        length = {"rad": "m", "rad/s": "m/s", "N m": "N"}.get(si)
        if length is None:
            continue
        if how.unit != si:
            raise UsageError(
                f"{', '.join(how.sources)} is in {how.unit}, but {', '.join(hints.slides)} slides",
                hint="write a mapping with the scales to m and to rad: 0.001 for mm, 0.0174533 for degrees",
            )
        unit = length if len(hints.slides) == len(hints.joints) else ""
        found[name] = msgspec.structs.replace(how, unit=unit)
    return found


# -- what goes along, and what is left out


def _extras(
    signals: Sequence[Signal], command: Signal, measured: Signal, places: Sequence[int],
    fields: dict[str, dict[str, FieldMapping]], clocks: Mapping[str, np.ndarray], draft: Proposal,
) -> None:  # fmt: skip
    """Add gains, torque on or off, further commands, payload and velocities, by their names."""

    def in_order(s: Signal) -> Signal | None:
        """Return the columns of the joints, or one for all; None if they do not fit."""
        if all(s.labels) and set(measured.labels) <= set(s.labels) and all(measured.labels):
            return s.taken([s.labels.index(label) for label in measured.labels])
        if s.width in (1, len(places)):
            return s
        return s.taken(places) if s.width > max(places) and not any(s.labels) else None

    for name, (quantity, side, unit) in _EXTRA.items():
        listed = [
            s for s in signals
            if s.meaning.quantity == quantity and s is not command and s is not measured
            and side in (None, s.meaning.side) and (s.values.ndim == 1 or len(s.values) == len(command.values))
        ]  # fmt: skip
        if len(listed) != 1 or name in fields["actuator"] or (chosen := in_order(listed[0])) is None:
            continue
        if not np.nan_to_num(chosen.values).any() and name in ("kp", "kd", "enabled", "torque"):
            draft.evidence.append(f"{chosen.name!r} is 0 throughout: omitted")
            continue
        source = chosen.whole or (chosen.sources if chosen.width > 1 else chosen.sources[0])
        fields["actuator"][name] = FieldMapping(source, unit, shape=(-1,))
        draft.reasons["actuator", name, "source"] = "by its name"
    for s in signals:
        if s.meaning.quantity != "velocity" or s.values.ndim != 2 or s is command or (v := in_order(s)) is None:
            continue
        goal = s.meaning.side == "command"
        node, name, of = ("actuator", "goal_velocity", command) if goal else ("sensor", "velocity", measured)
        how = fields[node].get("goal" if goal else "position")
        if how is None or name in fields[node] or v.values.shape != of.values.shape or not isinstance(how.scale, float):
            continue
        # Its unit is that of its name, else that of the positions; the data must agree.
        unit = f"{s.meaning.unit or how.unit}/s"
        angle = in_si(how.unit)[0] * (checks.counted(of.values, how.turn) if how.turn else of.values)
        if checks.is_rate(clocks[node], angle, in_si(unit)[0] * v.values):
            fields[node][name] = v.mapped(unit)
            draft.reasons[node, name, "unit"] = f"it is the rate of {of.name!r}"
        else:
            draft.evidence.append(f"{s.name!r} is not the rate of {of.name!r}: omitted")


def _policies(
    node: str, keys: dict[str, Any], position: FieldMapping | None, signal: Signal, t_s: np.ndarray, draft: Proposal
) -> None:
    """Drop samples that lack a number, repeat a stamp, or leap away and back; say how many."""
    whole = np.isfinite(signal.values).all(axis=1) & np.isfinite(t_s)
    if not whole.all():
        keys["missing"] = "drop"
        draft.reasons[node, "", "missing"] = f"{int((~whole).sum())} of {len(t_s)} samples lack a number"
    rows = np.flatnonzero(whole)
    if "stamps" in keys and (repeated := int((np.diff(t_s[rows]) == 0).sum())):
        keys["repeated"] = "first"
        draft.reasons[node, "", "repeated"] = f"{repeated} stamps repeat"
        rows = rows[np.concatenate([[True], np.diff(t_s[rows]) > 0])]
    if position is None or position.log_unit != "rad" or len(rows) < 3 or (np.diff(t_s[rows]) <= 0).any():
        return
    values = checks.counted(signal.values[rows], position.turn) if position.turn else signal.values[rows]
    leapt = checks.glitches(t_s[rows], values * np.asarray(position.scale) * in_si(position.unit)[0])
    if leapt.any():
        k, i = (int(x[0]) for x in np.nonzero(leapt))
        keys["implausible"] = "drop"
        draft.reasons[node, "", "implausible"] = (
            f"{int(leapt.any(axis=1).sum())} samples leap away and back, as {signal.sources[i]} in sample {rows[k]}"
        )


def _unused(signals: Sequence[Signal], draft: Proposal) -> list[str]:
    """Return a note on signals of motion or commands that are not imported."""
    used = {source for node in draft.mapping.nodes.values() for how in node.fields.values() for source in how.sources}
    left = [
        s.name for s in signals
        if s.meaning.quantity in ("", "position", "velocity", "torque", "duty", "voltage")
        and (s.meaning.side or s.meaning.quantity)
        and not {s.whole, *s.sources} & used and not any(s.name in line for line in draft.evidence)
    ]  # fmt: skip
    return [f"not imported: {', '.join(left[:20])}" + " ..." * (len(left) > 20)] if left else []


# -- what the data say


def _check(
    table: Table, draft: Proposal, by_name: bool, inferred: Sequence[tuple[str, str]], hints: ImportHints
) -> None:
    """Check the mapping on the data; what contradicts it is refused, what fits several mappings is asked."""
    goal = draft.mapping.nodes["actuator"].fields.get("goal")
    try:
        episode = import_table(table, draft.mapping)
    except UsageError as error:
        if not inferred or goal is None:
            raise
        text = str(error).partition("\n")[0]
        draft.questions[(*inferred[0], "unit")] = f'"{goal.unit}" or another?  # {text}; --unit answers, too'
        return
    findings = checks.check_episode(episode, draft.joints, by_name)
    draft.evidence += [
        f.text if f.weight == "note" else f"warning: {f.text}" for f in findings if f.weight in ("note", "warn")
    ]
    open_ones = [f for f in findings if f.weight in ("ask", "refuse")]
    if hints.as_told:
        draft.evidence += [f"warning: {f.text}" for f in open_ones]
        return
    followed = any(f.kind == "follows" and f.weight == "note" for f in findings)
    # A joint of another scale than the others is refused by its name; if all are, their unit is open.
    answerable = {"sign": "scale", "order": "source", "slope": "unit", "follows": "unit"}
    wrong = [
        f for f in open_ones if f.kind not in answerable or (f.kind == "slope" and f.weight == "refuse" and followed)
    ]
    if wrong:
        raise UsageError(f"{table.path}: {'; '.join(f.text for f in wrong)}", hint=checks.hint_for(wrong))
    if goal is None:
        return
    for key in dict.fromkeys(answerable[f.kind] for f in open_ones):
        found = [f for f in open_ones if answerable[f.kind] == key]
        node, name = ("actuator", "goal")
        if key == "scale":
            scale = np.broadcast_to(goal.scale, (len(draft.joints),)).tolist()
            flipped = [-x if any(f.joint == i for f in found) else x for i, x in enumerate(scale)]
            candidates = f"{flipped} or {scale}?"
        elif key == "source":
            candidates = f"{json.dumps(goal.sources)} in another order?"
        else:
            node, name = inferred[0] if inferred else (node, name)
            candidates = f'"{goal.unit}" or another?'
        why = "; ".join(f.text for f in found)
        draft.questions[node, name, key] = f"{candidates}  # {why}; --as-told keeps the file's"
    for node, name in inferred if not followed else ():
        draft.questions.setdefault(
            (node, name, "unit"),
            f'"{goal.unit}" or another?  # no joint moves, so nothing proves it; --unit answers, too',
        )


# -- a motion to be played


def joint_motion(table: Table, joints: Sequence[str], unit: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the motion of a robot's joints in a table: goals if it has them, otherwise positions.

    Args:
        joints: Names of the commands, by which columns are chosen.
        unit: Unit of the commands.

    Returns:
        Times ``(N,)`` [s], values ``(N, joints)`` [unit], and their source in words.

    Raises:
        UsageError: When no columns have these names, or their clock or unit is open.
    """
    signals, _ = collect(table)
    motions = []
    for s in signals:
        if s.values.ndim != 2 or s.meaning.quantity not in ("position", ""):
            continue
        found = columns_of(joints, s.labels) if any(s.labels) else None
        alone = len(joints) == 1 and s.width == 1 and s.meaning.side == "command"
        if found is not None or alone:
            order = (s.meaning.side != "command", s.meaning.quantity != "position", len(motions))
            motions.append((*order, s.taken(found[0] if found else [0])))
    if not motions:
        raise UsageError(
            f"{table.path} has no columns for {', '.join(joints)}. Columns: {', '.join(table.keys[:30]) or 'none'}",
            hint=f"name them by joint, quantity and unit, such as {joints[0]}_goal_rad, and the time t_s",
        )
    signal = min(motions)[3]
    draft, hints = Proposal(ImportMapping("", {})), ImportHints("", joints=tuple(joints))
    _, t_s = stamped(signals, signal, "motion", table, hints, draft)
    scale = 1.0
    if unit == "rad":
        own, _ = _unit(signal, table, hints)
        if own:
            scale = in_si(own)[0]
        else:
            draft.questions["motion", "", "unit"] = f"of {signal.name}: rad or deg? End the names with it"
    if draft.questions:
        raise UsageError(
            f"{table.path}: {'; '.join(draft.questions.values())}", hint="name columns t_s, JOINT_goal_rad"
        )
    rows = np.flatnonzero(np.isfinite(t_s) & np.isfinite(signal.values).all(axis=1))
    if len(rows) < 2:
        raise UsageError(f"{signal.name!r} in {table.path} has no rows that hold numbers for all joints")
    return t_s[rows], scale * signal.values[rows], f"{signal.name} of {table.path.name}"
