"""Imports files of other recorders: converts their signals to steps and outputs of nodes, and writes a log."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from sim2real.errors import OK, UsageError
from sim2real.graph.episode import Episode, StepRecord, Steps
from sim2real.installation import version
from sim2real.log.importing import checks
from sim2real.log.importing.mapping import STAMP_UNITS, FieldMapping, ImportMapping, NodeMapping, in_si, load_mapping
from sim2real.log.importing.names import meaning
from sim2real.log.importing.readers import Table, open_tables
from sim2real.log.writer import SessionFile
from sim2real.types import Json

_MAX_TICKS = 2**53  # 285 years [us]: whole numbers up to here are exact in float64
# Stamps from here on [us since 1970: September 2001] come from a wall clock; clocks that start at boot are far lower.
_WALL_CLOCK = 10**15
# With a first stamp up to here [us], stamps count from the recording's start; otherwise time 0 is the first sample.
_OWN_START = 1_000_000
_MOST_LACKING = 0.05
"""A field of a node may lack numbers in this share of the samples in which the node's first field has one."""
_MOST_REPEATED = 0.1


@dataclass
class _Stream:
    """The samples of one node, before and after a selection.

    Attributes:
        fields: Field -> values in the log's unit, shape ``(N, ...)``.
        stamps: Shape ``(N,)``, as recorded; None without any.
        rows: The numbers of the selected samples in the file.
        turning: Fields with angles that jumped at the end of a turn.
        dropped: Reason -> number of samples that were left out.
    """

    fields: dict[str, np.ndarray]
    stamps: np.ndarray | None
    rows: np.ndarray
    turning: set[str]
    dropped: Counter[str]

    def keep(self, good: np.ndarray, reason: str) -> None:
        self.dropped[reason] += int((~good).sum())
        self.rows = self.rows[good]


def import_file(
    path: str | Path, mapping: ImportMapping | str | Path, samples: slice | None = None, episode: int | None = None
) -> Episode:
    """Read a file of another recorder as an episode.

    Each sample becomes a step that starts and ends at the sample's time stamp. Recorded stamps are rounded to
    microseconds. If the first one is within 1 s after 0, time 0 is that of the file; otherwise time 0 is the first
    sample. Without recorded stamps, they are generated from the node's rate; stamps of a LeRobot data set that are
    ``frame_index / fps`` count as generated. Turns of angles that jump at the end of a turn are counted. Samples that
    lack a number, repeat the stamp before, or leap away and back are left out. The episode's metadata has ``stamps``
    (node -> ``recorded`` or ``generated``), ``pipeline``, ``source`` (with the counts of what was left out), ``graph``,
    ``mapping`` and ``versions``.

    Args:
        mapping: The mapping from signals to fields, or the mapping file.
        samples: Range of samples of every node; default: all.
        episode: Number of the episode of a LeRobot data set; default: the only one.

    Raises:
        UsageError: When the file or the mapping cannot be read, they do not fit each other, the signals of a node
            differ in length, a gain lacks most of its numbers, a position jumps, or stamps do not increase.
    """
    chosen = mapping if isinstance(mapping, ImportMapping) else load_mapping(mapping)
    tables = open_tables(Path(path), episode)
    if len(tables) > 1:
        raise UsageError(f"{path} holds {len(tables)} episodes", hint="choose one: episode=0")
    return import_table(tables[0], chosen, samples)


@np.errstate(over="ignore", invalid="ignore")  # damaged files hold numbers of any size
def import_table(table: Table, mapping: ImportMapping, samples: slice | None = None) -> Episode:
    """Return a table as an episode; see ``import_file``."""
    streams = {name: _stream(table, name, node) for name, node in mapping.nodes.items()}
    first = _cut(table, streams, samples)
    ticks = {}
    for name, node in mapping.nodes.items():
        _select(table, name, node, streams[name])
        ticks[name] = _ticks(table, name, node, streams[name])
    outputs = {
        name: {f: _samples(table, name, f, streams[name]) for f in node.fields} for name, node in mapping.nodes.items()
    }
    _align_turns(mapping, streams, outputs, ticks)
    # Move time 0 to the file's zero or the first sample.
    recorded = [name for name, own in streams.items() if own.stamps is not None]
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
        "dropped": {name: {p: n for p, n in own.dropped.items() if n} for name, own in streams.items()},
        "turns": [f"{name}.{field}" for name, own in streams.items() for field in sorted(own.turning)],
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


