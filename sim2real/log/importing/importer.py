"""Imports files of other recorders: converts their signals to steps and outputs of nodes, and writes a log."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from sim2real.errors import OK, UsageError
from sim2real.graph.episode import Episode, StepRecord, Steps
from sim2real.installation import version
from sim2real.log.importing import checks
from sim2real.log.importing.mapping import (
    STAMP_UNITS,
    FieldMapping,
    ImportMapping,
    NodeMapping,
    in_si,
    load_mapping,
    positive,
)
from sim2real.log.importing.names import meaning
from sim2real.log.importing.readers import Table, open_tables
from sim2real.log.writer import SessionFile
from sim2real.types import Json

RECORDED, GENERATED = "recorded", "generated"
_MAX_TICKS = 2**53  # 285 years [us]: whole numbers up to here are exact in float64
# Stamps from here on [us since 1970: September 2001] come from a wall clock; clocks that start at boot are far lower.
_WALL_CLOCK = 10**15
# With a first stamp up to here [us], stamps count from the recording's start; otherwise time 0 is the first sample.
_OWN_START = 1_000_000
_COMMANDING = "actuator"


@dataclass(frozen=True)
class _Signals:
    """The signals of one node.

    Attributes:
        fields: Field -> values, shape ``(N, ...)``, or ``()`` for a constant.
        stamps: Shape ``(N,)``: recorded time stamps; None without any.
        count: Number of samples N.
        rate_hz: Rate from which stamps are generated [Hz]; None with recorded stamps.
    """

    fields: Mapping[str, np.ndarray]
    stamps: np.ndarray | None
    count: int
    rate_hz: float | None


def import_file(
    path: str | Path, mapping: ImportMapping | str | Path, samples: slice | None = None, episode: int | None = None
) -> Episode:
    """Read a file of another recorder as an episode.

    Each sample becomes a step that starts and ends at the sample's time stamp. Recorded stamps are selected, rounded to
    microseconds. If the first one is within 1 s after 0, time 0 is that of the file; otherwise time 0 is the first
    sample. Without recorded stamps, they are generated from the node's rate; stamps of a LeRobot data set that are
    ``frame_index / fps`` count as generated. The episode's metadata has ``stamps``
    (node -> ``recorded`` or ``generated``), ``pipeline``, ``source``, ``graph``, ``mapping`` and
    ``versions``.

    Args:
        mapping: The mapping from signals to fields, or the mapping file.
        samples: Range of samples of every node; default: all.
        episode: Number of the episode of a LeRobot data set; default: the only one.

    Raises:
        UsageError: When the file or the mapping cannot be read, they do not fit each other, the signals of a node
            differ in length, a sample is not finite, or stamps do not increase.
    """
    chosen = mapping if isinstance(mapping, ImportMapping) else load_mapping(mapping)
    tables = open_tables(Path(path), episode)
    if len(tables) > 1:
        raise UsageError(f"{path} holds {len(tables)} episodes", hint="choose one: episode=0")
    return import_table(tables[0], chosen, samples)


def import_table(table: Table, mapping: ImportMapping, samples: slice | None = None) -> Episode:
    """Return a table as an episode; see ``import_file``."""
    # Read all signals, and select the samples of each node.
    signals = {name: _signals(table, name, node) for name, node in mapping.nodes.items()}
    first, stop = _range(table, {name: s.count for name, s in signals.items()}, samples)
    ticks, outputs, stamps, dropped = {}, {}, {}, {}
    for name, node in mapping.nodes.items():
        own, last = signals[name], signals[name].count if stop is None else stop
        selected = _selected(node, own, first, last)
        selected = _plausible(f"node {name} in {table.path}", node, own, selected)
        outputs[name] = {
            field: _samples(table, f"{name}.{field}", own.fields[field], how, selected)
            for field, how in node.fields.items()
        }
        ticks[name] = _ticks(table, name, node, own, selected)
        stamps[name] = GENERATED if own.stamps is None or node.stamps in table.nominal else RECORDED
        dropped[name] = last - first - len(selected)
    # Move time 0 to the file's zero or the first sample.
    _align_turns(mapping, outputs, ticks)
    from_file = [name for name, own in signals.items() if own.stamps is not None]
    begin = min((int(ticks[name][0]) for name in from_file), default=0)
    zero = 0 if 0 <= begin <= _OWN_START and not first else begin
    for name in from_file:
        ticks[name] -= zero
    source = {
        "file": table.path.name,
        "format": table.format,
        "sha256": _sha256(table.path),
        **({"beside": {p.name: _sha256(p) for p in table.beside}} if table.beside else {}),
        **({"notes": list(table.notes)} if table.notes else {}),
        "first_sample": first,
        "time_zero_us": zero,
        "dropped": dropped,
    }
    return Episode(
        steps={name: _steps(t) for name, t in ticks.items()},
        messages={},
        outputs=outputs,
        metadata={
            "pipeline": mapping.pipeline,
            "source": source,
            "stamps": stamps,
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
        order = np.repeat([_order(name, mapping.nodes[name]) for name in names], counts)
        ticks = np.concatenate([episode.steps[n].start for n in names])
        for row in np.lexsort((node, order, ticks)).tolist():
            name, k, tick = names[node[row]], int(seq[row]), int(ticks[row])
            record = StepRecord(name, k, tick, tick, tick, -1, tick, 0)
            file.step(record, [values[k] for values in episode.outputs[name].values()])
        # Nothing else was measured: the end has no timing, no lateness and no suspicion.
        file.finish({"status": "finished", "exit_code": OK, "messages": file.counts})
    except BaseException:
        # Remove an incomplete log, as the import can be repeated.
        file.abandon()
        Path(path).unlink(missing_ok=True)
        raise


def facts(episode: Episode) -> dict[str, Json]:
    """Return the summary of an import."""
    dropped = {n: k for n, k in episode.metadata["source"]["dropped"].items() if k}
    return {
        "source": episode.metadata["source"]["file"],
        "seconds": episode.duration_s,
        "samples": {name: len(steps) for name, steps in episode.steps.items()},
        "rate [Hz]": {name: node["rate_hz"] for name, node in episode.metadata["graph"].items()},
        "stamps": episode.metadata["stamps"],
        **({"dropped": dropped} if dropped else {}),
    }


def _order(name: str, node: NodeMapping) -> int:
    return int(name == _COMMANDING) if node.order is None else node.order


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _signals(table: Table, name: str, node: NodeMapping) -> _Signals:
    """Read a node's signals, all of the same length."""
    fields = {field: _field(table, f"{name}.{field}", how) for field, how in node.fields.items()}
    stamps = None if node.stamps is None else table.signal(node.stamps)
    if stamps is not None and stamps.ndim != 1:
        raise UsageError(
            f"stamps {node.stamps!r} in {table.path} have the shape {stamps.shape}, expected (N,)",
            hint=f'choose a column, such as stamps = "{node.stamps}[:,0]"',
        )
    rate_hz = node.rate_hz
    if isinstance(rate_hz, str):
        rate = table.signal(rate_hz)
        if rate.ndim:
            raise UsageError(
                f"rate_hz of node {name!r} is {rate_hz!r}, which has the shape {rate.shape}",
                hint="if the signal has the stamps, write stamps instead of rate_hz",
            )
        rate_hz = positive(float(rate), f"{rate_hz!r} in {table.path}")
    # All signals of a node need one length.
    lengths = {field: len(values) for field, values in fields.items() if values.ndim}
    if stamps is not None:
        lengths[f"stamps {node.stamps!r}"] = len(stamps)
    if not lengths:
        raise UsageError(
            f"node {name!r} gets only constants from {table.path}",
            hint="add the node's stamps, which determine its samples",
        )
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{signal} {length}" for signal, length in lengths.items())
        raise UsageError(
            f"the signals of node {name!r} differ in length: {listed}",
            hint="put signals with other stamps into another node",
        )
    count = next(iter(lengths.values()))
    if not count:
        raise UsageError(f"node {name!r} has no samples in {table.path}", hint="check that the file is complete")
    return _Signals(fields, stamps, count, rate_hz)


