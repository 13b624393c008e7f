"""Mapping files (TOML), which assign the signals of another recorder's file to the fields of nodes."""

from __future__ import annotations

import difflib
import math
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from sim2real.errors import UsageError
from sim2real.log.toml_text import toml_key, toml_value
from sim2real.types import Json

STAMP_UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Unit of time stamps -> nanoseconds."""
MAPPING = "import.toml"
"""The mapping file in a pipeline's folder."""
_COMMANDING = "actuator"
_POLICIES = {"missing": ("refuse", "drop"), "repeated": ("refuse", "first"), "implausible": ("refuse", "drop")}
"""Key of a node's policy for unusable samples -> values; the first is the default."""
_HINT = "the guide 'Import' has a mapping file with every key"


@dataclass(frozen=True)
class FieldMapping:
    """The source of a field of a node's output.

    Attributes:
        source: Name of a signal in the file, as for ``ForeignFile.signal``; several signals are stacked.
        unit: Unit of the field, after scaling.
        scale: The field is ``scale * signal + offset``; one number, or one for each column.
        offset: See ``scale`` [the field's unit].
        shape: Shape of one sample; None: as in the file; ``(-1,)``: a vector, of a number one of length 1.
        column: Column of a two-dimensional signal; None: all columns.
        turn: A turn in the signal's unit, to count turns of angles that jump at its end; 0: no counting.
    """

    source: tuple[str, ...]
    unit: str = ""
    scale: float | tuple[float, ...] = 1.0
    offset: float = 0.0
    shape: tuple[int, ...] | None = None
    column: int | None = None
    turn: float = 0.0


@dataclass(frozen=True)
class NodeMapping:
    """The source of a node's messages.

    Attributes:
        fields: Field -> its source.
        rate_hz: Rate of generated time stamps [Hz], or the name of a signal with the rate; None: use ``stamps``.
        stamps: Signal with the recorded time stamps; None: use ``rate_hz``.
        stamp_unit: Unit of the recorded stamps, one of ``STAMP_UNITS``.
        order: Order of messages with equal stamps: those of nodes with a lower number are first.
        missing: Policy for samples that lack a number: ``refuse``, or ``drop`` to skip them.
        repeated: Policy for samples with the stamp of the one before: ``refuse``, or ``first`` to keep the first.
        stamp_offset: Added to the recorded stamps, for a stream with its own clock [s].
        implausible: Policy for samples whose positions leap away and back: ``refuse``, or ``drop``.
    """

    fields: Mapping[str, FieldMapping]
    rate_hz: float | str | None = None
    stamps: str | None = None
    stamp_unit: str = "s"
    order: int = 0
    missing: str = "refuse"
    repeated: str = "refuse"
    stamp_offset: float = 0.0
    implausible: str = "refuse"


@dataclass(frozen=True)
class ImportMapping:
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
        """Node -> field -> unit, for the fields that have one."""
        return {n: {f: m.unit for f, m in node.fields.items() if m.unit} for n, node in self.nodes.items()}

    def of_joints(self) -> ImportMapping:
        """Return the mapping with a vector for each field, as joints have it."""
        nodes = {
            name: replace(n, fields={k: replace(f, shape=f.shape or (-1,)) for k, f in n.fields.items()})
            for name, n in self.nodes.items()
        }
        return replace(self, nodes=nodes)

    def inputs(self, file: Path) -> dict[str, Path]:
        """Return the files that an import reads, by name, for the manifest."""
        return {"source": file} | ({} if self.path is None else {"mapping": self.path})

    @staticmethod
    def from_dict(tables: Mapping[str, Json], pipeline: str | None = None, path: Path | None = None) -> ImportMapping:
        """Return the mapping of a parsed TOML document.

        Args:
            pipeline: Pipeline of the log; default: the document's.

        Raises:
            UsageError: When a key is unknown, missing or of the wrong type.
        """
        where = "the mapping" if path is None else str(path)
        _check_keys(tables, ("pipeline", "nodes"), where)
        # The pipeline of the document must agree with the given one.
        named = _value(tables, "pipeline", str, where)
        if named is None and pipeline is None:
            raise UsageError(f"{where} does not name the pipeline of the log", hint='add pipeline = "NAME"')
        if named is not None and pipeline not in (None, named):
            raise UsageError(
                f"{where} is for pipeline {named!r}, not for {pipeline!r}", hint="name the mapping with --mapping FILE"
            )
        nodes = _value(tables, "nodes", dict, where) or {}
        if not nodes:
            raise UsageError(f"{where} has no nodes", hint="add a table [nodes.NAME] for each node; " + _HINT)
        nodes_by_name = {
            name: _node(name, _table(node, f"{where}: nodes.{name}"), where) for name, node in nodes.items()
        }
        return ImportMapping(str(named or pipeline), nodes_by_name, path)


