"""Proposes the mapping of a file from its names. Open choices become questions; the data only check the mapping."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from sim2real.errors import UsageError
from sim2real.log.importing import checks, lerobot
from sim2real.log.importing.importer import import_table
from sim2real.log.importing.mapping import (
    LENGTHS_AND_ANGLES,
    STAMP_UNITS,
    FieldMapping,
    ImportMapping,
    Key,
    NodeMapping,
    in_si,
    to_toml,
)
from sim2real.log.importing.names import (
    Meaning,
    Signal,
    about_torque,
    are_numbers,
    collect,
    columns_of,
    meaning,
    numbers_of,
)
from sim2real.log.importing.readers import Table

_FIELDS = {
    "position": ("goal", ""),
    "velocity": ("goal_velocity", "rad/s"),
    "torque": ("torque", "N m"),
    "duty": ("duty", ""),
    "voltage": ("duty", "V"),
}
"""Quantity of commands -> field and unit."""
_EXTRA = {
    "kp": ("kp", None, ""),
    "kd": ("kd", None, ""),
    "enabled": ("enabled", None, ""),
    "torque": ("torque", "command", "N m"),
    "payload": ("payload", None, "kg"),
    "payload_reach": ("reach", None, "m"),
}
"""Further commands: field -> quantity, ``command``, ``measured`` or None for any, and unit."""
_KNOWN_UNITS = (
    (r"joint_?(state|command)s?|field\.(position|header)", "messages of ROS are in radians"),
    (r"qpos|dof_?pos", "MuJoCo and Isaac are in radians"),
    (r"(actual|target)_q(?![a-z])", "RTDE of Universal Robots is in radians"),
    (r"motor_?(state|cmd)", "Unitree's messages are in radians"),
)
"""Families of names that are in radians, and the evidence."""
_OF_SLIDES = {"rad": "m", "rad/s": "m/s", "N m": "N"}
_RATES_HZ = (5.0, 12_000.0)
"""Usual sampling rates of recorders."""
_WALL_S = (1e9, 4e9)
"""Range of a wall clock [s since 1970], 2001 to 2096."""
_FLOATING = 7
"""Columns of a floating base that precede the joints: its position, and its orientation as a quaternion."""
_APART_S = 0.02
"""Largest disagreement of two clocks of one topic, above which the import asks [s]."""


@dataclass(frozen=True)
class ImportHints:
    """The user's information on a file.

    Attributes:
        pipeline: Name of the log's pipeline.
        rate_hz: Rate of the samples if the file has no stamps [Hz].
        joints: Names of the robot's joints, in its order; empty if unknown.
        as_told: Keep names, order, signs and units as in the file, even if they are ambiguous or contradict the data.
        slides: Names of the sliding joints, whose positions are lengths.
        ranges: Joint -> lowest and highest position in the model [rad or m].
        unit: Unit of positions and goals in the file; empty: from their names.
        calibration: LeRobot's calibration of the arm.
    """

    pipeline: str
    rate_hz: float | None = None
    joints: tuple[str, ...] = ()
    as_told: bool = False
    slides: tuple[str, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    unit: str = ""
    calibration: Path | None = None


def propose(table: Table, hints: ImportHints) -> Proposal:
    """Return the mapping that follows from names and units, checked against the data.

    Raises:
        UsageError: The names are not those of the robot, or the data contradict the names.
    """
    proposal = Proposal(table, hints)
    proposal.complete()
    return proposal


class Proposal:
    """A mapping, with the evidence for each line, and open questions.

    Attributes:
        mapping: The mapping; for an open question, it has the likeliest answer.
        joints: Names of the columns of measured positions, in the order of the log; numbers if there are no names.
        reasons: Line of the mapping -> evidence.
        questions: Line that names and data do not decide -> question with candidates.
        evidence: Further evidence, as sentences.
    """

    def __init__(self, table: Table, hints: ImportHints) -> None:
        self.table, self.hints = table, hints
        self.signals, notes = collect(table)
        self.mapping = ImportMapping(hints.pipeline, {})
        self.joints: tuple[str, ...] = ()
        self.reasons: dict[Key, str] = {}
        self.questions: dict[Key, str] = {}
        self.evidence = [*table.notes, *notes]
        self.fields: dict[str, dict[str, FieldMapping]] = {"actuator": {}, "sensor": {}}

    def toml(self) -> str:
        """Return the text of the mapping file."""
        head = [f"Proposed by `sim2real import {self.table.path.name}`."]
        if self.questions:
            head.append("Put an answer in place of each line with a question mark, then give this file to --mapping.")
        head += [*self.evidence, f"Joints: {', '.join(self.joints)}"]
        return to_toml(self.mapping, head, self.reasons, self.questions)

    def open_questions(self) -> str:
        """Return the open questions, one sentence each."""
        return "; ".join(
            f"nodes.{node}.{f'fields.{name}.' * bool(name)}{key} = {text}"
            for (node, name, key), text in self.questions.items()
        )

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # damaged files may have numbers of any size
    def complete(self) -> None:
        """Propose the mapping, and check it.

        Raises:
            UsageError: As ``propose``. If the data contradict the mapping, the mapping is complete nevertheless.
        """
        # Find the columns of positions and commands, and their joints.
        measured = self.choose("measured", self.signals)
        command = self.choose("command", [s for s in self.signals if s is not measured], measured)
        places, self.joints = self.joint_order(measured)
        measured = measured.taken(places)
        command, by_name = self.matched(command, measured, places)
        # Find clocks and units. A unit of positions also holds for goals, and the reverse; the data must agree.
        sides = {"actuator": command, "sensor": measured}
        clocks = {node: self.clock(signal, node) for node, signal in sides.items()}
        kind = command.meaning.quantity or "position"
        field, unit = _FIELDS[kind]
        angles = {("sensor", "position"): measured}
        if kind == "position":
            angles["actuator", field] = command
        else:
            self.fields["actuator"][field] = command.mapped(unit)
            self.reasons["actuator", field, "source"] = f"commands {kind}, by its name"
        units = {at: self.unit(signal) for at, signal in angles.items()}
        known = {unit for unit, _ in units.values() if unit}
        unproven = None
        for at, signal in angles.items():
            if not any(units[at]) and len(known) == 1:
                unproven = at
                units[at] = next(iter(known)), "as of the other side: its own name has none"
            self.fields[at[0]][at[1]] = self.angle(at, signal, *units[at])
        # Add further fields.
        self.add_extras(command, measured, places)
        self.add_velocities(command, measured, places, {node: t_s for node, (_, t_s) in clocks.items()})
        nodes = {node: NodeMapping(self.in_lengths(self.fields[node]), **clocks[node][0]) for node in sides}
        self.mapping = ImportMapping(self.hints.pipeline, nodes)
        self.evidence += about_torque({n: msgspec.to_builtins(node) for n, node in nodes.items()})
        self.add_unused()
        # Check the mapping against the data.
        if not self.questions:
            try:
                episode = import_table(self.table, self.mapping)
            except UsageError as error:
                values = measured.values[np.isfinite(measured.values).all(axis=1)]
                odd = checks.odd_columns(in_si(self.fields["sensor"]["position"].unit)[0] * values, self.joints)
                refusal = error
                if odd:
                    refusal = UsageError(f"{self.table.path}: {odd[0].text}", hint=checks.hint_for(odd))
                if unproven is None:
                    raise refusal from None
                self.ask(unproven, "unit", f"{refusal.args[0]}{' --joints names the other joints' * bool(odd)}")
                return
            source = episode.metadata["source"]
            for node, counts in source["dropped"].items():
                self.evidence += [f"{node}: left out {n} samples: {why}" for why, n in counts.items()]
            self.evidence += [f"turns of {field} are counted" for field in source["turns"]]
            read = episode.outputs["sensor"]["position"].reshape(-1, len(self.joints))
            found = checks.check_episode(episode, self.joints, by_name)
            found += checks.beyond(read, self.joints, self.hints.ranges)
            self.weigh(found, unproven or ("actuator", "goal"))

    # -- positions, commands, and their joints

    def choose(self, side: str, signals: Sequence[Signal], other: Signal | None = None) -> Signal:
        """Return the signal of the measured positions, or of the commands; ask if names do not decide."""
        series = [s for s in signals if s.values.ndim == 2 and len(s.values) > 2]
        ranks = [(rank, s) for s in series if (rank := _rank(s.meaning, side)) is not None]
        best = [s for rank, s in ranks if rank == min(r for r, _ in ranks)]
        # Of several, take the one with the robot's joints, or with as many columns as ``other``; equal data count once.
        if len(best) > 1 and self.hints.joints:
            best = [s for s in best if columns_of(self.hints.joints, s.labels)] or best
        if len(best) > 1 and other is not None:
            named = [s for s in best if set(other.labels) == set(s.labels) != {""}]
            best = named or [s for s in best if s.width == other.width] or best
        unlike: list[Signal] = []
        for s in best:
            if not any(np.array_equal(s.values, b.values, equal_nan=True) for b in unlike):
                unlike.append(s)
        if len(unlike) == 1:
            return unlike[0]
        other_side = {"measured": "command", "command": "measured"}[side]
        choices = unlike or [
            s for s in series if s.meaning.quantity in ("", "position") and s.meaning.side != other_side
        ]
        if other is not None:  # the likeliest candidate first
            choices.sort(key=lambda s: (set(s.labels) != set(other.labels), s.width != other.width))
        if not choices and (longest := max((len(s.values) for s in self.signals), default=0)) < 3:
            count = "1 sample" if longest == 1 else f"{longest} samples"
            raise UsageError(f"{self.table.path} has {count}", hint="check that the file is complete")
        if not choices:
            raise UsageError(
                f"{self.table.path} has no {'measured positions' if side == 'measured' else 'commands'}. Columns: "
                f"{'; '.join([', '.join(self.table.keys[:40]) or 'none', *self.evidence[:5]])}",
                hint="name them by quantity and joint, such as q_hip_rad and goal_hip_rad, or write a mapping",
            )
        at, what = {
            "measured": (("sensor", "position", "source"), "which are the measured positions"),
            "command": (("actuator", "goal", "source"), "which commands drove the joints"),
        }[side]
        self.questions[at] = f"{' or '.join(map(_written, choices[:12]))}?  # {what}: names do not say"
        return choices[0]

    def joint_order(self, measured: Signal) -> tuple[list[int], tuple[str, ...]]:
        """Return the column of each joint of the robot, and the joints' names."""
        labels, joints, at = measured.labels, self.hints.joints, ("sensor", "position", "source")
        if not joints:
            finite: list[bool] = np.asarray(np.isfinite(measured.values).any(axis=0)).tolist()
            if empty := [source for source, good in zip(measured.sources, finite, strict=True) if not good]:
                self.evidence.append(f"skipped: {', '.join(empty)} has no number in any sample")
            kept = [i for i, good in enumerate(finite) if good]
            return kept, tuple(labels[i] or str(i) for i in kept)
        if any(labels) and (found := columns_of(joints, labels)) is not None:
            places, self.reasons[at] = found
            if found[1] != "by name":
                pairs = ", ".join(f"{labels[i]} is {joint}" for joint, i in zip(joints, places, strict=True))
                self.evidence.append(f"joints {found[1]}: {pairs}")
            return places, joints
        numbered = are_numbers(labels) and not numbers_of(joints)
        named = any(labels) and not numbered
        if not named and measured.whole and measured.width == len(joints) + _FLOATING:
            source = f"{measured.whole}[:,{_FLOATING}:{measured.width}]"
            self.questions[at] = (
                f"{json.dumps(source)} or other columns?  # {measured.width} columns for {len(joints)} joints: 7 more, "
                "as of a floating base"
            )
            return list(range(_FLOATING, measured.width)), joints
        if (named and not self.hints.as_told) or len(joints) != measured.width:
            raise UsageError(
                f"the {measured.width} columns of {measured.name!r} in {self.table.path} "
                f"({', '.join(label or 'no name' for label in labels)}) are not the robot's {len(joints)} joints: "
                f"{', '.join(joints)}",
                hint="name the recorded joints as the file does, or list the sources in the robot's order in a mapping"
                + "; --as-told assumes that the file has the robot's order" * (len(joints) == measured.width),
            )
        if numbered and (numbers := numbers_of(labels)):
            measured = measured.taken(places := np.argsort(numbers).tolist())
        else:
            places = list(range(measured.width))
        self.reasons[at] = "no names of joints: the robot's order is assumed"
        self.evidence.append(
            f"columns have no names of joints, so the robot's order is assumed: {', '.join(joints)}; --joints sets "
            "another"
        )
        return places, joints

    def matched(self, command: Signal, measured: Signal, places: Sequence[int]) -> tuple[Signal, bool]:
        """Return the commands in the order of the joints, and whether names match them."""
        if all(measured.labels) and set(measured.labels) <= set(command.labels):
            return command.taken([command.labels.index(label) for label in measured.labels]), True
        if ("actuator", "goal", "source") in self.questions:
            return command, True
        for joints in (measured.labels, self.joints):
            found = columns_of(joints, command.labels) if all(joints) and any(command.labels) else None
            # Without a prefix or a stem the left arm is the right one.
            if found is not None and (found[1] in ("by name", "by leg and part") or are_numbers(command.labels)):
                if found[1] != "by name":
                    self.evidence.append(f"commands belong to positions {found[1]}")
                return command.taken(found[0]), True
        named = all(measured.labels) and all(command.labels)
        if named and not (are_numbers(measured.labels) or are_numbers(command.labels)):
            raise UsageError(
                f"the commands {command.name!r} in {self.table.path} belong to {', '.join(command.labels)}, the "
                f"positions {measured.name!r} to {', '.join(measured.labels)}",
                hint="name joints of commands and positions alike, or write a mapping with the sources in one order",
            )
        if command.width != measured.width:
            if command.width <= max(places, default=0) or any(command.labels):
                raise UsageError(
                    f"{command.name!r} in {self.table.path} has {command.width} columns, {measured.name!r} "
                    f"{measured.width}",
                    hint="write a mapping with the columns that belong together",
                )
            command = command.taken(places)
        if measured.width > 1:
            self.evidence.append(f"{command.name!r} and {measured.name!r} belong together by their order")
        return command, measured.width == 1

    # -- clocks

    def clock(self, of: Signal, node: str) -> tuple[dict[str, Any], np.ndarray]:
        """Return the keys of a node's clock, and its stamps [s]."""
        count = len(of.values)
        named = [s for s in self.signals if s.meaning.quantity == "stamp" and s.values.shape == (count, 1)]
        fitting = [s for s in named if _increases(s.values[:, 0])]
        if self.hints.rate_hz is not None or not fitting:
            return self.generated_clock(named, count, node)
        # Prefer the stamps of the signal's topic or file, there the header's; then stamps named like commands or
        # measurements.
        side = of.meaning.side or ("command" if node == "actuator" else "measured")
        groups = (
            [s for s in fitting if of.stream and s.stream == of.stream],
            [s for s in fitting if s.meaning.side == side],
            [s for s in fitting if not s.meaning.side],
            fitting,
        )
        chosen = next(group for group in groups if group)
        header = next(
            (h for end in ("header.stamp", "stamp") if (h := [s for s in chosen if s.name.endswith(end)])), []
        )
        log = [s for s in chosen if s.name.endswith(".log_time")]
        apart_s = _apart_s(header[0].values[:, 0], log[0].values[:, 0]) if header and log else 0.0
        chosen = header or chosen
        if apart_s > _APART_S:
            self.questions[node, "", "stamps"] = (
                f'"{header[0].name}" or "{log[0].name}"?  # the sender\'s clock and the recorder\'s drift apart by '
                f"{apart_s:.2g} s: one of them steps, or runs at another rate"
            )
        elif len(chosen) > 1:
            listed = " or ".join(f'"{s.name}"' for s in chosen)
            what = "commands" if side == "command" else "positions"
            self.questions[node, "", "stamps"] = f"{listed}?  # which clock has stamped the {what}"
        values = chosen[0].values[:, 0]
        unit, reason = _stamp_unit(chosen[0])
        if not unit:
            self.questions[node, "", "stamp_unit"] = f"{reason}?  # the stamps are {_period(values):.6g} apart"
        self.reasons[node, "", "stamps"] = f"by its name; {reason}"
        keys = {"stamps": chosen[0].sources[0], "stamp_unit": unit or "s"}
        return keys, values * STAMP_UNITS[unit or "s"] * 1e-9

    def generated_clock(self, named: Sequence[Signal], count: int, node: str) -> tuple[dict[str, Any], np.ndarray]:
        """Return the keys and stamps of a node without a clock, by --rate-hz or a rate in the file, or ask."""
        rate_hz, reason = self.hints.rate_hz, "--rate-hz"
        for s in self.signals if rate_hz is None else ():
            if s.values.shape == (1,) and s.values[0] > 0 and s.meaning.quantity in ("rate", "period"):
                value = float(s.values[0])
                rate_hz = value if s.meaning.quantity == "rate" else 1.0 / (value * (1.0 if value < 1.0 else 1e-3))
                reason = f"{s.name!r} in the file"
                break
        for s in named if rate_hz is None else ():
            values = s.values[np.isfinite(s.values[:, 0]), 0]
            back = np.flatnonzero(np.diff(values) < 0).tolist()
            if 0 < len(back) < 0.1 * len(values):
                k = back[0] + 1
                raise UsageError(
                    f"the stamps {s.name!r} in {self.table.path} step back before sample {k}, from "
                    f"{values[k - 1]:.15g} to {values[k]:.15g}: two recordings in one file, a clock that was set, or a "
                    "counter that began again",
                    hint=f"import a part: --samples 0:{k} or {k}:; --rate-hz spaces all samples evenly",
                )
        if rate_hz is None:
            why = f"the stamps {named[0].name!r} repeat or step back" if named else "no column is named as a time"
            if dates := [k for k in self.table.words if meaning(k).quantity == "stamp"]:
                why = f"the stamps {dates[0]!r} are words, such as {self.table.words[dates[0]][0]!r}: write ISO dates"
            elif not named and (even := [s.name for s in self.signals if _may_be_stamps(s, count)]):
                why += f', but {even[0]!r} increases: is it stamps = "{even[0]}"?'
            self.questions[node, "", "rate_hz"] = f"?  # samples per second: {why}; --rate-hz answers, too"
        self.reasons[node, "", "rate_hz"] = reason
        return {"rate_hz": rate_hz or 1.0}, np.arange(count) / (rate_hz or 1.0)

    # -- units

    def unit(self, signal: Signal) -> tuple[str, str]:
        """Return a signal's unit by flag, name or file format, and the reason; or no unit, and the known candidates."""
        names = tuple(self.table.names.get(signal.whole, ()))
        of_columns = {meaning(name).unit for name in names}
        named = signal.meaning.unit or (of_columns.pop() if len(of_columns) == 1 else "")
        calibration = self.hints.calibration
        if self.hints.unit:
            if self.hints.unit == "hundredths" and calibration is None:
                raise UsageError("hundredths of a joint's range need LeRobot's calibration", hint="--calibration FILE")
            names = names or signal.sources
            if calibration and self.hints.unit in lerobot.UNITS and not self.hints.as_told:
                unit = lerobot.unit_of(calibration, signal.labels, signal.values)
                if unit not in (None, self.hints.unit):
                    raise UsageError(
                        f"{signal.name!r} holds whole counts of the calibration in {unit}, not in {self.hints.unit}",
                        hint=f"--unit {unit}; --as-told imports it all the same",
                    )
            of_lerobot = self.table.robot or (self.hints.unit == "deg" and all(name.endswith(".pos") for name in names))
            if of_lerobot and not calibration and (jaws := list(filter(lerobot.is_gripper, signal.labels))):
                raise UsageError(
                    f"LeRobot writes {', '.join(jaws)} as 0 to 100 % of its range, which is no angle",
                    hint="--calibration FILE.json converts it",
                )
            return self.hints.unit, "--unit"
        if named in LENGTHS_AND_ANGLES:
            return named, "by its name"
        if named in ("counts", "percent"):
            return "", '"counts:4096"?' if named == "counts" else '"rad" with a scale, as percent of which angle?'
        if lerobot.writes_hundredths(self.table.robot, names or signal.sources):
            unit = lerobot.unit_of(calibration, signal.labels, signal.values) if calibration else None
            if unit:
                return unit, "whole counts by LeRobot's calibration"
            return "", '"deg" or "hundredths" (with --calibration)?'
        key = (signal.whole or signal.sources[0]).lower()
        for pattern, reason in _KNOWN_UNITS:
            if self.table.format == "mcap" or re.search(pattern, key):
                return "rad", reason
        if self.hints.slides:
            only = len(self.hints.slides) == len(self.hints.joints)
            return "", '"m" or "mm"?' if only else '"rad" (and m) or another?'
        return "", ""

    def angle(self, at: tuple[str, str], signal: Signal, unit: str, reason: str) -> FieldMapping:
        """Return the field of positions or goals, in a unit or by LeRobot's calibration; ask if there is no unit."""
        if unit:
            self.reasons[(*at, "unit")] = reason
        else:
            span = (np.nanmax(signal.values, axis=0) - np.nanmin(signal.values, axis=0)).max()
            whole = np.array_equal(signal.values, np.round(signal.values), equal_nan=True)
            usual = '"counts:4096" or "deg"?' if whole and span > checks.TURN_RAD else '"rad" or "deg"?'
            self.questions[(*at, "unit")] = (
                f"{reason or usual}  # it spans up to {span:.4g}, and its name has no unit; --unit answers, too"
            )
        if self.hints.calibration is not None and unit in lerobot.UNITS:
            scale, offset = lerobot.conversion(self.hints.calibration, signal.labels, unit)
            return msgspec.structs.replace(signal.mapped("rad"), scale=tuple(scale), offset=tuple(offset))
        return signal.mapped(unit)

    def in_lengths(self, fields: dict[str, FieldMapping]) -> dict[str, FieldMapping]:
        """Return fields with units of length for slides; without units for a robot with hinges and slides."""
        slides = self.hints.slides
        found = dict(fields)
        for name, how in fields.items() if slides else ():
            if how.log_unit in _OF_SLIDES:
                if how.unit != how.log_unit:
                    raise UsageError(
                        f"{', '.join(how.sources)} is in {how.unit}, but {', '.join(slides)} is a sliding joint",
                        hint="write a mapping with the scales to m and to rad: 0.001 for mm, 0.0174533 for degrees",
                    )
                unit = _OF_SLIDES[how.log_unit] if len(slides) == len(self.hints.joints) else ""
                found[name] = msgspec.structs.replace(how, unit=unit)
        return found

    # -- further fields, and unused signals

    def add_extras(self, command: Signal, measured: Signal, places: Sequence[int]) -> None:
        """Add gains, torque on or off, further commands and payload, by their names."""
        for name, (quantity, side, unit) in _EXTRA.items():
            listed = [
                s for s in self.signals
                if s.meaning.quantity == quantity and not set(s.sources) & {*command.sources, *measured.sources}
                and side in (None, s.meaning.side) and (s.values.ndim == 1 or len(s.values) == len(command.values))
            ]  # fmt: skip
            if len(listed) != 1 or name in self.fields["actuator"]:
                continue
            chosen = _in_order(listed[0], measured, places)
            if chosen is not None and not np.nan_to_num(chosen.values).any() and not name.startswith("payload"):
                self.evidence.append(f"{chosen.name!r} is 0 throughout: omitted")
            elif chosen is not None:
                self.fields["actuator"][name] = chosen.mapped(unit)
                self.reasons["actuator", name, "source"] = "by its name"

    def add_velocities(
        self, command: Signal, measured: Signal, places: Sequence[int], t_s: dict[str, np.ndarray]
    ) -> None:
        """Add velocities that are the derivative of the positions, or of the goals."""
        sides = {
            True: ("actuator", "goal_velocity", "goal", command),
            False: ("sensor", "velocity", "position", measured),
        }
        for s in self.signals:
            if s.meaning.quantity != "velocity" or s.values.ndim != 2 or s.sources == command.sources:
                continue
            node, name, base, of = sides[s.meaning.side == "command"]
            how, v = self.fields[node].get(base), _in_order(s, measured, places)
            if v is None or how is None or name in self.fields[node] or not isinstance(how.scale, float):
                continue
            if v.values.shape != of.values.shape:
                continue
            # The unit comes from the name, else from the positions; the data must agree.
            unit = f"{s.meaning.unit or how.unit}/s"
            angle = checks.counted(in_si(how.unit)[0] * of.values, checks.TURN_RAD)
            if checks.is_rate(t_s[node], angle, in_si(unit)[0] * v.values):
                self.fields[node][name] = v.mapped(unit)
                self.reasons[node, name, "unit"] = f"it is the rate of {of.name!r}"
            else:
                self.evidence.append(f"{s.name!r} is not the rate of {of.name!r}: omitted")

    def add_unused(self) -> None:
        """Add a note on signals of motion or commands that are not imported."""
        used = {
            source for node in self.mapping.nodes.values() for how in node.fields.values() for source in how.sources
        }
        left = [
            s.name for s in self.signals
            if s.meaning.quantity in ("", *_FIELDS) and (s.meaning.side or s.meaning.quantity)
            and not {s.whole, *s.sources} & used and not any(s.name in line for line in self.evidence)
        ]  # fmt: skip
        if left:
            self.evidence.append(f"not imported: {', '.join(left[:20])}" + " ..." * (len(left) > 20))

    # -- checks by the data

    def weigh(self, findings: Sequence[checks.Check], asked: tuple[str, str]) -> None:
        """Raise an error if data contradict the mapping, and ask if they fit several mappings.

        Args:
            asked: Node and field whose unit is asked for if no position follows its goal.
        """
        as_told = self.hints.as_told
        told = [f for f in findings if f.weight == "warn" or (as_told and f.weight != "note")]
        self.evidence += [f.text for f in findings if f.weight == "note"] + [f"warning: {f.text}" for f in told]
        open_ones = [f for f in findings if f.weight in ("ask", "refuse") and not as_told]
        # One line of the mapping answers these findings; other findings mean that the file is wrong. A single joint
        # with         # another scale is refused; if all joints have it, their unit is asked for.
        followed = any(f.name == "follows" and f.weight == "note" for f in findings)
        wrong = [f for f in open_ones if not f.question or (f.name == "slope" and f.weight == "refuse" and followed)]
        if wrong:
            text = "; ".join(f.text for f in wrong)
            raise UsageError(f"{self.table.path}: {text}", hint=checks.hint_for(wrong))
        for key in dict.fromkeys(f.question for f in open_ones):
            those = [f for f in open_ones if f.question == key]
            why = "; ".join(f.text for f in those)
            if self.hints.unit and all(f.name == "follows" for f in those):
                self.evidence.append(f"warning: {why}")  # --unit has answered already
            else:
                self.ask(asked if key == "unit" else ("actuator", "goal"), key, why, {f.joint for f in those})

    def ask(self, at: tuple[str, str], key: str, why: str, joints: Collection[int] = ()) -> None:
        """Ask for a line of the mapping that the data do not prove.

        Args:
            joints: Numbers of the joints that the question is about.
        """
        how = self.mapping.nodes[at[0]].fields[at[1]]
        scale = np.broadcast_to(how.scale, (len(self.joints),)).tolist()
        answers = {
            "unit": f'"{how.unit}" or another?  # {why}; --unit answers, too',
            "scale": f"{[-x if i in joints else x for i, x in enumerate(scale)]} or {scale}?  # {why}",
            "source": f"{json.dumps(how.sources)} in another order?  # {why}",
        }
        self.questions[(*at, key)] = f"{answers[key]}; --as-told keeps the file's"