def write_log(path: str | Path, episode: Episode, mapping: ImportMapping) -> None:
    """Write an imported episode as a log.

    Steps with the same stamp are written in the order that the mapping gives to nodes. The log's time 0 is 1970 on the
    wall clock unless the file's stamps come from a wall clock.

    Args:
        path: The log; it must not exist.
        episode: The result of ``import_file``.
        mapping: The mapping of the import.

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
        order = [mapping.nodes[n].order for n in names]
        order = np.repeat([int(n == "actuator") if k is None else k for n, k in zip(names, order, strict=True)], counts)
        ticks = np.concatenate([episode.steps[n].start for n in names])
        for row in np.lexsort((node, order, ticks)).tolist():
            name, k, tick = names[node[row]], int(seq[row]), int(ticks[row])
            record = StepRecord(name, k, tick, tick, tick, -1, tick, 0)
            file.step(record, [values[k] for values in episode.outputs[name].values()])
        # Nothing else was measured: the end has no timing, no lateness and no suspicion.
        file.finish({"status": "finished", "exit_code": OK})
    except BaseException:
        # Remove an incomplete log, as the import can be repeated.
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


# -- the signals of a node


def _stream(table: Table, name: str, node: NodeMapping) -> _Stream:
    """Read a node's signals, all of the same length; constants are the same in every sample."""
    stamps = None if node.stamps is None else table.signal(node.stamps)
    if stamps is not None and stamps.ndim != 1:
        raise UsageError(
            f"stamps {node.stamps!r} in {table.path} have the shape {stamps.shape}, expected (N,)",
            hint=f'choose a column, such as stamps = "{node.stamps}[:,0]"',
        )
    signals = {source: table.signal(source) for how in node.fields.values() for source in how.sources}
    lengths = {source: len(values) for source, values in signals.items() if values.ndim}
    lengths |= {f"stamps {node.stamps!r}": len(stamps)} if stamps is not None else {}
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
    series = {source: values if values.ndim else np.full(count, values) for source, values in signals.items()}
    stream = _Stream({}, stamps, np.arange(count), set(), Counter())
    for field, how in node.fields.items():
        stream.fields[field] = _field(table, f"{name}.{field}", how, [series[s] for s in how.sources])
        # A robot with hinges and slides has no unit. Count over all samples, so that a part has the turns of the whole.
        if how.log_unit == "rad" or (not how.unit and field in ("position", "goal")):
            scaled = stream.fields[field]
            counted = checks.counted(scaled.reshape(count, -1), checks.TURN_RAD).reshape(scaled.shape)
            if not np.array_equal(counted, scaled, equal_nan=True):
                stream.fields[field] = counted
                stream.turning.add(field)
    return stream