def _field(table: Table, where: str, how: FieldMapping) -> np.ndarray:
    """Read a field's signal, unscaled; several sources are stacked along the last axis."""
    parts = [table.signal(source) for source in how.sources]
    for source, part in zip(how.sources, parts, strict=True):
        # Jumps by 2^16 or 2^32 are counts that were read with the wrong sign, whatever their unit.
        for column in part.reshape(len(part), -1).T if part.ndim and how.log_unit == "rad" and not how.turn else ():
            if (modulus := checks.unsigned(column)) is not None:
                raise UsageError(
                    f"{source} in {table.path} jumps by {modulus}: signed counts that were read as unsigned, or counts "
                    f"beyond {modulus.bit_length() - 1} bits",
                    hint="decode them as signed (two's complement, or a sign bit) before the import",
                )
    try:
        values = parts[0] if len(parts) == 1 else np.stack(np.broadcast_arrays(*parts), axis=-1)
    except ValueError:
        shapes = ", ".join(f"{source} {part.shape}" for source, part in zip(how.sources, parts, strict=True))
        raise UsageError(
            f"the sources of field {where} differ in shape: {shapes}", hint="stack signals of one length"
        ) from None
    if not how.turn or not values.ndim:
        return values
    # Count turns over all samples, so that a part of a file has the same turns as the whole.
    return checks.counted(values.reshape(len(values), -1), how.turn).reshape(values.shape)


