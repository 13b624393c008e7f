"""What was said of an element, in MJCF's spelling: an ``MjSpec`` holds values, but not which of them are defaults."""

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
class Given:
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
        values: Attribute in MJCF -> element, its name where it is not there, or number.
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
    """The text of a model, from which the tags and attributes of its elements are read when somebody asks.

    Args:
        text: MJCF, no two elements of which stand on one line.

    Attributes:
        says_angle: Whether it says in which unit its angles are.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self.says_angle = re.search(r"<compiler[^>]*\sangle\s*=", text) is not None

    @functools.cached_property
    def lines(self) -> dict[int, Given]:
        """Number of a line, from 1 -> what is given of the element that begins there."""
        found, line = {}, 1
        for match in _TAG.finditer(self._text):
            if match[1]:
                pairs = _PAIR.findall(match[2])
                found[line] = Given(match[1], {_name(k): unescape(a or b, _QUOTES) for k, a, b in pairs})
            line += match[0].count("\n")
        return found

    @functools.cached_property
    def classes(self) -> dict[str, str | None]:
        """Class of defaults -> the class above it, None for the one that holds for everything."""
        found: dict[str, str | None] = {}

        def visit(node: Value, above: str | None) -> None:
            name = node.get("class", "main") if above is None else node.get("class")
            found[name] = above
            for below in node.findall("default"):
                visit(below, name)

        for top in ElementTree.fromstring(self._text).findall("default"):
            visit(top, None)
        return found


def _name(key: str) -> str:
    return "dclass" if key == "class" else key


class Records:
    """What was given of every element of a model.

    Args:
        document: What the model was made from, where it is known.
        is_blank: Whether it was made from nothing: then nothing is given but what is noted.
    """

    def __init__(self, document: Document | None = None, is_blank: bool = False) -> None:
        self._document, self.is_blank = document, is_blank
        self._has_defaults = False
        self._of: dict[Native | tuple[Native, str], Given] = {}

    @property
    def has_defaults(self) -> bool:
        """Whether there may be a class of defaults that says something."""
        return self._has_defaults or not self.is_blank

    def note_default(self, native: Native, kind: str, tag: str, name: str, value: Value) -> None:
        """Note that an attribute of a class of defaults was set."""
        self._has_defaults = True
        said = self.of_class(native, kind)
        said.tag = tag
        said.note(name, value)

    @property
    def is_silent_on_angles(self) -> bool:
        """Whether nobody said if angles are in degrees: neither the document that there is, nor a program."""
        return self._document is not None and not self._document.says_angle

    def say_angle(self) -> None:
        """Note that a program said it."""
        if self._document is not None:
            self._document.says_angle = True

    def note(self, native: Native, tag: str, values: dict[str, Value]) -> None:
        """Note that an element was added."""
        self._of[native] = Given(tag, values)

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
        made = Records(self._document, self.is_blank)
        made._has_defaults = self._has_defaults
        made._of = {natives[n]: Given(g.tag, dict(g.values)) for n, g in self._of.items() if n in natives}
        return made

    def of(self, native: Native, kind: str) -> Given:
        """Return what was given of an element."""
        key = (native, kind) if kind == "inertial" else native
        found = self._of.get(key)
        if found is None:
            found = self._of[key] = self._found(native, kind, translate.class_defaults)
        return found

    def of_class(self, native: Native, kind: str) -> Given:
        """Return what a class of defaults says of the elements of a kind."""
        found = self._of.get(native)
        if found is None:  # asking a class for its class ends the process
            found = self._of[native] = self._found(native, kind, lambda native, kind: translate.blank(kind))
        return found

    def _found(self, native: Native, kind: str, defaults: Callable[[Native, str], Native]) -> Given:
        if self.is_blank and kind != "inertial":
            return Given(_tag(native, kind))
        return self._written(native, kind) or read(native, kind, defaults(native, kind))

    def _written(self, native: Native, kind: str) -> Given | None:
        return None if kind == "inertial" else self.written(native)

    def written(self, native: Native) -> Given | None:
        """Return what the document has of an element, or of a part of a tendon's path; None without a document."""
        words = native.info.split()
        if self._document is None or len(words) != 2 or not words[1].isdigit():
            return None
        return self._document.lines.get(int(words[1]))


def read(native: Native, kind: str, blank: Native) -> Given:
    """Return what can be told from an ``MjSpec`` alone: values that differ from the defaults, ``blank``."""
    tag = _tag(native, kind)
    found = Given(tag)
    for name in schema.attributes(kind, tag):
        key = translate.native_name(kind, name)
        if key in translate.attributes(native):
            value = getattr(native, key)
            if not translate.same(value, getattr(blank, key)):
                found.values[name] = value
    return found


def _tag(native: Native, kind: str) -> str:
    """Return the tag of an element of an ``MjSpec`` that nobody wrote down: MuJoCo forgets some of it."""
    if kind == "sensor":
        return _SENSORS.get(native.type, "user")
    if kind == "equality":
        return _EQUALITIES.get(native.type, "weld")
    if kind == "actuator":
        return "general"
    if kind == "tendon":
        return "fixed" if any(w.type == mj.mjtWrap.mjWRAP_JOINT for w in native.path) else "spatial"
    return kind


def show(value: Value, given: Value) -> Value:
    """Return a native value as PyMJCF shows it: keywords as text, arrays as long as they were given."""
    if isinstance(value, np.ndarray) and value.ndim == 1:
        size = len(given.split()) if isinstance(given, str) else np.size(given)
        return value[:size]
    if isinstance(value, bool | mj.mjtLimited):
        return str(given).lower() if isinstance(given, str | bool | np.bool_) else ("false", "true", "auto")[int(value)]
    if isinstance(value, float):  # materials are kept in single precision
        exact = _number(given)
        return exact if exact is not None and np.float32(exact) == np.float32(value) else value
    if isinstance(value, int | str) and not hasattr(value, "name"):
        return value
    if type(value).__name__ in ("MjDoubleVec", "MjFloatVec", "MjIntVec"):
        shown = np.array(value)
        shown.flags.writeable = False
        return shown
    return given


def _number(given: Value) -> float | None:
    try:
        return float(given)
    except (TypeError, ValueError):
        return None


def parse(value: Value) -> Value:
    """Return a value that no ``MjSpec`` holds, such as a servo's ``kp``, as a number, an array or text."""
    try:
        numbers = np.array(value.split() if isinstance(value, str) else value, float)
    except (TypeError, ValueError):
        return value
    return float(numbers.ravel()[0]) if numbers.size == 1 else numbers
