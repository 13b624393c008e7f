"""Proposes the mapping of a file from its names; what they leave open becomes a question; data check it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from sim2real.errors import UsageError
from sim2real.graph.episode import Episode
from sim2real.log.importing import checks, lerobot
from sim2real.log.importing.checks import Finding
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.mapping import FieldMapping, ImportMapping, NodeMapping, in_si
from sim2real.log.importing.names import Meaning, about_torque, are_numbers, columns_of, meaning
from sim2real.log.importing.readers import Table
from sim2real.log.importing.signals import ImportHints, Proposal, Signal, collect, require_one_clock, stamped
from sim2real.log.importing.units import (
    goal_unit,
    position_unit,
    rate_slope,
    scales_of,
    stated_unit,
    turn_of,
    turns_counted,
)

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
_GAINS = ("kp", "kd", "enabled")


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # damaged files can hold numbers of any size
def propose(table: Table, hints: ImportHints) -> Proposal:
    """Return the mapping that names and units give, checked against the data.

    Raises:
        UsageError: When names do not match those of the robot, or the data contradict the names.
    """
    signals, notes = collect(table)
    draft = Proposal(ImportMapping(hints.pipeline, {}), evidence=[*table.notes, *notes])
    measured = _choose(signals, "measured", table, hints, draft)
    command = _choose([s for s in signals if s is not measured], "command", table, hints, draft, measured)
    # The order of the joints.
    places, joints = _joint_order(measured, hints, table, draft)
    measured = measured.taken(places)
    draft.joints = joints
    command, kind, by_name = _matched(command, measured, places, joints, table, draft)
    # Stamps, then units, on which turns and leaps depend.
    nodes: dict[str, dict[str, Any]] = {}
    clocks = {}
    for node, signal, side in (("actuator", command, "command"), ("sensor", measured, "measured")):
        nodes[node], clocks[node] = stamped(signals, signal, side, node, table, hints, draft)
    require_one_clock(table, nodes, clocks, draft)
    fields: dict[str, dict[str, FieldMapping]] = {"actuator": {}, "sensor": {}}
    unit, turn = position_unit(measured, command, kind, clocks, signals, table, hints, draft)
    scale = scales_of(measured, unit, hints)
    fields["sensor"]["position"] = measured.mapped(unit, turn=turn, **scale)
    if kind == "position":
        unit_of_goals = goal_unit(command, measured, unit, clocks, hints, draft)
        goal_turn = turn_of(command, unit_of_goals, ("actuator", "goal"), draft)
        fields["actuator"]["goal"] = command.mapped(
            unit_of_goals, turn=goal_turn, **scales_of(command, unit_of_goals, hints)
        )
    else:
        si = {"velocity": "rad/s", "torque": "N m", "voltage": "V"}.get(kind, "")
        fields["actuator"][_FIELDS[kind]] = command.mapped(si)
        draft.reasons["actuator", _FIELDS[kind], "source"] = f"commands {kind}, by its name"
    _extras(signals, command, measured, places, joints, fields, clocks, draft)
    for node, signal in (("actuator", command), ("sensor", measured)):
        _policies(node, nodes[node], fields[node], signal, clocks[node], draft)
    draft.mapping = _in_lengths(
        ImportMapping(hints.pipeline, {n: NodeMapping(fields[n], **nodes[n]) for n in nodes}), hints
    )
    draft.evidence += about_torque({n: msgspec.to_builtins(node) for n, node in draft.mapping.nodes.items()})
    draft.evidence += _unused(signals, draft)
    if not draft.questions:
        _check(table, draft, by_name, hints)
    return draft


def check_mapping(episode: Episode, joints: Sequence[str] = (), by_name: bool = True) -> list[Finding]:
    """Return findings on the goals and positions of an imported episode."""
    sensed, commands = episode.outputs.get("sensor", {}), episode.outputs.get("actuator", {})
    units = {**episode.units.get("actuator", {}), **episode.units.get("sensor", {})}
    enabled = [values for name, values in commands.items() if meaning(name).quantity == "enabled"]
    acting = np.asarray((enabled[0].reshape(len(enabled[0]), -1) > 0).all(axis=1)) if len(enabled) == 1 else None
    findings: list[Finding] = []
    for name, position in sensed.items():
        for goal, values in commands.items():
            pair = meaning(name).quantity == "position" and meaning(goal).side == "command"
            if not (pair and meaning(goal).quantity in ("", "position") and units.get(goal) == units.get(name)):
                continue
            flat = values.reshape(len(values), -1), position.reshape(len(position), -1)
            if flat[0].shape[1] == flat[1].shape[1]:
                names = joints if len(joints) == flat[1].shape[1] else [f"joint {i}" for i in range(flat[1].shape[1])]
                t_s = episode.steps["actuator"].begun_s, episode.steps["sensor"].begun_s
                findings += checks.check(t_s, *flat, names, by_name, acting)
    return findings


def _choose(
    signals: Sequence[Signal], side: str, table: Table, hints: ImportHints, draft: Proposal, other: Signal | None = None
) -> Signal:
    """Return the measured positions, or the commands, by their names; ask if names do not decide."""
    ranked: dict[int, list[Signal]] = {}
    for s in signals:
        if s.values.ndim == 2 and len(s.values) > 2 and (rank := _rank(s.meaning, side)) is not None:
            ranked.setdefault(rank, []).append(s)
    best = ranked[min(ranked)] if ranked else []
    # Of several, take those of the robot's joints, or as wide as the other side; equal ones are the same.
    if len(best) > 1 and hints.joints:
        best = [s for s in best if columns_of(hints.joints, s.labels)] or best
    if len(best) > 1 and other is not None:
        best = (
            [s for s in best if set(other.labels) == set(s.labels) != {""}]
            or [s for s in best if s.width == other.width]
            or best
        )
    best = [
        s
        for i, s in enumerate(best)
        if not any(
            s.values.shape == b.values.shape and np.array_equal(s.values, b.values, equal_nan=True) for b in best[:i]
        )
    ]
    node, name = ("sensor", "position") if side == "measured" else ("actuator", "goal")
    if len(best) == 1:
        return best[0]
    choices = best or [
        s for s in signals if s.values.ndim == 2 and len(s.values) > 2 and s.meaning.quantity in ("", "position")
    ]
    if not choices:
        raise UsageError(
            f"{table.path} has no {'measured positions' if side == 'measured' else 'commands'}. "
            f"Columns: {', '.join(table.keys[:40]) or 'none'}" + "".join(f"; {note}" for note in draft.evidence[:5]),
            hint="name them by quantity and joint, such as q_hip_rad and goal_hip_rad, or write a mapping",
        )
    listed = " or ".join(_toml_source(s) for s in choices[:12])
    what = "which are the measured positions" if side == "measured" else "which commands drove the joints"
    draft.questions[node, name, "source"] = f"{listed}?  # {what}: names do not say"
    return choices[0]


def _rank(named: Meaning, side: str) -> int | None:
    position = named.quantity == "position"
    if side == "measured":
        return (
            {("measured", True): 0, ("", True): 1, ("measured", False): 2}.get((named.side, position))
            if (position or not named.quantity)
            else None
        )
    if named.side == "command" and named.quantity in ("position", ""):
        return 0 if position else 1
    if named.side == "command" and named.quantity in _FIELDS:
        return 2
    return {"duty": 3, "voltage": 3, "torque": 4}.get(named.quantity) if not named.side else None


def _toml_source(signal: Signal) -> str:
    return (
        f'"{signal.whole or signal.sources[0]}"'
        if signal.whole or signal.width == 1
        else f'["{signal.sources[0]}", ...]'
    )


def _joint_order(
    measured: Signal, hints: ImportHints, table: Table, draft: Proposal
) -> tuple[list[int], tuple[str, ...]]:
    """Return the column of each joint of the robot, and the joints' names."""
    labels, in_order = measured.labels, list(range(measured.width))
    own = tuple(label or str(i) for i, label in enumerate(labels))
    finite = [bool(np.isfinite(column).any()) for column in measured.values.T]
    at = "sensor", "position", "source"
    if not hints.joints:
        if empty := [measured.sources[i] for i in in_order if not finite[i]]:
            draft.evidence.append(f"skipped: {', '.join(empty)} has no number in any sample")
        kept = [i for i in in_order if finite[i]]
        return kept, tuple(own[i] for i in kept)
    found = columns_of(hints.joints, labels) if any(labels) else None
    if found is not None:
        places, how = found
        pairs = ", ".join(f"{labels[i]} is {joint}" for joint, i in zip(hints.joints, places, strict=True))
        draft.reasons[at] = how
        if how != "by name":
            draft.evidence.append(f"joints {how}: {pairs}")
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
    command: Signal, measured: Signal, places: Sequence[int], joints: Sequence[str], table: Table, draft: Proposal
) -> tuple[Signal, str, bool]:
    """Return the commands in the order of the joints, what they command, and whether names match them."""
    kind = command.meaning.quantity or "position"
    has_names = all(measured.labels) and all(command.labels)
    if has_names and set(measured.labels) <= set(command.labels):
        return command.taken([command.labels.index(label) for label in measured.labels]), kind, True
    if has_names and (found := columns_of(measured.labels, command.labels)) is not None:
        draft.evidence.append(f"commands belong to positions {found[1]}")
        return command.taken(found[0]), kind, True
    found = columns_of(joints, command.labels) if any(command.labels) else None
    if found is not None:
        return command.taken(found[0]), kind, True
    numbers = are_numbers(measured.labels) and are_numbers(command.labels)
    if has_names and not numbers:
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
    return ordered, kind, measured.width == 1


