"""Explicit attributes of elements, in MJCF's spelling: an ``MjSpec`` holds values, but not which are defaults."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from xml.etree import ElementTree
from xml.sax.saxutils import unescape

import numpy as np

from sim2real.composer.models.mjcf import schema, translate
from sim2real.composer.models.mjcf.translate import mj

if TYPE_CHECKING:
    from sim2real.composer.types import Native, Value

_ATTRIBUTES = r"""(?:\s+[\w:.-]+\s*=\s*(?:"[^"]*"|'[^']*'))*"""
_TAG = re.compile(rf"<!--.*?-->|<([A-Za-z]\w*)({_ATTRIBUTES})|\n", re.DOTALL)
_PAIR = re.compile(r"""([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_QUOTES = {"&quot;": '"', "&apos;": "'"}
_SENSORS = {kind: name.removeprefix("mjSENS_").lower() for name, kind in mj.mjtSensor.__members__.items()}
_EQUALITIES = {kind: name.removeprefix("mjEQ_").lower() for name, kind in mj.mjtEq.__members__.items()}


@dataclass(slots=True)
class ExplicitValues:
    """The tag of an element, and the attributes that were given to it: name -> value, as it was written."""

    tag: str
    values: dict[str, Value] = field(default_factory=dict)

    def note(self, name: str, value: Value) -> None:
        """Note that an attribute was set; None takes it back."""
        if value is None:
            self.values.pop(name, None)
        else:
            self.values[name] = value


@dataclass
class PathPart:
    """A part of a tendon's path.

    Attributes:
        tag: ``joint``, ``site``, ``geom`` or ``pulley``.
        values: Attribute in MJCF -> element, the name of a missing element, or number.
        written: Attribute -> the name that the ``MjSpec`` has.
    """

    tag: str
    values: dict[str, Value]
    written: dict[str, str]

    def is_outdated(self, model: Value) -> bool:
        """Return whether the ``MjSpec`` has other names than those by which the model's own elements are called now."""
        named = [(self.values[key], text) for key, text in self.written.items()]
        return any(e.root is not model or e.is_removed or e._native.name != text for e, text in named)


class Document:
    """The text of a model; the tags and attributes of its elements are read on first use.

    Args:
        text: MJCF with at most one element on a line.

    Attributes:
        says_angle: Whether it sets the unit of angles.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self.says_angle = re.search(r"<compiler[^>]*\sangle\s*=", text) is not None

    @functools.cached_property
    def lines(self) -> dict[int, ExplicitValues]:
        """Number of a line, from 1 -> record of the element that begins there."""
        records, line = {}, 1
        for match in _TAG.finditer(self._text):
            if match[1]:
                pairs = _PAIR.findall(match[2])
                records[line] = ExplicitValues(match[1], {_name(k): unescape(a or b, _QUOTES) for k, a, b in pairs})
            line += match[0].count("\n")
        return records

    @functools.cached_property
    def classes(self) -> dict[str, str | None]:
        """Class of defaults -> the class above it, None for the one that holds for everything."""
        parents: dict[str, str | None] = {}

        def visit(node: Value, above: str | None) -> None:
            name = node.get("class", "main") if above is None else node.get("class")
            parents[name] = above
            for below in node.findall("default"):
                visit(below, name)

        for top in ElementTree.fromstring(self._text).findall("default"):
            visit(top, None)
        return parents


def _name(key: str) -> str:
    return "dclass" if key == "class" else key


class Records:
    """The explicit attributes of every element of a model.

    Args:
        document: The document of the model; None: a program made it.
        is_blank: Whether the model began empty: then only noted attributes are explicit.
    """

    def __init__(self, document: Document | None = None, is_blank: bool = False) -> None:
        self._document, self.is_blank = document, is_blank
        self._has_defaults = False
        self._of: dict[Native | tuple[Native, str], ExplicitValues] = {}

    @property
    def has_defaults(self) -> bool:
        """Whether a class of defaults may have explicit attributes."""
        return self._has_defaults or not self.is_blank

    def note_default(self, native: Native, kind: str, tag: str, name: str, value: Value) -> None:
        """Note that an attribute of a class of defaults was set."""
        self._has_defaults = True
        record = self.of_class(native, kind)
        record.tag = tag
        record.note(name, value)

    @property
    def is_silent_on_angles(self) -> bool:
        """Whether neither the document nor a program has set the unit of angles."""
        return self._document is not None and not self._document.says_angle

    def say_angle(self) -> None:
        """ExplicitValues that a program has set the unit of angles."""
        if self._document is not None:
            self._document.says_angle = True

    def note(self, native: Native, tag: str, values: dict[str, Value]) -> None:
        """Note that an element was added."""
        self._of[native] = ExplicitValues(tag, values)

    def class_parent(self, name: str) -> str | None:
        """Return the class of defaults above another one, or None."""
        return self._classes.get(name, None if name == "main" else "main")

    def classes_below(self, name: str) -> list[str]:
        """Return the classes of defaults directly below another one."""
        return [below for below, above in self._classes.items() if above == name]

    def class_names(self) -> list[str]:
        """Return all classes of defaults."""
        return list(dict.fromkeys(["main", *self._classes]))

    def add_class(self, name: str, above: str) -> None:
        """Note a class of defaults."""
        self._classes[name] = above

    @functools.cached_property
    def _classes(self) -> dict[str, str | None]:
        return {} if self._document is None else dict(self._document.classes)

    def forget(self, native: Native) -> None:
        """Note that an element was deleted."""
        self._of.pop(native, None)

    def among(self, natives: Mapping[Native, Native]) -> Records:
        """Return the same of a copied model: element -> its copy."""
        records = Records(self._document, self.is_blank)
        records._has_defaults = self._has_defaults
        records._of = {natives[n]: ExplicitValues(g.tag, dict(g.values)) for n, g in self._of.items() if n in natives}
        return records

    def of(self, native: Native, kind: str) -> ExplicitValues:
        """Return the explicit attributes of an element."""
        key = (native, kind) if kind == "inertial" else native
        record = self._of.get(key)
        if record is None:
            record = self._of[key] = self._new_record(native, kind, translate.class_defaults)
        return record

    def of_class(self, native: Native, kind: str) -> ExplicitValues:
        """Return the explicit attributes of a class of defaults for the elements of a kind."""
        record = self._of.get(native)
        if record is None:  # asking a class for its class ends the process
            record = self._of[native] = self._new_record(native, kind, lambda native, kind: translate.blank(kind))
        return record

    def _new_record(self, native: Native, kind: str, defaults: Callable[[Native, str], Native]) -> ExplicitValues:
        if self.is_blank and kind != "inertial":
            return ExplicitValues(_tag(native, kind))
        return self._written(native, kind) or read(native, kind, defaults(native, kind))

    def _written(self, native: Native, kind: str) -> ExplicitValues | None:
        return None if kind == "inertial" else self.written(native)

    def written(self, native: Native) -> ExplicitValues | None:
        """Return what the document has of an element, or of a part of a tendon's path; None without a document."""
        words = native.info.split()
        if self._document is None or len(words) != 2 or not words[1].isdigit():
            return None
        return self._document.lines.get(int(words[1]))


def read(native: Native, kind: str, blank: Native) -> ExplicitValues:
    """Return the explicit values according to an ``MjSpec`` alone: those that differ from the defaults, ``blank``."""
    tag = _tag(native, kind)
    record = ExplicitValues(tag)
    for name in schema.attributes(kind, tag):
        key = translate.native_name(kind, name)
        if key in translate.attributes(native):
            value = getattr(native, key)
            if not translate.same(value, getattr(blank, key)):
                record.values[name] = value
    return record


def _tag(native: Native, kind: str) -> str:
    """Return the tag of an element without a record; an ``MjSpec`` does not distinguish all tags."""
    if kind == "sensor":
        return _SENSORS.get(native.type, "user")
    if kind == "equality":
        return _EQUALITIES.get(native.type, "weld")
    if kind == "actuator":
        return "general"
    if kind == "tendon":
        return "fixed" if any(w.type == mj.mjtWrap.mjWRAP_JOINT for w in native.path) else "spatial"
    return kind


def show(value: Value, explicit: Value) -> Value:
    """Return a native value as PyMJCF shows it: keywords as text, arrays as long as they were given."""
    if isinstance(value, np.ndarray) and value.ndim == 1:
        size = len(explicit.split()) if isinstance(explicit, str) else np.size(explicit)
        return value[:size]
    if isinstance(value, bool | mj.mjtLimited):
        return (
            str(explicit).lower()
            if isinstance(explicit, str | bool | np.bool_)
            else ("false", "true", "auto")[int(value)]
        )
    if isinstance(value, float):  # materials are kept in single precision
        exact = _number(explicit)
        return exact if exact is not None and np.float32(exact) == np.float32(value) else value
    if isinstance(value, int | str) and not hasattr(value, "name"):
        return value
    if type(value).__name__ in ("MjDoubleVec", "MjFloatVec", "MjIntVec"):
        shown = np.array(value)
        shown.flags.writeable = False
        return shown
    return explicit


def _number(value: Value) -> float | None:
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def parse(value: Value) -> Value:
    """Return a value that no ``MjSpec`` holds, such as a servo's ``kp``, as a number, an array or text."""
    try:
        numbers = np.array(value.split() if isinstance(value, str) else value, float)
    except (TypeError, ValueError):
        return value
    return float(numbers.ravel()[0]) if numbers.size == 1 else numbers