def _rank(named: Meaning, side: str) -> int | None:
    """Return how well a name fits measured positions or commands, 0 being best; None: not at all."""
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


def _written(signal: Signal) -> str:
    """Return the source of a signal as in a mapping file, shortened."""
    if signal.whole or signal.width == 1:
        return json.dumps(signal.whole or signal.sources)
    return json.dumps(signal.sources[:1])[:-1] + ", ...]"


def _in_order(signal: Signal, measured: Signal, places: Sequence[int]) -> Signal | None:
    """Return the columns of the joints, or one column for all joints; None if they do not fit."""
    if all(signal.labels) and all(measured.labels) and set(measured.labels) <= set(signal.labels):
        return signal.taken([signal.labels.index(label) for label in measured.labels])
    if signal.width in (1, len(places)):
        return signal
    return signal.taken(places) if signal.width > max(places) and not any(signal.labels) else None


def _stamp_unit(stamps: Signal) -> tuple[str, str]:
    """Return the unit of stamps and the reason; or no unit, and the candidates."""
    if stamps.meaning.unit in STAMP_UNITS:
        return stamps.meaning.unit, "unit by its name"
    values = stamps.values[np.isfinite(stamps.values[:, 0]), 0]
    seconds = {unit: nanoseconds * 1e-9 for unit, nanoseconds in STAMP_UNITS.items()}
    rates_hz = {unit: 1 / (_period(values) * s) for unit, s in seconds.items()}
    likely = [u for u, rate_hz in rates_hz.items() if _RATES_HZ[0] <= rate_hz <= _RATES_HZ[1]]
    wall = [u for u in likely if _WALL_S[0] < values[0] * seconds[u] < _WALL_S[1]]
    if len(wall) == 1:
        return wall[0], "dates since 1970"
    if len(likely) == 1:
        return likely[0], f"{rates_hz[likely[0]]:.4g} samples a second"
    return "", " or ".join(f'"{u}"' for u in likely or seconds)


