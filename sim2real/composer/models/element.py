"""Handles on the elements of a model: an entity's geoms, joints, sites, actuators and so on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.models import builder
from sim2real.composer.models.composition import attach as attaching
from sim2real.composer.models.element_list import ElementList
from sim2real.composer.models.mjcf import explicit_values, files, schema, translate, xml
from sim2real.composer.models.mjcf.references import REFERENCES, refer, referenced, rename
from sim2real.composer.models.mjcf.schema import KIND_OF_TAG
from sim2real.composer.models.mjcf.translate import TREE_KINDS, mj
from sim2real.composer.models.tree import Handle, Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import Value

_IN_BODIES = (*TREE_KINDS, "inertial")
_LISTED = frozenset(TREE_KINDS)
_UNROLLED = ("composite", "flexcomp", "replicate", "frame", "attach", "plugin")


class Element(Handle):
    """One element of a model; made by ``Model.find``, ``find_all`` and ``add``.

    Reading and setting any other attribute reads and sets it in the model's ``MjSpec``, in MJCF's spelling or in
    MuJoCo's own; an attribute that is not explicit reads as None. There is one handle on each element.
    """

    __slots__ = ()

    root: Tree[Element]

    def add(self, tag: str, **attrs: Value) -> Element:
        """Add an element to a body, a part of the path to a tendon, or a reference to a tuple.

        Args:
            tag: ``body``, ``geom``, ``joint``, ``freejoint``, ``site``, ``camera``, ``light`` or ``inertial``.
            **attrs: MJCF attributes; ``dclass`` names the defaults.

        Raises:
            UsageError: When such an element cannot stand here.
        """
        if self.kind == "tendon":
            return builder.extend_tendon(self.root, self, tag, attrs)
        if self.kind == "tuple":
            return builder.extend_tuple(self.root, self, tag, attrs)
        if self.is_frame and tag not in ("joint", "freejoint", "inertial"):
            raise UsageError(
                f"a <{tag}> cannot stand in the attachment frame {self.full_identifier!r}. "
                "Available: freejoint, inertial, joint",
                hint="add it to the attached model, or to a body of the model it is attached to",
            )
        if self.kind != "body" or KIND_OF_TAG.get(tag, tag) not in _IN_BODIES:
            hint = schema.FROM_DOCUMENTS if tag in _UNROLLED else f"bodies hold {', '.join(_IN_BODIES)}"
            raise UsageError(f"a <{tag}> cannot be added to the {self.kind} {self.full_identifier!r}", hint=hint)
        if tag == "freejoint" and not (self._native.parent is not None and self._native.parent.parent is None):
            raise UsageError(
                f"a free joint is only for bodies that stand in the world, {self.full_identifier!r} does not",
                hint="attach the model to the world, or use hinge and slide joints",
            )
        return builder.add_to_body(self.root, self, tag, attrs)

    def attach(self, model: Tree[Element]) -> Element:
        """Attach a model at this site, or at the world; return the frame."""
        if self.kind != "site" and not self.is_worldbody:
            raise UsageError(
                f"a model is attached to a site or the world, not to the {self.kind} {self.full_identifier!r}"
            )
        return attaching.attach(self, model)

    def find_all(
        self, kind: str, immediate_children_only: bool = False, exclude_attachments: bool = False
    ) -> list[Element]:
        """Return the elements of a kind below this body, in the order of the document.

        Args:
            immediate_children_only: Only elements of this body itself.
        """
        if self.kind != "body":
            return []
        kind = KIND_OF_TAG.get(kind, kind)
        return list(self.root.walk(self._native, kind, immediate_children_only, exclude_attachments))

    def find(self, kind: str, identifier: str) -> Element | None:
        """Return the element of a kind with a name, if it stands below this body; else None."""
        element = self.root.find(kind, identifier)
        return element if element is not None and element in self.find_all(kind) else None

    def all_children(self) -> list[Element]:
        """Return what stands directly in this body."""
        inertial = [] if self.inertial is None else [self.inertial]
        return inertial + [e for kind in TREE_KINDS for e in self.find_all(kind, immediate_children_only=True)]

    def get_attributes(self) -> dict[str, Value]:
        """Return the attributes that were given to this element: name -> value."""
        return {name: getattr(self, name) for name in self.recorded().values}

    def set_attributes(self, **attrs: Value) -> None:
        """Set several attributes."""
        for name, value in attrs.items():
            setattr(self, name, value)

    def to_xml_string(
        self, prefix_root: Tree[Element] | None = None, self_only: bool = False, pretty_print: bool = True
    ) -> str:
        """Return this element as MJCF: its explicit attributes and its children.

        Args:
            prefix_root: The model that names are relative to; default: the element's own.
        """
        return xml.to_xml_string(self, prefix_root, self_only, pretty_print)

    def remove(self) -> None:
        """Delete the element from its model, with what refers to it."""
        builder.remove(self.root, self)

    def __getattr__(self, name: str) -> Value:
        if name.startswith("__"):
            raise AttributeError(name)
        native, kind = self._native, self.kind
        if native is None:
            raise UsageError(f"this {kind} was removed from model {self.root.model!r}")
        if kind == "body":
            if name in _LISTED:
                return ElementList(lambda: self.find_all(name, immediate_children_only=True), name)
            if name == "freejoint":
                return next((j for j in self.find_all("joint", True) if j._native.type == mj.mjtJoint.mjJNT_FREE), None)
            if name == "inertial":
                return self.root.handle("inertial", native) if native.explicitinertial else None
        # An attribute that is not explicit reads as None.
        record = self.recorded()
        if name not in record.values and name in schema.attributes(kind, record.tag):
            return None
        # References read as elements, files as assets, classes as classes of defaults.
        if name in REFERENCES.get(kind, ()):
            return referenced(self, name)
        if name.startswith("file") and record.values.get(name):
            return files.asset_of(self.root, kind, record.values[name])
        if name in ("dclass", "childclass"):
            return self.root.default_class(record.values[name])
        return self._shown(name, record)

    def _shown(self, name: str, record: explicit_values.ExplicitValues) -> Value:
        """Return the value of a plain attribute, in PyMJCF's form where it was given."""
        try:
            value = translate.read(self._native, self.kind, name)
        except AttributeError:
            if name not in record.values:
                raise
            return explicit_values.parse(record.values[name])
        if isinstance(value, np.ndarray):  # which the caller may write into
            self.root.touch()
        return explicit_values.show(value, record.values[name]) if name in record.values else value

    def __setattr__(self, name: str, value: Value) -> None:
        if name == "name":
            self.root.check_name(self.kind, value)
            rename(self, value or "")
            self.root.touch()
            return
        kind, record = self.kind, self.recorded()
        value = files.adopt(self.root, value) if isinstance(value, files.Asset) else value
        if name in ("dclass", "childclass"):
            builder.reclass(self.root, self, name, value)
        elif name in REFERENCES.get(kind, ()) and self._holds(name):
            refer(self, translate.native_name(kind, name), value)
            record.note(name, value)
        elif value is not None and name != "refname" and translate.is_plain(self._native, kind, name, value):
            translate.assign(self._native, kind, name, value)
            record.note(name, value)
            self.root.touch()
        else:
            before = record.values.get(name)
            record.note(name, value)
            try:
                builder.rebuild(self.root, self, name)
            except Exception:
                record.note(name, before)
                raise

    def _holds(self, name: str) -> bool:
        """Return whether the ``MjSpec`` has an attribute, rather than several attributes in MJCF."""
        native = self._native
        if name == "refname" and native.reftype == mj.mjtObj.mjOBJ_UNKNOWN:  # until its type is laid down as well
            return False
        return hasattr(native, translate.native_name(self.kind, name))

    def __delattr__(self, name: str) -> None:
        setattr(self, name, None)


Elements = Element | Iterable[Element]
"""An element, or several of one kind."""


def as_elements(elements: Elements) -> tuple[tuple[Element, ...], bool]:
    """Return elements as a tuple, and whether the argument was a single element.

    Raises:
        UsageError: When something in it is no element, or the kinds differ.
    """
    if elements is None:
        raise UsageError("nothing to bind: the element is None", hint="find() returns None where it finds nothing")
    if isinstance(elements, Element) or not isinstance(elements, Iterable):
        sequence: tuple[Element, ...] = (elements,)
    else:
        sequence = tuple(elements)
    for element in sequence:
        if not isinstance(element, Element):
            raise UsageError(f"expected an element of a model, got {type(element).__name__}: {element!r}")
    kinds = sorted({e.kind for e in sequence})
    if len(kinds) > 1:
        raise UsageError(f"Cannot bind to a collection containing multiple element types: {', '.join(kinds)}")
    return sequence, isinstance(elements, Element)