def _extras(
    signals: Sequence[Signal], command: Signal, measured: Signal, places: Sequence[int], joints: Sequence[str],
    fields: dict[str, dict[str, FieldMapping]], clocks: Mapping[str, np.ndarray], draft: Proposal,
) -> None:  # fmt: skip
    """Add gains, torque on or off, further commands, payload and a velocity, by their names."""

    def in_order(s: Signal) -> Signal | None:
        """Return the columns of the joints, or one for all; None if they do not fit."""
        if s.width == 1:
            return s
        if all(s.labels) and set(measured.labels) <= set(s.labels) and all(measured.labels):
            return s.taken([s.labels.index(label) for label in measured.labels])
        if s.width == len(joints):
            return s
        return s.taken(places) if s.width > max(places) and not any(s.labels) else None

    for name, (quantity, side, unit) in _EXTRA.items():
        listed = [s for s in signals if s.meaning.quantity == quantity and s is not command and s is not measured]
        listed = [s for s in listed if side is None or s.meaning.side == side]
        listed = [s for s in listed if s.values.ndim == 1 or len(s.values) == len(command.values)]
        if len(listed) != 1 or name in fields["actuator"] or (chosen := in_order(listed[0])) is None:
            continue
        finite = chosen.values[np.isfinite(chosen.values)]
        if not finite.any() and (name in _GAINS or name == "torque"):
            draft.evidence.append(f"{chosen.name!r} is 0 throughout: omitted")
            continue
        source = chosen.whole or (chosen.sources if chosen.width > 1 else chosen.sources[0])
        fields["actuator"][name] = FieldMapping(source, unit, shape=(-1,))
        draft.reasons["actuator", name, "source"] = "by its name"
    base = fields["sensor"]["position"]
    for s in signals:
        if s.meaning.quantity != "velocity" or s.values.ndim != 2 or s is command or (v := in_order(s)) is None:
            continue
        goal = s.meaning.side == "command"
        node, name, of = ("actuator", "goal_velocity", command) if goal else ("sensor", "velocity", measured)
        if name in fields[node] or v.values.shape != of.values.shape or (goal and "goal" not in fields["actuator"]):
            continue
        how = fields["actuator"]["goal"] if goal else base
        slope = rate_slope(turns_counted(of.values), v.values, clocks[node])
        factor = in_si(how.unit)[0] if isinstance(how.scale, float) else None
        units = [
            u
            for u in ("rad/s", "deg/s", "rev/s", "mrad/s")
            if slope and factor and 0.8 < slope * factor / in_si(u)[0] < 1.25
        ]
        by_name = f"{s.meaning.unit}/s" if s.meaning.unit else ""
        if units and (not by_name or by_name in units):
            fields[node][name] = v.mapped(units[0])
            draft.reasons[node, name, "unit"] = f"it is the rate of {of.name!r}"
        else:
            draft.evidence.append(f"{s.name!r} is not the rate of {of.name!r}: omitted")


