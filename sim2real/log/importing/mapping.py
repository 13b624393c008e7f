"""The mapping of another recorder's file to a log, which has the source of each field; stored as ``import.toml``."""

from __future__ import annotations

import difflib
import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

from sim2real.errors import UsageError
from sim2real.types import Json

STAMP_UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Unit of time stamps -> nanoseconds."""
MAPPING = "import.toml"
"""Name of the mapping file in a pipeline's folder."""
Key = tuple[str, str, str]
"""A line of a mapping file: node, field (or empty), and key."""
_SI = {
    "deg": (math.pi / 180, "rad"),
    "rev": (2 * math.pi, "rad"),
    "mrad": (1e-3, "rad"),
    "mdeg": (math.pi / 180_000, "rad"),
    "cdeg": (math.pi / 18_000, "rad"),
    "mm": (1e-3, "m"),
}
LENGTHS_AND_ANGLES = ("rad", "m", *_SI)
_OPEN_QUESTION = re.compile(r"^#\s*([a-z_]+) = .*\?", re.MULTILINE)
_HINT = "the guide 'Import' has a mapping file with every key"


def in_si(unit: str) -> tuple[float, str]:
    """Return the factor to SI units, and the SI unit, of degrees, turns, mrad, mm and ``counts:N``, also per second.

    ``counts:4096`` are counts of an encoder with 4096 counts per turn. Other units stay as they are.
    """
    base, per, time = unit.partition("/")
    factor, si = _SI.get(base, (1.0, base))
    if match := re.fullmatch(r"counts:([1-9][0-9]*)", base):
        factor, si = 2 * math.pi / int(match[1]), "rad"
    return factor, f"{si}{per}{time}"


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A table of a mapping file; unknown keys are errors."""


class FieldMapping(_Table, frozen=True):
    """The source of a field of a node's output.

    Attributes:
        source: Name of a signal in the file, or a list of names, whose columns are joined to a vector; ``q[:,0]`` is a
            column of an array.
        unit: Unit of the field after scaling; degrees, turns and counts are converted to radians, mm to m.
        scale: The field is ``scale * signal + offset``; one number, or one for each column.
        offset: See ``scale`` [the field's unit]; one number, or one for each column.
    """

    source: str | tuple[str, ...]
    unit: str = ""
    scale: float | tuple[float, ...] = 1.0
    offset: float | tuple[float, ...] = 0.0

    def __post_init__(self) -> None:
        if not self.sources or not all(self.sources):
            raise ValueError("a field needs a source: the name of a signal, or a list of names")
        for key in ("scale", "offset"):
            value = getattr(self, key)
            numbers = value if isinstance(value, tuple) else (value,)
            if not numbers or not all(map(math.isfinite, numbers)):
                raise ValueError(f"{key} must be a finite number, or a list of them, got {value}")
        if not self.unit.isprintable():
            raise ValueError(f"a unit stands on one line, got {self.unit!r}")

    @property
    def sources(self) -> tuple[str, ...]:
        """The names of the signals."""
        return (self.source,) if isinstance(self.source, str) else self.source

    @property
    def log_unit(self) -> str:
        """Unit of the field in the log."""
        return in_si(self.unit)[1]


class NodeMapping(_Table, frozen=True):
    """The source of a node's messages.

    Attributes:
        fields: Field -> its source.
        rate_hz: Rate of generated time stamps [Hz]; None: use ``stamps``.
        stamps: Signal with the recorded time stamps; None: use ``rate_hz``.
        stamp_unit: Unit of the recorded stamps.
        stamp_offset: Time that is added to the recorded stamps, if a stream has its own clock [s].
    """

    fields: Mapping[str, FieldMapping]
    rate_hz: float | None = None
    stamps: str | None = None
    stamp_unit: Literal["s", "ms", "us", "ns"] = "s"
    stamp_offset: float = 0.0

    def __post_init__(self) -> None:
        if not self.fields:
            raise ValueError("a node has fields: fields.NAME = { source = ... }")
        if (self.rate_hz is None) == (self.stamps is None):
            raise ValueError("a node has either 'stamps', which are recorded, or 'rate_hz', which generates them")
        if self.rate_hz is not None and not 0.0 < self.rate_hz < math.inf:
            raise ValueError(f"rate_hz must be above 0, in samples per second, got {self.rate_hz}")
        if not math.isfinite(self.stamp_offset) or (self.stamp_offset and self.stamps is None):
            raise ValueError("stamp_offset is a finite number [s], added to recorded stamps")


class ImportMapping(_Table, frozen=True):
    """The mapping of another recorder's file to a log.

    Attributes:
        pipeline: Pipeline of the log.
        nodes: Node -> source of its messages.
        path: The mapping file; None if the mapping comes from elsewhere.
    """

    pipeline: str
    nodes: Mapping[str, NodeMapping]
    path: Path | None = None

    @property
    def units(self) -> dict[str, dict[str, str]]:
        """Node -> field -> unit in the log, for the fields that have one."""
        return {n: {f: m.log_unit for f, m in node.fields.items() if m.unit} for n, node in self.nodes.items()}

    @staticmethod
    def from_dict(tables: Mapping[str, Json], pipeline: str | None = None, path: Path | None = None) -> ImportMapping:
        """Return the mapping of a parsed TOML document.

        Args:
            pipeline: Pipeline of the log; default: the document's.

        Raises:
            UsageError: A key is unknown or missing, or its value has the wrong type.
        """
        where = "the mapping" if path is None else str(path)
        document = _convert(tables, _Document, where)
        name = document.pipeline or pipeline
        if name is None:
            raise UsageError(f"{where} does not name the pipeline of the log", hint='add pipeline = "NAME"')
        if pipeline not in (None, name):
            raise UsageError(f"{where} is for pipeline {name!r}, not for {pipeline!r}", hint="--mapping FILE names it")
        if not document.nodes:
            raise UsageError(f"{where} has no nodes", hint="add a table [nodes.NAME] for each node; " + _HINT)
        # Convert table by table, so that an error can name node and field.
        nodes = {}
        for node, table in document.nodes.items():
            at, fields = f"{where}: nodes.{node}", table.get("fields")
            if isinstance(fields, dict):
                fields = {f: _convert(how, FieldMapping, f"{at}.fields.{f}") for f, how in fields.items()}
            nodes[node] = _convert({**table, "fields": fields or {}}, NodeMapping, at)
        return ImportMapping(name, nodes, path)


class _Document(_Table, frozen=True):
    pipeline: str | None = None
    nodes: dict[str, dict[str, Json]] = {}


def load_mapping(path: str | Path, pipeline: str | None = None) -> ImportMapping:
    """Read a mapping file.

    Args:
        pipeline: Pipeline of the log; default: the file's.

    Raises:
        UsageError: The file does not exist, is no TOML or no valid mapping, or has an open question.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        tables = tomllib.loads(text)
    except FileNotFoundError:
        raise UsageError(f"there is no mapping file {path}", hint=f"write one, or name another; {_HINT}") from None
    except OSError as error:
        raise UsageError(f"the mapping file {path} cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{path} is no TOML: {error}", hint=_HINT) from None
    if question := _OPEN_QUESTION.search(text):
        line = text.count("\n", 0, question.start()) + 1
        raise UsageError(
            f"{path} has an open question in line {line}: {question[0].lstrip('# ')}",
            hint=f"replace the line by the answer, such as {question[1]} = ...",
        )
    return ImportMapping.from_dict(tables, pipeline, path)


def _convert(table: object, kind: type, where: str) -> Any:
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        text, hint = str(error), _HINT
        if match := re.search(r"unknown field `(\w+)`", text):
            keys = list(kind.__struct_fields__)
            close = difflib.get_close_matches(match[1], keys, n=1)
            text, hint = f"{text}. Available: {', '.join(keys)}", f"did you mean {close[0]}?" if close else _HINT
        raise UsageError(f"{where}: {text}", hint=hint) from None


def to_toml(
    mapping: ImportMapping,
    comments: Sequence[str] = (),
    reasons: Mapping[Key, str] | None = None,
    questions: Mapping[Key, str] | None = None,
) -> str:
    """Return a mapping as the text of a mapping file.

    Args:
        comments: Lines at the beginning.
        reasons: Line -> evidence, which becomes a comment.
        questions: Line -> question, which replaces the line.
    """
    reasons, questions = reasons or {}, questions or {}
    lines = [f"# {part}" for line in comments for part in _printable(line) or [""]]
    lines.append(f"pipeline = {toml_value(mapping.pipeline)}")

    def write(head: str, node: str, field: str, table: Mapping[str, Json]) -> None:
        lines.extend(["", head])
        for key in dict.fromkeys([*table, *(k for n, f, k in questions if (n, f) == (node, field))]):
            at = node, field, key
            if at in questions:
                lines.append(f"# {key} = {' '.join(_printable(questions[at]))}")
            else:
                reason = f"  # {' '.join(_printable(reasons[at]))}" if at in reasons else ""
                lines.append(f"{key} = {toml_value(table[key])}{reason}")

    for name, node in mapping.nodes.items():
        own = {k: v for k, v in msgspec.to_builtins(node).items() if k != "fields"}
        write(f"[nodes.{toml_key(name)}]", name, "", own)
        for field, how in node.fields.items():
            write(f"[nodes.{toml_key(name)}.fields.{toml_key(field)}]", name, field, msgspec.to_builtins(how))
    return "\n".join(lines) + "\n"


def toml_value(value: object) -> str:
    """Return a text, a number, a boolean or a list of them in TOML.

    Raises:
        UsageError: The value has another type, or a text is not valid Unicode, as names of files may be.
    """
    match value:
        case str():
            try:
                value.encode()
            except UnicodeEncodeError:
                raise UsageError(
                    f"{value!r} cannot be written: it has bytes that are no text", hint="rename the file or joint"
                ) from None
            # TOML has the escapes of JSON, and also escapes DEL.
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case bool():
            return str(value).lower()
        case int() | float():
            return repr(value)  # nan, inf and -inf are TOML's
        case list() | tuple():
            return f"[{', '.join(map(toml_value, value))}]"
    raise UsageError(f"{value!r} has no form in TOML")


def toml_key(key: str) -> str:
    """Return a part of a key, quoted if TOML requires it."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def _printable(text: str) -> list[str]:
    """Return the lines of a comment without characters that TOML refuses."""
    return ["".join(c if c.isprintable() else "?" for c in line) for line in text.splitlines()]