def _field(table: Table, name: str, how: FieldMapping, parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return a field's values in the log's unit, shape ``(N, ...)``; a list of sources has the columns of all."""
    factor, unit = in_si(how.unit)
    for source, part in zip(how.sources, parts, strict=True):
        # Jumps by 2^16 or 2^32 are counts that were read with the wrong sign, unless they are a turn.
        for column in part.reshape(len(part), -1).T if unit == "rad" else ():
            modulus = checks.unsigned(column)
            turns = factor * np.abs(np.asarray(how.scale)) * (modulus or 0) / checks.TURN_RAD
            if modulus is not None and not np.isclose(turns, 1.0, atol=0.01).any():
                raise UsageError(
                    f"{source} in {table.path} jumps by {modulus}: signed counts that were read as unsigned, or counts "
                    f"beyond {modulus.bit_length() - 1} bits",
                    hint="decode them as signed (two's complement, or a sign bit) before the import",
                )
    raw = parts[0]
    if not isinstance(how.source, str):
        raw = np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    scale, offset = (np.squeeze(x) if np.size(x) == 1 else np.asarray(x) for x in (how.scale, how.offset))
    for key, numbers in (("scale", scale), ("offset", offset)):
        if numbers.ndim and numbers.shape != raw.shape[1:]:
            raise UsageError(
                f"field {name} has {numbers.size} values of {key} for samples of shape {raw.shape[1:]}",
                hint="give one number, or one for each column",
            )
    scaled = scale * raw.astype(np.float64) + offset
    return (scaled if factor == 1.0 else factor * scaled).astype(raw.dtype if raw.dtype.kind == "f" else np.float64)


def _cut(table: Table, streams: Mapping[str, _Stream], samples: slice | None) -> int:
    """Select a range of samples; return the first."""
    if samples is None:
        return 0
    if samples.step not in (None, 1):
        raise UsageError(f"a range of samples has no step, got {samples.step}", hint="remove the step")
    counts = {name: len(own.rows) for name, own in streams.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"{name} {count}" for name, count in counts.items())
        raise UsageError(
            f"the nodes differ in their number of samples, so a range of samples is no range of time: {listed}",
            hint="import all samples, and cut the file itself",
        )
    # Check the limits, as a slice would accept any number.
    count = next(iter(counts.values()))
    first, stop, _ = samples.indices(count)
    beyond = [n for n in (samples.start, samples.stop) if n is not None and not -count <= n <= count]
    if beyond or first >= stop:
        text = ":".join("" if n is None else str(n) for n in (samples.start, samples.stop))
        raise UsageError(f"samples {text} are not in {table.path}: it has {count}", hint=f"choose from 0:{count}")
    for own in streams.values():
        own.rows = own.rows[first:stop]
    return first


def _select(table: Table, name: str, node: NodeMapping, own: _Stream) -> None:
    """Leave out samples that lack a number, repeat a stamp or leap; refuse positions that no joint can have."""
    whole = {field: _finite(v)[own.rows] for field, v in own.fields.items()}
    everywhere = np.ones(len(own.rows), bool)
    good = np.logical_and.reduce([everywhere, *whole.values()])
    # Two streams in one table lack numbers in turn. A gain that is written rarely would cost most of the goals.
    first = next(iter(whole.values()), everywhere)
    if (first & ~good).sum() > _MOST_LACKING * max(first.sum(), 1):
        field = min(whole, key=lambda name: whole[name].sum())
        lacking = int((~whole[field]).sum())
        raise UsageError(
            f"field {name}.{field} in {table.path} has no number in {lacking} of {len(good)} samples",
            hint="remove the field from the mapping, or fill its column",
        )
    if own.stamps is not None:
        good &= np.isfinite(own.stamps[own.rows])
    own.keep(good, "without a number")
    if own.stamps is not None and len(own.rows):
        stamps = own.stamps[own.rows]
        fresh = np.concatenate([[True], stamps[1:] != stamps[:-1]])
        if fresh.mean() > 1 - _MOST_REPEATED:  # more of them are stamps that are too coarse
            own.keep(fresh, "repeated stamp")
    for field, how in node.fields.items():
        named = meaning(field)
        if named.quantity == "position" and named.side != "command" and how.log_unit == "rad":
            _keep_plausible(table, name, field, node, own)


def _keep_plausible(table: Table, name: str, field: str, node: NodeMapping, own: _Stream) -> None:
    """Leave out samples whose positions leap away and back.

    Raises:
        UsageError: When positions jump farther than a joint can move, and stay there.
    """
    values = own.fields[field]
    t_s = own.rows / (node.rate_hz or 1.0)
    if own.stamps is not None:
        t_s = own.stamps[own.rows] * (STAMP_UNITS[node.stamp_unit] * 1e-9)
    if len(own.rows) < 3 or not (np.isfinite(t_s).all() and (np.diff(t_s) > 0).all()):
        return  # the check of stamps raises the better error
    angle = values[own.rows].reshape(len(own.rows), -1).astype(np.float64)
    good = np.asarray(~checks.glitches(t_s, angle).any(axis=1))
    # A jump without return means another zero, another unit or missing samples.
    if (jump := checks.leap(t_s[good], angle[good])) is not None:
        k, i, size = jump
        sources = node.fields[field].sources
        source = sources[i] if len(sources) == angle.shape[1] else f"{sources[0]}[:,{i}]"
        raise UsageError(
            f"{source} in {table.path} changes by {size:.4g} rad before sample {own.rows[good][k]}, within "
            f"{t_s[good][k] - t_s[good][k - 1]:.3g} s: a joint cannot, so its zero or its unit has changed",
            hint="cut the file there with --samples A:B, correct the unit, or omit this joint",
        )
    own.keep(good, "leap away and back")


def _samples(table: Table, name: str, field: str, own: _Stream) -> np.ndarray:
    """Return the selected samples of a field, shape ``(N, ...)``."""
    values = own.fields[field][own.rows]
    if not values.size or not np.isfinite(values).all():
        raise UsageError(
            f"field {name}.{field} has no finite number in {table.path}", hint="check the file, or remove the field"
        )
    return np.ascontiguousarray(values)


def _ticks(table: Table, name: str, node: NodeMapping, own: _Stream) -> np.ndarray:
    """Return the stamps of the selected samples, shape ``(N,)``, int64 [us]."""
    if own.stamps is None:
        # Use the slots of the timing rules for a node of this rate.
        return np.floor((own.rows - own.rows[:1]) * 1e6 / (node.rate_hz or 1.0) + 0.5).astype(np.int64)
    stamps = own.stamps[own.rows]
    what = f"stamps {node.stamps!r} of node {name!r}"
    hint = f"stamp_unit is {node.stamp_unit!r}; available: {', '.join(STAMP_UNITS)}"
    nanoseconds = STAMP_UNITS[node.stamp_unit]
    if not len(stamps):
        raise UsageError(f"no sample of node {name!r} in {table.path} is complete", hint="check its columns")
    if np.abs(stamps * (nanoseconds / 1000)).max() >= _MAX_TICKS:
        raise UsageError(f"{what} in {table.path} are centuries away: {stamps[0]} {node.stamp_unit}", hint=hint)
    if stamps.dtype.kind == "i":
        ticks = (stamps + 500) // 1000 if nanoseconds < 1000 else stamps * (nanoseconds // 1000)
    else:
        ticks = np.rint(stamps.astype(np.float64) * (nanoseconds / 1000)).astype(np.int64)
    if (wrong := np.flatnonzero(np.diff(ticks) <= 0)).size:
        k = int(wrong[0])
        raise UsageError(
            f"{what} in {table.path} do not increase: sample {own.rows[k]} at {stamps[k]} {node.stamp_unit}, "
            f"sample {own.rows[k + 1]} at {stamps[k + 1]} {node.stamp_unit}",
            hint=f"samples must be a microsecond apart at least; {hint}",
        )
    return ticks + round(1e6 * node.stamp_offset)


def _align_turns(
    mapping: ImportMapping,
    streams: Mapping[str, _Stream],
    outputs: Mapping[str, dict[str, np.ndarray]],
    ticks: Mapping[str, np.ndarray],
) -> None:
    """Shift commands to the turn of their positions, as turns are counted from the start of each signal."""
    angles = [
        (name, field)
        for name, node in mapping.nodes.items()
        for field, how in node.fields.items()
        if how.log_unit in ("rad", "")  # without a unit where a robot has hinges and slides
    ]
    positions = [a for a in angles if meaning(a[1]).quantity == "position" and meaning(a[1]).side != "command"]
    for name, field in positions:
        for other, goal in angles:
            a, b = outputs[name][field], outputs[other][goal]
            has_turns = field in streams[name].turning or goal in streams[other].turning
            if meaning(goal).side != "command" or not has_turns:
                continue
            if a.shape[1:] != b.shape[1:] or min(len(a), len(b)) < 2:
                continue
            q, c = (x.reshape(len(x), -1) for x in (a, b))
            at = np.stack([np.interp(ticks[other], ticks[name], column) for column in q.T], axis=1)
            turned = c - checks.TURN_RAD * np.round(np.median(c - at, axis=0) / checks.TURN_RAD)
            outputs[other][goal] = turned.reshape(b.shape)


def _finite(values: np.ndarray) -> np.ndarray:
    """Return whether all numbers of a sample are finite, ``(N,)``."""
    return np.asarray(np.isfinite(values).reshape(len(values), -1).all(axis=1))


def _steps(ticks: np.ndarray) -> Steps:
    never, zeros = np.full_like(ticks, -1), np.zeros_like(ticks)
    return Steps(scheduled=ticks, start=ticks, woken=ticks, ts_overwrite=never, end=ticks, drift=zeros)


def _rate_hz(ticks: np.ndarray) -> float | None:
    return round(1e6 / float(np.median(np.diff(ticks))), 3) if len(ticks) > 1 else None


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
