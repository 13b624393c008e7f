"""Metadata of a log's session, and the ages of the messages that its steps used.

A metadata record has a JSON document with a checksum, and its simple values for other viewers.
"""

import dataclasses
import json
import zlib
from collections.abc import Mapping
from os import PathLike

import numpy as np

from sim2real.errors import Sim2RealError
from sim2real.graph.episode import Episode
from sim2real.graph.node import TICKS_PER_S
from sim2real.types import Json

SESSION = "session"
SESSION_END = "session_end"
FORMAT = 1


def encode(name: str, document: Mapping[str, Json]) -> dict[str, str]:
    """Encode a document as the strings of an MCAP metadata record.

    ``json`` is the whole document, and ``crc32`` its checksum, which MCAP lacks for metadata. Top-level strings,
    numbers and booleans are also stored under their names, for other viewers.

    Raises:
        Sim2RealError: A value cannot be written as JSON.
    """
    try:
        text = json.dumps(dict(document), default=_plain)
    except (TypeError, ValueError) as error:
        raise Sim2RealError(
            f"the {name} metadata cannot be written as JSON: {error}",
            hint="use dictionaries with text keys, lists, numbers, texts, arrays, paths and dataclasses",
        ) from error
    plain = {_utf8(k): _utf8(v) for k, v in document.items() if isinstance(v, str | int | float | bool)}
    return {**plain, "format": str(FORMAT), "crc32": f"{zlib.crc32(text.encode()):08x}", "json": text}


def _utf8(value: Json) -> str:
    """Return a text that UTF-8 can encode: names of files may have single surrogates, which MCAP cannot store."""
    return str(value).encode("utf-8", "replace").decode()


def decode(record: Mapping[str, str]) -> dict[str, Json] | None:
    """Return the document of a metadata record; None if it is damaged.

    Raises:
        Sim2RealError: It was written in a newer format.
    """
    # A damaged record has another checksum.
    text = record.get("json")
    if text is None or record.get("crc32") != f"{zlib.crc32(text.encode()):08x}":
        return None
    version = record.get("format", "")
    if version.isdigit() and int(version) > FORMAT:
        raise Sim2RealError(
            f"the log has format {version}; this sim2real reads up to format {FORMAT}", hint="upgrade sim2real"
        )
    try:
        document = json.loads(text)
    except (ValueError, RecursionError):  # a right checksum without JSON: a forged file
        return None
    return document if isinstance(document, dict) else None


def _plain(value: object) -> Json:
    """Convert a value that JSON lacks."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, PathLike):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    raise TypeError(f"{value!r} is a {type(value).__name__}")


def input_ages(episode: Episode, node: str) -> dict[str, np.ndarray]:
    """Return the age of the newest message at each step's start, by input.

    Ages show hiccups that step times do not show: punctual steps that use old messages.

    Returns:
        Input -> ages ``(N,)`` [s]; NaN before the first message. Empty if steps are missing, because the step of a
        message is then unknown.
    """
    log = episode.metadata.get("log", {})
    if log.get("missing_steps", {}).get(node):
        return {}
    first, start = int(log.get("first_seq", {}).get(node, 0)), episode.steps[node].start
    ages = {}
    for (reader, name), messages in episode.messages.items():
        if reader != node:
            continue
        # Find the newest message of each step; a step without a new message uses the previous one.
        row = messages.seq_in - first
        used = (messages.seq_in >= 0) & (row >= 0) & (row < len(start))
        newest = np.full(len(start), -np.inf)
        np.maximum.at(newest, row[used], messages.sent[used])
        newest = np.maximum.accumulate(newest)  # a step without a new message uses the previous one again
        ages[name] = np.where(np.isfinite(newest), (start - newest) / TICKS_PER_S, np.nan)
    return ages


def is_imported(episode: Episode) -> bool:
    """Return whether an episode was imported, so that neither lateness nor computation times were measured."""
    return "stamps" in episode.metadata
