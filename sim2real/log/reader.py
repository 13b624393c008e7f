"""Reads logs, whole or damaged, as episodes with the original names and shapes."""

import json
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from sim2real.errors import Sim2RealError, UsageError
from sim2real.graph.episode import Episode, Messages, Steps
from sim2real.log.cdr import read_text
from sim2real.log.file_contents import Contents, Range, readable_errors, walk
from sim2real.log.schema import MESSAGE_LAYOUT, STEP_LAYOUT, layout_of_fields, units_of_fields
from sim2real.types import Json

# Positions of an event's level, and of its name before alignment [bytes].
_LEVEL_AT, _NAME_AT = 12, 13


class TruncatedLogWarning(UserWarning):
    """The log is incomplete: its session crashed, or a part of the file is unreadable. The rest is read."""


def read_log(path: str | Path, start_s: float | None = None, end_s: float | None = None) -> Episode:
    """Read a log, or a time range of it.

    The readable part of a damaged log is read, with a warning. The episode's metadata has the session's entries and
    ``log``, a dictionary with ``epoch_ns`` (wall clock at time 0), ``session_end`` (None after a crash),
    ``attachments`` (names), ``events`` (each with time_s, level, kind, text), ``first_seq`` (node -> number of its
    first step in the episode, 0 in a whole log), ``missing_steps`` (node -> number of lost steps before the last one)
    and ``skipped`` (descriptions of the unreadable places).

    Args:
        start_s: Read steps that end, and messages that arrive, at this time or later [s from the episode's start];
            default: from the start.
        end_s: Read steps and messages before this time [s from the episode's start]; default: to the end.

    Returns:
        The episode. ``seq_in`` is -1 if the consuming step is not in the episode.

    Raises:
        Sim2RealError: When the file is missing, not an MCAP file, not a log of sim2real, or cut off before the end of
            its session metadata.

    Warns:
        TruncatedLogWarning: When the session has no end, or a part is unreadable.
    """
    if start_s is not None and end_s is not None and not start_s <= end_s:
        raise UsageError(f"the range begins at {start_s} s, after its end at {end_s} s")
    span = Range(start_s, end_s)
    contents = walk(path, span)
    with readable_errors(path):
        steps, outputs, sequences = steps_and_outputs(contents, span)
        messages, events = _connections(contents, span, sequences), _events(contents, span)
        units = output_units(contents)
    # Steps before the first one count as lost, unless the range starts later.
    firsts = {node: int(s[0]) for node, s in sequences.items() if len(s)}
    missing = {
        node: int(s[-1]) + 1 - len(s) - (firsts[node] if start_s else 0) for node, s in sequences.items() if len(s)
    }
    _warn(path, contents, missing)
    # Figures of the log beside the session's metadata.
    log_metadata = {
        "epoch_ns": contents.epoch_ns,
        "session_end": contents.end,
        "attachments": list(contents.attachments),
        "events": events,
        "first_seq": firsts,
        "missing_steps": missing,
        "skipped": contents.damage.skipped,
    }
    return Episode(
        steps=steps,
        messages=messages,
        outputs=outputs,
        metadata={**(contents.session or {}), "log": log_metadata},
        complete=contents.end is not None,
        units=units,
    )


def read_session(path: str | Path) -> dict[str, Json]:
    """Return the session's metadata, without reading steps and messages.

    Raises:
        Sim2RealError: As ``read_log``, and when the metadata is damaged.
    """
    session = walk(path).session
    if session is None:
        raise Sim2RealError(f"the session metadata of {path} is damaged", hint="read_log still reads the data")
    return session


def read_attachment(path: str | Path, name: str) -> bytes:
    """Return the content of a file that was attached to a log.

    Raises:
        Sim2RealError: As ``read_log``, and when there is no such attachment.
    """
    attachments = walk(path).attachments
    if name not in attachments:
        raise Sim2RealError(f"the log {path} has no attachment {name!r}. Available: {', '.join(attachments) or 'none'}")
    return attachments[name]


def summary(path: str | Path) -> dict[str, Json]:
    """Return a summary of a log without decoding messages.

    Returns:
        ``bytes`` (file size), ``chunks`` (their number), ``epoch_ns``, ``duration_s``, ``complete``, ``session`` (None
        if damaged), ``session_end`` (None after a crash), ``attachments`` (name -> size in bytes), ``topics`` (topic ->
        number of messages, according to the chunks' indices) and ``skipped``.

    Raises:
        Sim2RealError: As ``read_log``.
    """
    contents = walk(path)
    return {
        "bytes": Path(path).stat().st_size,
        "chunks": contents.chunks,
        "epoch_ns": contents.epoch_ns,
        "duration_s": max(0, contents.last_log_time - contents.epoch_ns) / 1e9,
        "complete": contents.end is not None,
        "session": contents.session,
        "session_end": contents.end,
        "attachments": {name: len(content) for name, content in contents.attachments.items()},
        "topics": {c.topic: contents.indexed.get(number, 0) for number, c in contents.channels.items()},
        "skipped": contents.damage.skipped,
    }


