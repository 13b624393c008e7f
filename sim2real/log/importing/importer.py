"""Imports files of other recorders: converts their signals to steps and outputs of nodes, and writes a log."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np

from sim2real.errors import OK, UsageError
from sim2real.graph.episode import Episode, StepRecord, Steps
from sim2real.installation import version
from sim2real.log.importing import checks
from sim2real.log.importing.mapping import STAMP_UNITS, ImportMapping, NodeMapping, in_si, load_mapping
from sim2real.log.importing.names import meaning
from sim2real.log.importing.readers import Table, open_table
from sim2real.log.writer import SessionFile
from sim2real.types import Json

_MAX_TICKS = 2**53  # 285 years [us]: whole numbers up to here are exact in float64
# Stamps above this [us since 1970: September 2001] come from a wall clock; clocks that start at boot are far lower.
_WALL_CLOCK = 10**15
# If the first stamp is below this [us], stamps count from the recording's start; otherwise time 0 is the first sample.
_OWN_START = 1_000_000
_MOST_LACKING = 0.05
"""Largest share of a node's samples in which a field may lack a number."""
_MOST_REPEATED = 0.1


def import_file(
    path: str | Path, mapping: ImportMapping | str | Path, samples: slice | None = None, episode: int | None = None
) -> Episode:
    """Read a file of another recorder as an episode.

    Each sample becomes a step that starts and ends at the sample's time stamp. Recorded stamps are rounded to
    microseconds. If the first stamp is at most 1 s, time 0 is the file's; otherwise time 0 is the first sample. Without
    recorded stamps, they are generated from the node's rate; the stamps ``frame_index / fps`` of a LeRobot data set
    count as generated. Angles that jump at the end of a turn are unwrapped. Samples that lack a number, repeat the
    previous stamp, or leap away and back are left out. The episode's metadata has ``stamps`` (node -> ``recorded`` or
    ``generated``), ``pipeline``, ``source`` (with the number of left out samples), ``graph``, ``mapping`` and
    ``versions``.

    Args:
        mapping: The mapping from signals to fields, or the mapping file.
        samples: Range of samples of every node; default: all.
        episode: Number of the episode of a LeRobot data set; default: the only one.

    Raises:
        UsageError: The file or the mapping cannot be read, they do not fit each other, the signals of a node
            differ in length, a gain lacks most of its numbers, a position jumps, or stamps do not increase.
    """
    chosen = mapping if isinstance(mapping, ImportMapping) else load_mapping(mapping)
    return import_table(open_table(Path(path), episode), chosen, samples)


@np.errstate(over="ignore", invalid="ignore")  # damaged files hold numbers of any size
def import_table(table: Table, mapping: ImportMapping, samples: slice | None = None) -> Episode:
    """Return a table as an episode; see ``import_file``."""
    nodes = {name: _Node(table, name, node) for name, node in mapping.nodes.items()}
    first = 0 if samples is None else _cut(table, nodes, samples)
    for node in nodes.values():
        node.select()
    ticks = {name: node.ticks() for name, node in nodes.items()}
    outputs = {name: node.outputs() for name, node in nodes.items()}
    _align_turns(nodes, outputs, ticks)
    # Move time 0 to the file's zero or the first sample.
    recorded = [name for name, node in nodes.items() if node.stamps is not None]
    begin = min((int(ticks[name][0]) for name in recorded), default=0)
    zero = 0 if 0 <= begin <= _OWN_START and not first else begin
    for name in recorded:
        ticks[name] -= zero
    source = {
        "file": table.path.name,
        "format": table.format,
        "sha256": _sha256(table.path),
        **({"beside": {p.name: _sha256(p) for p in table.beside}} if table.beside else {}),
        **({"notes": list(table.notes)} if table.notes else {}),
        "first_sample": first,
        "time_zero_us": zero,
        "dropped": {name: {why: n for why, n in node.dropped.items() if n} for name, node in nodes.items()},
        "turns": [f"{name}.{field}" for name, node in nodes.items() for field in sorted(node.turning)],
    }
    return Episode(
        steps={name: _steps(t) for name, t in ticks.items()},
        messages={},
        outputs=outputs,
        metadata={
            "pipeline": mapping.pipeline,
            "source": source,
            "stamps": {
                name: "recorded" if node.stamps is not None and node.stamps not in table.nominal else "generated"
                for name, node in mapping.nodes.items()
            },
            "graph": {name: {"rate_hz": _rate_hz(t), "inputs": {}} for name, t in ticks.items()},
            "mapping": {name: msgspec.to_builtins(node) for name, node in mapping.nodes.items()},
            "versions": {"sim2real": version()},
        },
        units=mapping.units,
    )


