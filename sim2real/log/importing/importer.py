"""Imports files of other recorders: converts their signals to steps and outputs of nodes, and writes a log."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from sim2real.errors import OK, UsageError
from sim2real.graph.episode import Episode, StepRecord, Steps
from sim2real.installation import version
from sim2real.log.importing import plausibility
from sim2real.log.importing.files.foreign import ForeignFile, open_foreign
from sim2real.log.importing.mapping import STAMP_UNITS, FieldMapping, ImportMapping, NodeMapping, load_mapping, positive
from sim2real.log.importing.sample_selection import align_turns, plausible_samples, selected_samples
from sim2real.log.writer import SessionFile
from sim2real.types import Json

RECORDED, GENERATED = "recorded", "generated"
_MAX_TICKS = 2**53  # 285 years [us]: whole numbers up to here are exact in float64
# Stamps from here on [us since 1970: September 2001] come from a wall clock; clocks that start at boot are far lower.
_WALL_CLOCK = 10**15
# With a first stamp up to here [us], stamps count from the recording's start; otherwise time 0 is the first sample.
_OWN_START = 1_000_000


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
    path: str | Path,
    mapping: ImportMapping | str | Path,
    samples: slice | None = None,
    format: str | None = None,
    episode: int | None = None,
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
        format: ``npz``, ``json``, ``csv``, ``lerobot`` or ``mcap``; default: from the file's suffix.
        episode: Number of the episode of a LeRobot data set; default: the only one.

    Raises:
        UsageError: When the file or the mapping cannot be read, they do not fit each other, the signals of a node
            differ in length, a sample is not finite, or stamps do not increase.
    """
    selected_mapping = mapping if isinstance(mapping, ImportMapping) else load_mapping(mapping)
    return import_opened(open_foreign(Path(path), format, episode), selected_mapping, samples)


def import_opened(file: ForeignFile, mapping: ImportMapping, samples: slice | None = None) -> Episode:
    """Read an open file as an episode; see ``import_file``.

    Args:
        file: The file, or several that were joined.
        samples: Range of samples; default: all.
    """
    # Read all signals, and select the samples of each node.
    signals = {name: _signals(file, name, node) for name, node in mapping.nodes.items()}
    first, stop = _range(file, {name: s.count for name, s in signals.items()}, samples)
    ticks, outputs, stamps, dropped = {}, {}, {}, {}
    for name, node in mapping.nodes.items():
        node_signals, last = signals[name], signals[name].count if stop is None else stop
        selected = selected_samples(node, node_signals.fields, node_signals.stamps, first, last)
        selected = plausible_samples(
            f"node {name} in {file.path}", node, node_signals.fields, _seconds(node, node_signals, selected), selected
        )
        outputs[name] = {
            field: _samples(file, f"{name}.{field}", node_signals.fields[field], how, selected)
            for field, how in node.fields.items()
        }
        ticks[name] = _ticks(file, name, node, node_signals, selected)
        stamps[name] = GENERATED if node_signals.stamps is None or node.stamps in file.nominal else RECORDED
        dropped[name] = last - first - len(selected)
    # Move time 0 to the file's zero or the first sample.
    align_turns(mapping, outputs, ticks)
    from_file = [name for name, node_signals in signals.items() if node_signals.stamps is not None]
    zero = _time_zero([ticks[name] for name in from_file], first)
    for name in from_file:
        ticks[name] -= zero
    source = {
        "file": file.path.name,
        "format": file.format,
        "sha256": _sha256(file.path),
        **({"beside": {p.name: _sha256(p) for p in file.beside}} if file.beside else {}),
        **({"notes": list(file.notes)} if file.notes else {}),
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
            "mapping": {name: asdict(node) for name, node in mapping.nodes.items()},
            "versions": {"sim2real": version()},
        },
        units=mapping.units,
    )


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


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
        order = np.repeat([mapping.nodes[n].order for n in names], counts)
        ticks = np.concatenate([episode.steps[n].start for n in names])
        for row in np.lexsort((node, order, ticks)).tolist():
            name, k, tick = names[node[row]], int(seq[row]), int(ticks[row])
            record = StepRecord(name, k, tick, tick, tick, -1, tick, 0)
            file.step(record, [values[k] for values in episode.outputs[name].values()])
        file.finish({"status": "finished", "exit_code": OK, "messages": file.counts})
    except BaseException:
        # Remove an incomplete log, as the import can be repeated.
        file.abandon()
        Path(path).unlink(missing_ok=True)
        raise