def load_mapping(path: str | Path | None, pipeline: str | None = None, package: str | None = None) -> ImportMapping:
    """Read a mapping file.

    Args:
        path: The file; None: the one in the pipeline's package.
        pipeline: Pipeline of the log; default: the file's.
        package: Name of the pipeline's package, which must be imported.

    Raises:
        UsageError: When the file does not exist, is not TOML, or is no valid mapping.
    """
    if path is None and package is not None:
        path = Path(str(sys.modules[package].__file__)).with_name(MAPPING)
    if path is None:
        raise UsageError(
            "there is no mapping of the file's signals",
            hint="name the robot with --pipeline NAME, or a --mapping FILE.toml",
        )
    # Read the document, with errors that name the file.
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"there is no mapping file {path}", hint=f"write one, or name another; {_HINT}") from None
    except OSError as error:
        raise UsageError(f"the mapping file {path} cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise UsageError(f"{path} is no TOML: {error}", hint=_HINT) from None
    return ImportMapping.from_dict(tables, pipeline, path)


def _node(name: str, table: Mapping[str, Json], document: str) -> NodeMapping:
    where = f"{document}: nodes.{name}"
    keys = ("fields", "rate_hz", "stamps", "stamp_unit", "order", *_POLICIES, "stamp_offset")
    _check_keys(table, keys, where)
    fields = _value(table, "fields", dict, where) or {}
    if not fields:
        raise UsageError(f"{where} has no fields", hint=f'add fields.NAME = {{ source = "..." }}; {_HINT}')
    rate_hz = _value(table, "rate_hz", (int, float, str), where)
    stamps = _value(table, "stamps", str, where)
    if (rate_hz is None) == (stamps is None):
        raise UsageError(
            f"{where} needs either 'stamps' or 'rate_hz'" + (", not both" if stamps is not None else ""),
            hint="stamps keeps the recorded stamps; rate_hz generates stamps, and marks them as generated",
        )
    if isinstance(rate_hz, int | float):
        rate_hz = positive(float(rate_hz), f"{where}: rate_hz")
    unit = _value(table, "stamp_unit", str, where) or "s"
    if unit not in STAMP_UNITS:
        raise UsageError(f"{where}: unknown stamp_unit {unit!r}. Available: {', '.join(STAMP_UNITS)}", hint=_HINT)
    policies = {}
    for key, available in _POLICIES.items():
        policies[key] = _value(table, key, str, where) or "refuse"
        if policies[key] not in available:
            raise UsageError(f"{where}: unknown {key} {policies[key]!r}. Available: {', '.join(available)}", hint=_HINT)
    late_s = float(_value(table, "stamp_offset", (int, float), where) or 0.0)
    if not math.isfinite(late_s) or (late_s and stamps is None):
        raise UsageError(f"{where}: stamp_offset is a finite number [s], added to recorded stamps", hint=_HINT)
    # Commands come after samples with the same stamp, as they were computed from them.
    order = _value(table, "order", int, where)
    return NodeMapping(
        fields={f: _field(_table(v, f"{where}.fields.{f}"), f"{where}.fields.{f}") for f, v in fields.items()},
        rate_hz=rate_hz,
        stamps=stamps,
        stamp_unit=unit,
        order=int(name == _COMMANDING) if order is None else order,
        stamp_offset=late_s,
        **policies,
    )


def positive(value: float, where: str) -> float:
    """Return ``value``, after checking that it is a finite number above 0.

    Raises:
        UsageError: When it is not; the message names the place ``where``.
    """
    if not 0.0 < value < math.inf:
        raise UsageError(f"{where} must be above 0, got {value}", hint="it is in samples per second")
    return value


def _field(table: Mapping[str, Json], where: str) -> FieldMapping:
    # Read the sources.
    _check_keys(table, ("source", "unit", "scale", "offset", "shape", "column", "turn"), where)
    source = _value(table, "source", (str, list), where)
    sources = [source] if isinstance(source, str) else source or []
    if not sources or not all(isinstance(s, str) and s for s in sources):
        raise UsageError(f"{where} needs a source: the name of a signal, or a list of names", hint=_HINT)
    # Check the numbers of scale, offset, turn and shape.
    scale, offset = _value(table, "scale", (int, float, list), where), _value(table, "offset", (int, float), where)
    scales = scale if isinstance(scale, list) else [1.0 if scale is None else scale]
    for key, numbers in (("scale", scales), ("offset", [offset or 0.0])):
        if not numbers or not all(type(n) in (int, float) and math.isfinite(n) for n in numbers):
            raise UsageError(
                f"{where}: {key} must be a finite number, got {scale if key == 'scale' else offset}", hint=_HINT
            )
    turn = float(_value(table, "turn", (int, float), where) or 0.0)
    if not 0.0 <= turn < math.inf:
        raise UsageError(f"{where}: turn must be above 0, such as 360 for degrees, got {turn}", hint=_HINT)
    shape = _value(table, "shape", list, where)
    if shape not in (None, [-1]) and not all(type(n) is int and n > 0 for n in shape):
        raise UsageError(
            f"{where}: shape must be a list of whole numbers above 0, or [-1] for a vector, got {shape}", hint=_HINT
        )
    unit = _value(table, "unit", str, where) or ""
    if not unit.isprintable():
        raise UsageError(f"{where}: a unit stands on one line, got {unit!r}", hint=_HINT)
    return FieldMapping(
        source=tuple(sources),
        unit=unit,
        scale=tuple(map(float, scales)) if isinstance(scale, list) else float(scales[0]),
        offset=float(offset or 0.0),
        shape=None if shape is None else tuple(shape),
        column=_value(table, "column", int, where),
        turn=turn,
    )


def _table(value: object, where: str) -> Mapping[str, Json]:
    if not isinstance(value, Mapping):
        raise UsageError(f"{where} must be a table, got {value!r}", hint=_HINT)
    return value


def _value(table: Mapping[str, Json], key: str, kind: type | tuple[type, ...], where: str) -> Json:
    """Return a key's value, after checking its type; None if there is no such key."""
    value = table.get(key)
    # A boolean counts as an int in Python.
    if value is not None and (not isinstance(value, kind) or isinstance(value, bool)):
        raise UsageError(f"{where}: {key} has the wrong kind: {value!r}", hint=_HINT)
    return value


def _check_keys(table: Mapping[str, Json], keys: tuple[str, ...], where: str) -> None:
    for key in table:
        if key not in keys:
            close = difflib.get_close_matches(key, keys, n=1)
            raise UsageError(
                f"{where} has an unknown key {key!r}. Available: {', '.join(keys)}",
                hint=f"did you mean {close[0]}?" if close else _HINT,
            )


def _printable(text: str) -> list[str]:
    """Return the lines of a comment without characters that TOML refuses."""
    return ["".join(c if c.isprintable() else "?" for c in line) for line in text.splitlines() or [""]]


def to_toml(mapping: ImportMapping, comments: Sequence[str] = ()) -> str:
    """Return a mapping as the text of a mapping file."""
    lines = [
        *(f"# {part}" for line in comments for part in _printable(line)),
        f"pipeline = {toml_value(mapping.pipeline)}",
    ]
    # Write only the keys that differ from their defaults.
    for name, node in mapping.nodes.items():
        keys: dict[str, Json] = {"stamps": node.stamps} if node.stamps is not None else {"rate_hz": node.rate_hz}
        keys |= {"stamp_unit": node.stamp_unit} if node.stamps is not None and node.stamp_unit != "s" else {}
        keys |= {"order": node.order} if node.order != int(name == _COMMANDING) else {}
        keys |= {k: v for k in _POLICIES if (v := getattr(node, k)) != "refuse"}
        keys |= {"stamp_offset": node.stamp_offset} if node.stamp_offset else {}
        lines += ["", f"[nodes.{toml_key(name)}]", *(f"{key} = {toml_value(value)}" for key, value in keys.items())]
        for field, how in node.fields.items():
            parts: dict[str, Json] = {"source": how.source[0] if len(how.source) == 1 else list(how.source)}
            parts |= {"unit": how.unit} if how.unit else {}
            parts |= {
                k: v for k, plain in (("scale", 1.0), ("offset", 0.0), ("turn", 0.0)) if (v := getattr(how, k)) != plain
            }
            parts |= {k: v for k in ("shape", "column") if (v := getattr(how, k)) is not None}
            inside = ", ".join(f"{key} = {toml_value(value)}" for key, value in parts.items())
            lines.append(f"fields.{toml_key(field)} = {{ {inside} }}")
    return "\n".join(lines) + "\n"
