"""Classes of defaults. Elements follow them at any time, as in MJCF; in an ``MjSpec`` only when they are made."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.models import builder
from sim2real.composer.models.element import Element
from sim2real.composer.models.mjcf import explicit_values, schema, translate
from sim2real.composer.models.mjcf.schema import KIND_OF_TAG
from sim2real.composer.models.tree import Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from sim2real.composer.models.tree import Handle
    from sim2real.composer.types import Native, NativeDefault, Value


class Defaults:
    """A class of defaults: ``default.geom.rgba = ...``; ``default.add('default', dclass='finger')`` makes another."""

    __slots__ = ("_model", "name")
    tag = "default"

    def __init__(self, model: Tree[Handle], name: str) -> None:
        self._model, self.name = model, name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Defaults) and self._model is other._model and self.name == other.name

    def __hash__(self) -> int:
        return hash((id(self._model), self.name))

    def __repr__(self) -> str:
        return f"<default class {self.name!r} of model {self._model.model!r}>"

    @property
    def native(self) -> NativeDefault:
        """The ``MjsDefault``."""
        return self._model._spec.find_default(self.name)

    @property
    def dclass(self) -> str | None:
        """The name of the class; None for the one that holds for everything."""
        return None if self.name == "main" else self.name

    @property
    def root(self) -> Tree[Handle]:
        """The model."""
        return self._model

    @property
    def parent(self) -> Tree[Handle] | Defaults:
        """The class that this one takes its values from; the model for the one that holds for everything."""
        above = self._model.records.class_parent(self.name)
        return self._model if above is None else Defaults(self._model, above)

    @property
    def default(self) -> list[Defaults]:
        """The classes that take their values from this one."""
        return [Defaults(self._model, name) for name in self._model.records.classes_below(self.name)]

    def all_children(self) -> list[Defaults]:
        """Return the classes below."""
        return list(self.default)

    def add(self, tag: str, dclass: str) -> Defaults:
        """Add a class below this one."""
        if tag != "default":
            raise UsageError(f"a <{tag}> cannot be added to <default>", hint="set default.<tag>.<attribute>")
        self._model._spec.add_default(dclass, self.native)
        self._model.records.add_class(dclass, self.name)
        self._model.touch()
        return Defaults(self._model, dclass)

    def find(self, kind: str, identifier: str) -> Defaults | None:
        """Return the class of a name, or None; the kind is ``default``."""
        if kind != "default" or self._model._spec.find_default(identifier) is None:
            return None
        return Defaults(self._model, identifier)

    def __getattr__(self, tag: str) -> DefaultElement:
        if tag.startswith("__"):
            raise AttributeError(tag)
        native = getattr(self.native, KIND_OF_TAG.get(tag, tag), None)
        if native is None:
            raise AttributeError(f"<default> has no elements {tag!r}")
        return DefaultElement(self, KIND_OF_TAG.get(tag, tag), native, tag)


class _Shown(np.ndarray):
    """An attribute of a class of defaults: writing an item sets it there, and so in the elements that follow it."""

    _write: Callable[[np.ndarray], None] | None = None

    def __array_finalize__(self, obj: np.ndarray | None) -> None:
        """Let arrays that are computed from this one be plain."""
        self._write = None

    def __setitem__(self, key: Value, value: Value) -> None:
        whole = np.array(self)
        whole[key] = value
        if self._write is None:
            raise UsageError("this is a part of an attribute of defaults: write into the attribute itself")
        self._write(whole)


class DefaultElement(Element):
    """The defaults of one kind of element in a class.

    Setting an attribute also sets it in the elements of the class, and of the classes below it, that do not have it
    as an explicit attribute.

    Args:
        tag: The tag in the caller's request: a class has the same defaults for all actuators.
    """

    __slots__ = ("_owner", "_tag")
    _owner: Defaults
    _tag: str

    def __init__(self, owner: Defaults, kind: str, native: Native, tag: str) -> None:
        super().__init__(owner.root, kind, native)
        object.__setattr__(self, "_owner", owner)
        object.__setattr__(self, "_tag", tag)

    def __repr__(self) -> str:
        return f"<defaults of {self._tag} in {self._owner!r}>"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DefaultElement) and (self._owner, self._tag) == (other._owner, other._tag)

    def __hash__(self) -> int:
        return hash((self._owner, self._tag))

    @property
    def tag(self) -> str:
        """The tag in MJCF."""
        return self._tag

    @property
    def parent(self) -> Defaults:
        """The class."""
        return self._owner

    @property
    def class_defaults(self) -> Native:
        """MuJoCo's own defaults; asking a class for its class ends the process."""
        return translate.blank(self.kind)

    def recorded(self) -> explicit_values.ExplicitValues:
        """Return the explicit attributes of the class."""
        return self.root.records.of_class(self._native, self.kind)

    @property
    def full_identifier(self) -> Value:
        """None, as dm_control has it: defaults have no name."""
        return None

    def __getattr__(self, name: str) -> Value:
        value = super().__getattr__(name)
        if isinstance(value, np.ndarray):
            value = value.copy().view(_Shown)
            value._write = lambda whole: setattr(self, name, whole)
            value.flags.writeable = False
        return value

    def __setattr__(self, name: str, value: Value) -> None:
        # Translate the value, and check that the tag has this attribute.
        if value is None:
            raise UsageError(
                f"{name} of {self!r} cannot be taken back", hint="set it to the value that is to hold instead"
            )
        value = value.name if isinstance(value, Element) else value
        fixed: Mapping[str, Value] | None = None
        if not translate.is_plain(self._native, self.kind, name, value):
            valid = schema.attributes(self.kind, self._tag)
            if name not in valid:
                available = ", ".join(sorted(valid))
                raise AttributeError(f"{name!r} is not a valid attribute for <{self._tag}>. Available: {available}")
            fixed, _ = translate.from_xml(self.kind, self._tag, {name: value}, ())
        # Record the value, then set it in every element that follows this class.
        self.root.records.note_default(self._native, self.kind, self._tag, name, value)
        for follower in self._followers(name):
            if follower.kind == "actuator" and follower.tag != "general" and not isinstance(follower, DefaultElement):
                builder.rebuild(self.root, follower)
            elif fixed is None:
                translate.assign(follower._native, self.kind, name, value)
            else:
                for key, item in fixed.items():
                    setattr(follower._native, key, item)
        self.root.touch()

    def _followers(self, name: str) -> Iterator[Element]:
        """Yield the elements whose value of an attribute comes from here: classes first, this one included."""
        classes, names = [self._owner], set()
        while classes:
            one = classes.pop()
            below = DefaultElement(one, self.kind, getattr(one.native, self.kind), self._tag)
            if one != self._owner and name in below.recorded().values:
                continue
            names.add(one.name)
            classes += one.default
            yield below
        for element in self.root.find_all(self.kind, exclude_attachments=True):
            owner = element._native.classname
            if (owner.name if owner else "main") in names and name not in element.recorded().values:
                yield element
