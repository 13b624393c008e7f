"""The session's metadata records: one JSON document each, with a checksum, and its plain values beside it."""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np

from sim2real.errors import Sim2RealError

SESSION = "session"
SESSION_END = "session_end"
FORMAT = 1


def encode(name: str, document: Mapping[str, Any]) -> dict[str, str]:
    """Return an MCAP metadata record's strings for a document.

    ``json`` holds all of it; ``crc32`` guards that, because MCAP has no checksum over metadata; every top-level text,
    number and truth value also stands under its own name, for other viewers.

    Raises:
        Sim2RealError: When a value cannot be written as JSON.
    """
    try:
        text = json.dumps(dict(document), default=_plain)
    except (TypeError, ValueError) as error:
        raise Sim2RealError(
            f"the {name} metadata cannot be written as JSON: {error}",
            hint="use dictionaries with text keys, lists, numbers, texts, arrays, paths and dataclasses",
        ) from error
    plain = {str(k): str(v) for k, v in document.items() if isinstance(v, str | int | float | bool)}
    return {**plain, "format": str(FORMAT), "crc32": f"{zlib.crc32(text.encode()):08x}", "json": text}


def decode(record: Mapping[str, str]) -> dict[str, Any] | None:
    """Return the document of a metadata record, or None where it is damaged.

    Raises:
        Sim2RealError: When a newer version wrote it.
    """
    text = record.get("json")
    if text is None or record.get("crc32") != f"{zlib.crc32(text.encode()):08x}":
        return None
    version = record.get("format", "")
    if version.isdigit() and int(version) > FORMAT:
        raise Sim2RealError(
            f"the log has format {version}; this sim2real reads up to format {FORMAT}", hint="upgrade sim2real"
        )
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):  # a checksum guards against accidents, not against intent
        return None
    return found if isinstance(found, dict) else None


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, PathLike):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    raise TypeError(f"{value!r} is a {type(value).__name__}")