def facts(episode: Episode) -> dict[str, Json]:
    """Return the summary of an import."""
    kinds = episode.metadata["stamps"]
    return {
        "source": episode.metadata["source"]["file"],
        "seconds": episode.duration_s,
        "samples": {name: len(steps) for name, steps in episode.steps.items()},
        "rate [Hz]": {name: node["rate_hz"] for name, node in episode.metadata["graph"].items()},
        "stamps": kinds,
        **(
            {"dropped": dropped}
            if (dropped := {n: k for n, k in episode.metadata["source"]["dropped"].items() if k})
            else {}
        ),
    }


def _signals(file: ForeignFile, name: str, node: NodeMapping) -> _Signals:
    """Read a node's signals, all of the same length."""
    # Read the fields, the stamps and the rate.
    fields = {field: _field(file, f"{name}.{field}", how) for field, how in node.fields.items()}
    stamps = None if node.stamps is None else file.signal(node.stamps)
    if stamps is not None and stamps.ndim != 1:
        raise UsageError(
            f"stamps {node.stamps!r} in {file.path} have the shape {stamps.shape}, expected (N,)",
            hint=f'choose a column, such as stamps = "{node.stamps}[:,0]"',
        )
    rate_hz = node.rate_hz
    if isinstance(rate_hz, str):
        rate = file.signal(rate_hz)
        if rate.ndim:
            raise UsageError(
                f"rate_hz of node {name!r} is {rate_hz!r}, which has the shape {rate.shape}",
                hint="if the signal has the stamps, write stamps instead of rate_hz",
            )
        rate_hz = positive(float(rate), f"{rate_hz!r} in {file.path}")
    # All signals of a node need one length.
    lengths = {field: len(values) for field, values in fields.items() if values.ndim}
    if stamps is not None:
        lengths[f"stamps {node.stamps!r}"] = len(stamps)
    if not lengths:
        raise UsageError(
            f"node {name!r} gets only constants from {file.path}",
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
        raise UsageError(f"node {name!r} has no samples in {file.path}", hint="check that the file is complete")
    return _Signals(fields, stamps, count, rate_hz)


def _field(file: ForeignFile, where: str, how: FieldMapping) -> np.ndarray:
    """Read a field's signal, unscaled; several sources are stacked along the last axis."""
    parts = [file.signal(source, how.column) for source in how.source]
    try:
        values = parts[0] if len(parts) == 1 else np.stack(np.broadcast_arrays(*parts), axis=-1)
    except ValueError:
        shapes = ", ".join(f"{source} {part.shape}" for source, part in zip(how.source, parts, strict=True))
        raise UsageError(
            f"the sources of field {where} differ in shape: {shapes}", hint="stack signals of one length"
        ) from None
    if not how.turn or not values.ndim:
        return values
    # Count turns over all samples, so that a part of a file has the same turns as the whole.
    return plausibility.counted(values.reshape(len(values), -1), how.turn).reshape(values.shape)


def _range(file: ForeignFile, counts: Mapping[str, int], samples: slice | None) -> tuple[int, int | None]:
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
        raise UsageError(f"samples {text} are not in {file.path}: it has {count}", hint=f"choose from 0:{count}")
    return first, stop


def _seconds(node: NodeMapping, signals: _Signals, selected: np.ndarray) -> np.ndarray:
    """Return the stamps of samples, recorded or generated [s]."""
    if signals.stamps is None:
        return selected / (signals.rate_hz or 1.0)
    return signals.stamps[selected] * (STAMP_UNITS[node.stamp_unit] * 1e-9)


def _samples(file: ForeignFile, where: str, values: np.ndarray, how: FieldMapping, selected: np.ndarray) -> np.ndarray:
    """Return a field's samples, scaled, shape ``(N, ...)``; a constant is repeated."""
    values = values[selected] if values.ndim else np.broadcast_to(values, selected.shape)
    _check_finite(file, f"field {where}", values, selected)
    dtype = values.dtype if values.dtype.kind == "f" else np.dtype(np.float64)
    # Scale and reshape the samples.
    scale = np.asarray(how.scale)
    if scale.ndim and scale.shape != values.shape[1:]:
        raise UsageError(
            f"field {where} has {scale.size} scales for samples of shape {values.shape[1:]}",
            hint="give one number, or one for each column",
        )
    scaled = (scale * values.astype(np.float64) + how.offset).astype(dtype)
    shape = scaled.shape[1:] if how.shape is None else how.shape
    if shape != (-1,) and np.prod(shape, dtype=int) != np.prod(scaled.shape[1:], dtype=int):
        raise UsageError(
            f"a sample of field {where} has the shape {scaled.shape[1:]} in {file.path}, and {shape} in the mapping",
            hint="correct the shape, or choose columns of the source",
        )
    return np.ascontiguousarray(scaled.reshape(len(scaled), *shape))


def _ticks(file: ForeignFile, name: str, node: NodeMapping, signals: _Signals, selected: np.ndarray) -> np.ndarray:
    """Return the stamps of samples, shape ``(N,)``, int64 [us]."""
    if signals.stamps is None:
        # Use the slots of the timing rules for a node of this rate.
        return np.floor((selected - selected[:1]) * 1e6 / (signals.rate_hz or 1.0) + 0.5).astype(np.int64)
    stamps = signals.stamps[selected]
    what = f"stamps {node.stamps!r} of node {name!r}"
    hint = f"stamp_unit is {node.stamp_unit!r}; available: {', '.join(STAMP_UNITS)}"
    _check_finite(file, what, stamps, selected)
    nanoseconds = STAMP_UNITS[node.stamp_unit]
    if np.abs(stamps * (nanoseconds / 1000)).max() >= _MAX_TICKS:
        raise UsageError(f"{what} in {file.path} are centuries away: {stamps[0]} {node.stamp_unit}", hint=hint)
    if stamps.dtype.kind == "i":
        ticks = (stamps + 500) // 1000 if nanoseconds < 1000 else stamps * (nanoseconds // 1000)
    else:
        ticks = np.rint(stamps.astype(np.float64) * (nanoseconds / 1000)).astype(np.int64)
    if (wrong := np.flatnonzero(np.diff(ticks) <= 0)).size:
        k = int(wrong[0])
        raise UsageError(
            f"{what} in {file.path} do not increase: sample {selected[k]} at {stamps[k]} {node.stamp_unit}, "
            f"sample {selected[k + 1]} at {stamps[k + 1]} {node.stamp_unit}",
            hint=f"samples must be a microsecond apart at least; {hint}",
        )
    return ticks + round(1e6 * node.stamp_offset)


def _check_finite(file: ForeignFile, what: str, values: np.ndarray, selected: np.ndarray) -> None:
    finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not finite.all():
        k = int(np.argmin(finite))
        raise UsageError(
            f"{what} is no finite number in sample {selected[k]} of {file.path}: {values[k]}",
            hint='cut it off with --samples A:B, or write missing = "drop" into the mapping, which skips such samples',
        )


def _time_zero(ticks: list[np.ndarray], first: int) -> int:
    """Return the file's time stamp at the episode's time 0 [us]."""
    begin = min((int(t[0]) for t in ticks), default=0)
    return 0 if 0 <= begin <= _OWN_START and not first else begin


def _steps(ticks: np.ndarray) -> Steps:
    never, zeros = np.full_like(ticks, -1), np.zeros_like(ticks)
    return Steps(scheduled=ticks, start=ticks, woken=ticks, ts_overwrite=never, end=ticks, drift=zeros)


def _rate_hz(ticks: np.ndarray) -> float | None:
    return round(1e6 / float(np.median(np.diff(ticks))), 3) if len(ticks) > 1 else None