def _range(table: Table, counts: Mapping[str, int], samples: slice | None) -> tuple[int, int | None]:
    """Return the first sample, and the one after the last; None for the end."""
    if samples is None:
        return 0, None
    if samples.step not in (None, 1):
        raise UsageError(f"a range of samples has no step, got {samples.step}", hint="remove the step")
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
    return first, stop


def _selected(node: NodeMapping, own: _Signals, first: int, stop: int) -> np.ndarray:
    """Return the numbers of the samples from ``first`` to just before ``stop`` that the node's policies select."""
    selected = np.arange(first, stop)
    series = [v for v in (*own.fields.values(), own.stamps) if v is not None and v.ndim]
    if node.missing == "drop":
        good = np.logical_and.reduce([np.isfinite(v[first:stop]).reshape(stop - first, -1).all(axis=1) for v in series])
        selected = selected[good]
    if node.repeated == "first" and own.stamps is not None and len(selected):
        stamps = own.stamps[selected]
        selected = selected[np.concatenate([[True], stamps[1:] != stamps[:-1]])]
    return selected


def _plausible(where: str, node: NodeMapping, own: _Signals, selected: np.ndarray) -> np.ndarray:
    """Return the numbers of the samples with possible positions.

    Raises:
        UsageError: When positions leap away and back and the mapping has no ``implausible = "drop"``, jump at the end
            of a turn without counting, or change faster than a joint can move.
    """
    if own.stamps is None:
        t_s = selected / (own.rate_hz or 1.0)
    else:
        t_s = own.stamps[selected] * (STAMP_UNITS[node.stamp_unit] * 1e-9)
    if len(selected) < 3 or not (np.isfinite(t_s).all() and (np.diff(t_s) > 0).all()):
        return selected  # the check of stamps raises the better error
    for field, how in node.fields.items():
        named = meaning(field)
        if (
            how.log_unit != "rad"
            or named.side == "command"
            or named.quantity != "position"
            or not own.fields[field].ndim
        ):
            continue
        values = own.fields[field][selected].reshape(len(selected), -1)
        angle = values * (np.asarray(how.scale) * in_si(how.unit)[0])
        if not np.isfinite(angle).all():
            continue
        what = f"field {field} of {where}"
        if not how.turn and (over := checks.turns(angle, checks.TURN_RAD)).any():
            raise UsageError(
                f"column {int(over.argmax())} of {what} jumps by 2 pi at the end of a turn",
                hint="turn = 6.283185307179586 (360 for degrees) beside the field's source in the mapping counts them",
            )
        # Drop or refuse samples that leap away and back.
        leapt = checks.glitches(t_s, angle)
        if leapt.any() and node.implausible == "refuse":
            k, i = (int(x[0]) for x in np.nonzero(leapt))
            raise UsageError(
                f"column {i} of {what} reads {angle[k, i]:.4g} rad in sample {selected[k]}: it leaps away and back, "
                f"faster than a joint can, in {int(leapt.any(axis=1).sum())} samples",
                hint='implausible = "drop" in the mapping skips such samples',
            )
        selected, angle, t_s = (x[~leapt.any(axis=1)] for x in (selected, angle, t_s))
        # A jump without return means another zero, another unit or missing samples.
        if (jump := checks.leap(t_s, angle)) is not None:
            raise UsageError(
                f"column {jump[1]} of {what} changes by {jump[2]:.4g} rad before sample {selected[jump[0]]}, within "
                f"{t_s[jump[0]] - t_s[jump[0] - 1]:.3g} s: a joint cannot, so its zero or its unit has changed",
                hint="cut the file there with --samples A:B, or omit this joint",
            )
    return selected