def _policies(
    node: str,
    keys: dict[str, Any],
    fields: Mapping[str, FieldMapping],
    signal: Signal,
    t_s: np.ndarray,
    draft: Proposal,
) -> None:
    """Drop samples that lack a number, repeat a stamp, or leap away and back; say how many."""
    lacking = int((~np.isfinite(signal.values).all(axis=1) | ~np.isfinite(t_s)).sum())
    if lacking:
        keys["missing"] = "drop"
        draft.reasons[node, "", "missing"] = f"{lacking} of {len(t_s)} samples lack a number"
    rows = np.flatnonzero(np.isfinite(signal.values).all(axis=1) & np.isfinite(t_s))
    if "stamps" in keys and (repeated := int((np.diff(t_s[rows]) == 0).sum())):
        keys["repeated"] = "first"
        draft.reasons[node, "", "repeated"] = f"{repeated} stamps repeat"
        rows = rows[np.concatenate([[True], np.diff(t_s[rows]) > 0])]
    how = fields.get("position")
    if node != "sensor" or how is None or how.log_unit != "rad" or len(rows) < 3 or (np.diff(t_s[rows]) <= 0).any():
        return
    values = checks.counted(signal.values[rows], how.turn) if how.turn else signal.values[rows]
    leapt = checks.glitches(t_s[rows], values * np.asarray(how.scale) * in_si(how.unit)[0])
    if leapt.any():
        k, i = (int(x[0]) for x in np.nonzero(leapt))
        keys["implausible"] = "drop"
        draft.reasons[node, "", "implausible"] = (
            f"{int(leapt.any(axis=1).sum())} samples leap away and back, as {signal.sources[i]} in sample {rows[k]}"
        )