def write_log(path: str | Path, episode: Episode) -> None:
    """Write an imported episode as a log.

    At equal stamps, commands come last. The log's time 0 is 1970 on the wall clock, unless the file's stamps come from
    a wall clock.

    Args:
        path: The log; it must not exist.
        episode: The result of ``import_file``.

    Raises:
        Sim2RealError: When the log exists or cannot be written, or names collide.
    """
    names = list(episode.steps)
    examples = {node: {f: v[0] for f, v in fields.items()} for node, fields in episode.outputs.items()}
    file = SessionFile(Path(path), episode.metadata, {}, examples, [], {}, episode.units)
    try:
        zero = episode.metadata["source"]["time_zero_us"]
        file.start(1000 * zero if zero >= _WALL_CLOCK else 0, 0)
        counts = [len(episode.steps[n]) for n in names]
        seq = np.concatenate([np.arange(n) for n in counts])
        node = np.repeat(np.arange(len(names)), counts)
        answers = np.repeat([n == "actuator" for n in names], counts)
        ticks = np.concatenate([episode.steps[n].start for n in names])
        for row in np.lexsort((node, answers, ticks)).tolist():
            name, k, tick = names[node[row]], int(seq[row]), int(ticks[row])
            record = StepRecord(name, k, tick, tick, tick, -1, tick, 0)
            file.step(record, [values[k] for values in episode.outputs[name].values()])
        # No lateness and no computation times were measured, so the session's end has none.
        file.finish({"status": "finished", "exit_code": OK})
    except BaseException:
        # Remove an incomplete log: the import can be repeated.
        file.abandon()
        Path(path).unlink(missing_ok=True)
        raise


def facts(episode: Episode) -> dict[str, Json]:
    """Return the summary of an import."""
    source = episode.metadata["source"]
    dropped = {f"{n}, {why}": count for n, by in source["dropped"].items() for why, count in by.items()}
    return {
        "source": source["file"],
        "seconds": episode.duration_s,
        "samples": {name: len(steps) for name, steps in episode.steps.items()},
        "rate [Hz]": {name: node["rate_hz"] for name, node in episode.metadata["graph"].items()},
        "stamps": episode.metadata["stamps"],
        **({"left out": dropped} if dropped else {}),
        **({"turns are counted": ", ".join(source["turns"])} if source["turns"] else {}),
    }


# -- the samples of a node