def _align_turns(
    mapping: ImportMapping, outputs: Mapping[str, dict[str, np.ndarray]], ticks: Mapping[str, np.ndarray]
) -> None:
    """Shift commands to the turn of their positions, as turns are counted from the start of each signal."""
    angles = [
        (name, field, how)
        for name, node in mapping.nodes.items()
        for field, how in node.fields.items()
        if how.log_unit in ("rad", "")  # without a unit where a robot has hinges and slides
    ]
    for name, field, how in angles:
        for other, goal, its in angles:
            a, b = outputs[name][field], outputs[other][goal]
            if meaning(field).side == "command" or meaning(goal).side != "command" or not (how.turn or its.turn):
                continue
            if meaning(field).quantity != "position" or a.shape[1:] != b.shape[1:] or min(len(a), len(b)) < 2:
                continue
            q, c = (x.reshape(len(x), -1) for x in (a, b))
            at = np.stack([np.interp(ticks[other], ticks[name], column) for column in q.T], axis=1)
            turned = c - checks.TURN_RAD * np.round(np.median(c - at, axis=0) / checks.TURN_RAD)
            outputs[other][goal] = turned.reshape(b.shape)


def _samples(table: Table, where: str, values: np.ndarray, how: FieldMapping, selected: np.ndarray) -> np.ndarray:
    """Return a field's samples, scaled, shape ``(N, ...)``; a constant is repeated."""
    values = values[selected] if values.ndim else np.broadcast_to(values, selected.shape)
    _check_finite(table, f"field {where}", values, selected)
    dtype = values.dtype if values.dtype.kind == "f" else np.dtype(np.float64)
    # Scale and reshape the samples.
    scale, offset = (np.squeeze(x) if np.size(x) == 1 else np.asarray(x) for x in (how.scale, how.offset))
    for key, numbers in (("scale", scale), ("offset", offset)):
        if numbers.ndim and numbers.shape != values.shape[1:]:
            raise UsageError(
                f"field {where} has {numbers.size} values of {key} for samples of shape {values.shape[1:]}",
                hint="give one number, or one for each column",
            )
    scaled = scale * values.astype(np.float64) + offset
    factor, _ = in_si(how.unit)
    scaled = (scaled if factor == 1.0 else factor * scaled).astype(dtype)
    shape = scaled.shape[1:] if how.shape is None else how.shape
    if shape != (-1,) and np.prod(shape, dtype=int) != np.prod(scaled.shape[1:], dtype=int):
        raise UsageError(
            f"a sample of field {where} has the shape {scaled.shape[1:]} in {table.path}, and {shape} in the mapping",
            hint="correct the shape, or choose columns of the source",
        )
    return np.ascontiguousarray(scaled.reshape(len(scaled), *shape))


def _ticks(table: Table, name: str, node: NodeMapping, own: _Signals, selected: np.ndarray) -> np.ndarray:
    """Return the stamps of samples, shape ``(N,)``, int64 [us]."""
    if own.stamps is None:
        # Use the slots of the timing rules for a node of this rate.
        return np.floor((selected - selected[:1]) * 1e6 / (own.rate_hz or 1.0) + 0.5).astype(np.int64)
    stamps = own.stamps[selected]
    what = f"stamps {node.stamps!r} of node {name!r}"
    hint = f"stamp_unit is {node.stamp_unit!r}; available: {', '.join(STAMP_UNITS)}"
    _check_finite(table, what, stamps, selected)
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
            f"{what} in {table.path} do not increase: sample {selected[k]} at {stamps[k]} {node.stamp_unit}, "
            f"sample {selected[k + 1]} at {stamps[k + 1]} {node.stamp_unit}",
            hint=f"samples must be a microsecond apart at least; {hint}",
        )
    return ticks + round(1e6 * node.stamp_offset)


def _check_finite(table: Table, what: str, values: np.ndarray, selected: np.ndarray) -> None:
    finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not finite.all():
        k = int(np.argmin(finite))
        raise UsageError(
            f"{what} is no finite number in sample {selected[k]} of {table.path}: {values[k]}",
            hint='cut it off with --samples A:B, or write missing = "drop" into the mapping, which skips such samples',
        )


def _steps(ticks: np.ndarray) -> Steps:
    never, zeros = np.full_like(ticks, -1), np.zeros_like(ticks)
    return Steps(scheduled=ticks, start=ticks, woken=ticks, ts_overwrite=never, end=ticks, drift=zeros)


def _rate_hz(ticks: np.ndarray) -> float | None:
    return round(1e6 / float(np.median(np.diff(ticks))), 3) if len(ticks) > 1 else None