def _in_lengths(mapping: ImportMapping, hints: ImportHints) -> ImportMapping:
    """Return a mapping with the units of slides: lengths, or none where a robot has hinges and slides."""
    nodes = {}
    for name, node in mapping.nodes.items():
        fields = {}
        for key, how in node.fields.items():
            unit = {"hundredths": "rad"}.get(how.unit, how.unit)
            if how.unit in lerobot.UNITS and isinstance(how.scale, tuple):
                unit = "rad"  # the scale converts
            if hints.slides and in_si(unit)[1] in ("rad", "rad/s", "N m"):
                if unit not in ("rad", "rad/s", "N m"):
                    raise UsageError(
                        f"{', '.join(how.sources)} is in {unit}, but {', '.join(hints.slides)} slides",
                        hint="write a mapping with the scales to m and to rad: 0.001 for mm, 0.0174533 for degrees",
                    )
                mixed = len(hints.slides) < len(hints.joints)
                unit = "" if mixed else {"rad": "m", "rad/s": "m/s", "N m": "N"}[unit]
            fields[key] = msgspec.structs.replace(how, unit=unit)
        nodes[name] = msgspec.structs.replace(node, fields=fields)
    return ImportMapping(mapping.pipeline, nodes)


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


def _check(table: Table, draft: Proposal, by_name: bool, hints: ImportHints) -> None:
    """Check the mapping on the data; what contradicts it is refused, what fits several mappings is asked."""
    episode = import_table(table, draft.mapping)
    findings = check_mapping(episode, draft.joints, by_name)
    draft.evidence += [f.text for f in findings if f.weight == "note"]
    draft.evidence += [f"warning: {f.text}" for f in findings if f.weight == "warn"]
    open_ones = [f for f in findings if f.weight in ("ask", "refuse")]
    if hints.as_told:
        draft.evidence += [f"warning: {f.text}" for f in open_ones]
        return
    goal = draft.mapping.nodes["actuator"].fields.get("goal")
    answerable = {"sign": "scale", "order": "source", "slope": "unit", "follows": "unit"}
    if wrong := [f for f in open_ones if f.kind not in answerable]:
        raise UsageError(f"{table.path}: {'; '.join(f.text for f in wrong)}", hint=hint_for(wrong))
    for f in open_ones if goal is not None else ():
        key = answerable[f.kind]
        others = [g for g in open_ones if answerable[g.kind] == key]
        if f.kind == "sign" and goal is not None:
            scale = np.broadcast_to(goal.scale, (len(draft.joints),))
            flipped = [-x if any(g.joint == i for g in others) else x for i, x in enumerate(scale.tolist())]
            candidates = f"{flipped} or {scale.tolist()}?"
        elif f.kind == "order":
            source = goal.sources if goal is not None else ()
            candidates = f"{json.dumps(source)} in another order?"
        else:
            candidates = f'"{goal.unit if goal is not None else ""}" or another?'
        why = "; ".join(g.text for g in others)
        draft.questions["actuator", "goal", key] = f"{candidates}  # {why}; --as-told keeps the file's"


def hint_for(findings: Sequence[Finding]) -> str:
    """Return what to do about findings that refuse an import."""
    hints = {
        "sign": "change the sign of that joint's scale, such as scale = [1, -1]",
        "order": "list the sources in the order of the positions",
        "copy": "log the commands that were sent, not the measurements",
        "clock": "stamp both streams with one clock, such as a recorder's",
        "zero": "cut the file where the zero moves: --samples A:B",
        "scale": "name the other joints with --joints, or give the column its own scale in a mapping",
        "slope": "correct the unit, or name the other joints with --joints",
        "lag": "exchange the names, or correct stamp_offset",
    }
    return (
        "; ".join(dict.fromkeys(hints.get(f.kind, "correct the mapping") for f in findings))
        + "; --as-told imports it all the same"
    )


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
    side = "command" if signal.meaning.side == "command" else "measured"
    _, t_s = stamped(signals, signal, side, "motion", table, hints, draft)
    scale = 1.0
    if unit == "rad":
        own, _ = stated_unit(signal, table, hints)
        if own is None:
            draft.questions["motion", "", "unit"] = f"of {signal.name}: rad or deg? End the names with it"
        else:
            scale = in_si(own)[0]
    if draft.questions:
        raise UsageError(
            f"{table.path}: {'; '.join(draft.questions.values())}", hint="name columns t_s, JOINT_goal_rad"
        )
    rows = np.flatnonzero(np.isfinite(t_s) & np.isfinite(signal.values).all(axis=1))
    if len(rows) < 2:
        raise UsageError(f"{signal.name!r} in {table.path} has no rows that hold numbers for all joints")
    return t_s[rows], scale * signal.values[rows], f"{signal.name} of {table.path.name}"