def _apart_s(header: np.ndarray, log: np.ndarray) -> float:
    """Return by how much two clocks [ns] drift apart [s], ignoring a few late messages."""
    apart = 1e-9 * (header - log)
    return max(float(np.ptp(np.quantile(apart, (0.05, 0.95)))), abs(float(apart[-1] - apart[0])))


def _period(values: np.ndarray) -> float:
    steps = np.diff(values[np.isfinite(values)])
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0


def _increases(values: np.ndarray) -> bool:
    steps = np.diff(values[np.isfinite(values)])
    return steps.size > 1 and float((steps > 0).mean()) > 0.9 and not (steps < 0).any()


def _may_be_stamps(signal: Signal, count: int) -> bool:
    nameless = not signal.meaning.quantity and not signal.meaning.side
    return nameless and signal.values.shape == (count, 1) and _increases(signal.values[:, 0])


def joint_motion(table: Table, joints: Sequence[str], unit: str) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the motion of a robot's joints in a table: its goals, or if it has none, its positions.

    Args:
        joints: Names of the commands, by which columns are chosen.
        unit: Unit of the commands.

    Returns:
        Times ``(N,)`` [s], values ``(N, joints)`` [unit], and their source in words.

    Raises:
        UsageError: No columns have these names, or their clock or unit is unclear.
    """
    of = Proposal(table, ImportHints("", joints=tuple(joints)))
    motions = []
    for s in of.signals:
        if s.values.ndim != 2 or s.meaning.quantity not in ("position", ""):
            continue
        found = columns_of(joints, s.labels) if any(s.labels) else None
        alone = len(joints) == 1 and s.width == 1 and s.meaning.side == "command"
        if found is not None or alone:
            motions.append(s.taken(found[0] if found else [0]))
    if not motions:
        raise UsageError(
            f"{table.path} has no columns for {', '.join(joints)}. Columns: {', '.join(table.keys[:30]) or 'none'}",
            hint=f"name the columns by joint, quantity and unit, such as {joints[0]}_goal_rad, and the time t_s",
        )
    signal = min(motions, key=lambda s: (s.meaning.side != "command", s.meaning.quantity != "position"))
    clock, _ = of.clock(signal, "motion")
    own = of.unit(signal)[0] if unit == "rad" else ""
    if unit == "rad" and not own:
        of.questions["motion", "", "unit"] = f"of {signal.name}: rad or deg? End the names with it"
    if of.questions:
        text = "; ".join(of.questions.values())
        raise UsageError(f"{table.path}: {text}", hint="name columns t_s, JOINT_goal_rad")
    node = NodeMapping({"motion": signal.mapped(own)}, **clock)
    episode = import_table(table, ImportMapping("motion", {"motion": node}))
    values = episode.outputs["motion"]["motion"].reshape(-1, len(joints))
    return episode.steps["motion"].begun_s, values, f"{signal.name} of {table.path.name}"