class _Node:
    """The samples of one node.

    Attributes:
        fields: Field -> values of all samples in the log's unit, shape ``(N, ...)``.
        stamps: Shape ``(N,)``: recorded stamps; None without stamps.
        rows: Numbers of the selected samples in the file.
        turning: Fields with angles that jump at the end of a turn.
        dropped: Reason -> number of samples that were left out.
    """

    def __init__(self, table: Table, name: str, mapping: NodeMapping) -> None:
        self.table, self.name, self.mapping = table, name, mapping
        self.stamps = None if mapping.stamps is None else table.signal(mapping.stamps)
        if self.stamps is not None and self.stamps.ndim != 1:
            raise UsageError(
                f"stamps {mapping.stamps!r} in {table.path} have the shape {self.stamps.shape}, expected (N,)",
                hint=f'choose a column, such as stamps = "{mapping.stamps}[:,0]"',
            )
        # All signals must have the same length; constants are repeated in every sample.
        signals = {source: table.signal(source) for how in mapping.fields.values() for source in how.sources}
        lengths = {source: len(values) for source, values in signals.items() if values.ndim}
        lengths |= {f"stamps {mapping.stamps!r}": len(self.stamps)} if self.stamps is not None else {}
        if len(set(lengths.values())) != 1:
            listed = ", ".join(f"{signal} {length}" for signal, length in lengths.items())
            raise UsageError(
                f"the signals of node {name!r} differ in length: {listed}"
                if lengths
                else f"node {name!r} gets only constants from {table.path}",
                hint="put signals with other stamps into another node; the stamps determine a node's samples",
            )
        count = next(iter(lengths.values()))
        if not count:
            raise UsageError(f"node {name!r} has no samples in {table.path}", hint="check that the file is complete")
        self.rows, self.dropped = np.arange(count), Counter[str]()
        series = {source: values if values.ndim else np.full(count, values) for source, values in signals.items()}
        self.fields = {
            field: self.scaled(field, [series[s] for s in how.sources]) for field, how in mapping.fields.items()
        }
        # Fields of a robot with hinges and slides have no unit. Unwrap all samples, so that a part keeps the turns of
        # the whole.
        self.turning: set[str] = set()
        for field, values in self.fields.items():
            how = mapping.fields[field]
            if how.log_unit == "rad" or (not how.unit and field in ("position", "goal")):
                counted = checks.counted(values.reshape(count, -1), checks.TURN_RAD).reshape(values.shape)
                if not np.array_equal(counted, values, equal_nan=True):
                    self.fields[field] = counted
                    self.turning.add(field)

    def scaled(self, field: str, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return a field's values in the log's unit, shape ``(N, ...)``; columns of several sources are joined."""
        how = self.mapping.fields[field]
        factor, unit = in_si(how.unit)
        for source, part in zip(how.sources, parts, strict=True):
            # Jumps by 2^16 or 2^32 come from counts that were read with the wrong sign, unless they are a turn.
            for column in part.reshape(len(part), -1).T if unit == "rad" else ():
                modulus = checks.unsigned(column)
                turns = factor * np.abs(np.asarray(how.scale)) * (modulus or 0) / checks.TURN_RAD
                if modulus is not None and not np.isclose(turns, 1.0, atol=0.01).any():
                    raise UsageError(
                        f"{source} in {self.table.path} jumps by {modulus}: signed counts that were read as unsigned, "
                        f"or counts beyond {modulus.bit_length() - 1} bits",
                        hint="decode them as signed (two's complement, or a sign bit) before the import",
                    )
        raw = parts[0]
        if not isinstance(how.source, str):
            raw = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
        scale, offset = (np.squeeze(x) if np.size(x) == 1 else np.asarray(x) for x in (how.scale, how.offset))
        for key, numbers in (("scale", scale), ("offset", offset)):
            if numbers.ndim and numbers.shape != raw.shape[1:]:
                raise UsageError(
                    f"field {self.name}.{field} has {numbers.size} values of {key} for samples of shape "
                    f"{raw.shape[1:]}",
                    hint="give one number, or one for each column",
                )
        values = scale * raw.astype(np.float64) + offset
        return (values if factor == 1.0 else factor * values).astype(raw.dtype if raw.dtype.kind == "f" else np.float64)

    def keep(self, good: np.ndarray, reason: str) -> None:
        """Keep the good ones of the selected samples, and count the others under ``reason``."""
        self.dropped[reason] += int((~good).sum())
        self.rows = self.rows[good]

    def select(self) -> None:
        """Leave out samples that lack a number, repeat a stamp or leap; refuse positions that no joint can have."""
        whole = {
            field: np.asarray(np.isfinite(values).reshape(len(values), -1).all(axis=1))[self.rows]
            for field, values in self.fields.items()
        }
        good = np.logical_and.reduce(list(whole.values()))
        # In a table of two streams, numbers are missing in turn. A rarely written gain would make most goals drop out.
        first = next(iter(whole.values()))
        if (first & ~good).sum() > _MOST_LACKING * max(first.sum(), 1):
            field = min(whole, key=lambda name: whole[name].sum())
            raise UsageError(
                f"field {self.name}.{field} in {self.table.path} has no number in {(~whole[field]).sum()} of "
                f"{len(good)} samples",
                hint="remove the field from the mapping, or fill its column",
            )
        if self.stamps is not None:
            good &= np.isfinite(self.stamps[self.rows])
        self.keep(good, "without a number")
        if self.stamps is not None and len(self.rows):
            stamps = self.stamps[self.rows]
            fresh = np.concatenate([[True], stamps[1:] != stamps[:-1]])
            if fresh.mean() > 1 - _MOST_REPEATED:  # more equal stamps mean that the stamps are too coarse
                self.keep(fresh, "repeated stamp")
        for field, how in self.mapping.fields.items():
            if _is_position(field) and how.log_unit == "rad":
                self.leave_out_glitches(field)

    def leave_out_glitches(self, field: str) -> None:
        """Leave out samples whose positions leap away and back; refuse a jump without return."""
        t_s = self.rows / (self.mapping.rate_hz or 1.0)
        if self.stamps is not None:
            t_s = self.stamps[self.rows] * (STAMP_UNITS[self.mapping.stamp_unit] * 1e-9)
        if len(self.rows) < 3 or not (np.isfinite(t_s).all() and (np.diff(t_s) > 0).all()):
            return  # the check of stamps raises a better error
        angle = self.fields[field][self.rows].reshape(len(self.rows), -1).astype(np.float64)
        good = np.asarray(~checks.glitches(t_s, angle).any(axis=1))
        # Such a jump means another zero, another unit or missing samples.
        if (jump := checks.leap(t_s[good], angle[good])) is not None:
            k, i, size = jump
            sources = self.mapping.fields[field].sources
            source = sources[i] if len(sources) == angle.shape[1] else f"{sources[0]}[:,{i}]"
            raise UsageError(
                f"{source} in {self.table.path} changes by {size:.4g} rad before sample {self.rows[good][k]}, within "
                f"{t_s[good][k] - t_s[good][k - 1]:.3g} s: a joint cannot, so its zero or its unit has changed",
                hint="cut the file there with --samples A:B, correct the unit, or omit this joint",
            )
        self.keep(good, "leap away and back")

    def ticks(self) -> np.ndarray:
        """Return the stamps of the selected samples, shape ``(N,)``, int64 [us]."""
        if not len(self.rows):
            raise UsageError(
                f"no sample of node {self.name!r} in {self.table.path} is complete", hint="check its columns"
            )
        if self.stamps is None:
            # Use the slots of the timing rules for a node of this rate.
            slots = (self.rows - self.rows[0]) * 1e6 / (self.mapping.rate_hz or 1.0)
            return np.floor(slots + 0.5).astype(np.int64)
        stamps, unit = self.stamps[self.rows], self.mapping.stamp_unit
        what = f"stamps {self.mapping.stamps!r} of node {self.name!r} in {self.table.path}"
        hint = f"stamp_unit is {unit!r}; available: {', '.join(STAMP_UNITS)}"
        nanoseconds = STAMP_UNITS[unit]
        if np.abs(stamps * (nanoseconds / 1000)).max() >= _MAX_TICKS:
            raise UsageError(f"{what} are centuries away: {stamps[0]} {unit}", hint=hint)
        if stamps.dtype.kind == "i":
            ticks = (stamps + 500) // 1000 if nanoseconds < 1000 else stamps * (nanoseconds // 1000)
        else:
            ticks = np.rint(stamps.astype(np.float64) * (nanoseconds / 1000)).astype(np.int64)
        if (wrong := np.flatnonzero(np.diff(ticks) <= 0)).size:
            k = int(wrong[0])
            listed = ", ".join(f"sample {self.rows[i]} at {stamps[i]} {unit}" for i in (k, k + 1))
            raise UsageError(f"{what} do not increase: {listed}", hint=f"a microsecond apart at least; {hint}")
        return ticks + round(1e6 * self.mapping.stamp_offset)

    def outputs(self) -> dict[str, np.ndarray]:
        """Return the selected samples of each field, shape ``(N, ...)``."""
        return {field: np.ascontiguousarray(values[self.rows]) for field, values in self.fields.items()}


def _is_position(field: str) -> bool:
    named = meaning(field)
    return named.quantity == "position" and named.side != "command"


def _cut(table: Table, nodes: Mapping[str, _Node], samples: slice) -> int:
    """Select a range of samples; return the first."""
    counts = {name: len(node.rows) for name, node in nodes.items()}
    if samples.step not in (None, 1) or len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise UsageError(
            f"a range of samples is no range of time: it has a step, or nodes differ in their samples: {listed}",
            hint="import all samples, and cut the file itself",
        )
    # Check the limits, because a slice would accept any number.
    count = next(iter(counts.values()))
    first, stop, _ = samples.indices(count)
    beyond = [n for n in (samples.start, samples.stop) if n is not None and not -count <= n <= count]
    if beyond or first >= stop:
        text = ":".join("" if n is None else str(n) for n in (samples.start, samples.stop))
        raise UsageError(f"samples {text} are not in {table.path}: it has {count}", hint=f"choose from 0:{count}")
    for node in nodes.values():
        node.rows = node.rows[first:stop]
    return first


def _align_turns(
    nodes: Mapping[str, _Node], outputs: Mapping[str, dict[str, np.ndarray]], ticks: Mapping[str, np.ndarray]
) -> None:
    """Shift commands by whole turns to their positions, because turns are counted from the start of each signal."""
    # Fields without a unit are those of a robot with hinges and slides.
    angles = [
        (n, f) for n, node in nodes.items() for f, how in node.mapping.fields.items() if how.log_unit in ("rad", "")
    ]
    for name, field in angles:
        for other, goal in angles if _is_position(field) else ():
            a, b = outputs[name][field], outputs[other][goal]
            has_turns = field in nodes[name].turning or goal in nodes[other].turning
            if (
                meaning(goal).side != "command"
                or not has_turns
                or a.shape[1:] != b.shape[1:]
                or min(len(a), len(b)) < 2
            ):
                continue
            q, c = (x.reshape(len(x), -1) for x in (a, b))
            at = np.stack([np.interp(ticks[other], ticks[name], column) for column in q.T], axis=1)
            turned = c - checks.TURN_RAD * np.round(np.median(c - at, axis=0) / checks.TURN_RAD)
            outputs[other][goal] = turned.reshape(b.shape)


def _steps(ticks: np.ndarray) -> Steps:
    never, zeros = np.full_like(ticks, -1), np.zeros_like(ticks)
    return Steps(scheduled=ticks, start=ticks, woken=ticks, ts_overwrite=never, end=ticks, drift=zeros)


def _rate_hz(ticks: np.ndarray) -> float | None:
    return round(1e6 / float(np.median(np.diff(ticks))), 3) if len(ticks) > 1 else None


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