def output_units(contents: Contents) -> dict[str, dict[str, str]]:
    """Return node -> field -> unit, for the nodes whose channels have units."""
    channels = contents.with_role("output").values()
    by_node = {c.metadata["node"]: units_of_fields(json.loads(c.metadata["fields"])) for c in channels}
    return {node: units for node, units in by_node.items() if units}


def steps_and_outputs(
    contents: Contents, span: Range
) -> tuple[dict[str, Steps], dict[str, dict[str, np.ndarray]], dict[str, np.ndarray]]:
    """Return steps, outputs, and the number of each step, by node."""
    output_channels = {c.metadata["node"]: (n, c) for n, c in contents.with_role("output").items()}
    steps, outputs, sequences = {}, {}, {}
    for number, channel in contents.with_role("step").items():
        node = channel.metadata["node"]
        rows = contents.columns(number, STEP_LAYOUT, span)
        outputs[node] = {}
        if node in output_channels:
            number, channel = output_channels[node]
            described = json.loads(channel.metadata["fields"])
            values = contents.columns(number, layout_of_fields(described), span)
            # Keep complete pairs: a step and its output can be in different chunks, and one chunk can be lost.
            _, in_steps, in_values = np.intersect1d(rows["sequence"], values["sequence"], return_indices=True)
            rows, values = rows[in_steps], values[in_values]
            for entry in described:
                name, shape = entry["original"], (len(rows), *entry["shape"])
                in_payload = name in (values.dtype["data"].names or ())
                outputs[node][name] = (
                    np.ascontiguousarray(values["data"][name]) if in_payload else np.zeros(shape, entry["dtype"])
                )
        # The columns of the step records.
        data = rows["data"]
        steps[node] = Steps(*(np.ascontiguousarray(data[f]) for f in Steps.__dataclass_fields__))
        sequences[node] = np.ascontiguousarray(data["seq"])
    return steps, outputs, sequences


def _connections(
    contents: Contents, span: Range, sequences: Mapping[str, np.ndarray]
) -> dict[tuple[str, str], Messages]:
    """Return the messages of each connection, by (node, input name)."""
    connections = {}
    for number, channel in contents.with_role("input").items():
        node = channel.metadata["node"]
        rows = contents.columns(number, MESSAGE_LAYOUT, span)
        seq_in = rows["data"]["seq_in"]
        in_episode = np.isin(seq_in, sequences.get(node, []))
        # Times are on the wall clock [ns]; convert them to ticks since time 0.
        sent, received = ((rows[f].astype(np.int64) - contents.epoch_ns) // 1000 for f in ("publish_time", "log_time"))
        connections[node, channel.metadata["input"]] = Messages(
            seq_out=np.ascontiguousarray(rows["data"]["seq_out"]),
            seq_in=np.where(in_episode, seq_in, -1),
            sent=sent,
            received=received,
        )
    return connections


def _events(contents: Contents, span: Range) -> list[dict[str, Json]]:
    events = []
    for number in contents.with_role("events"):
        for log_time, payload in contents.payloads(number, span):
            kind, position = read_text(payload, _NAME_AT)
            text, _ = read_text(payload, position)
            time_s = (log_time - contents.epoch_ns) / 1e9
            events.append({"time_s": time_s, "level": payload[_LEVEL_AT], "kind": kind, "text": text})
    return events


def _warn(path: str | Path, contents: Contents, missing: Mapping[str, int]) -> None:
    """Warn of missing parts of the log; the warning points to the caller of ``read_log``."""
    problems = []
    if contents.end is None:
        problems.append("its session has no end: the process that recorded it crashed or still runs")
    if contents.damage.skipped:
        problems.append(f"unreadable: {'; '.join(contents.damage.skipped)}")
    lost = [f"{count} of node {node!r}" for node, count in missing.items() if count]
    if lost:
        problems.append(f"steps are missing: {', '.join(lost)}")
    if problems:
        warnings.warn(f"the log {path} is not whole: {'. '.join(problems)}", TruncatedLogWarning, stacklevel=3)
