"""Handles on the elements of a model: an entity's geoms, joints, sites, actuators and so on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer import translate
from sim2real.composer.element_list import ElementList
from sim2real.composer.translate import TREE_KINDS, mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.model import Model

KIND_OF_TAG = {
    "freejoint": "joint",
    "worldbody": "body",
    **dict.fromkeys(
        ("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion"),
        "actuator",
    ),
    **dict.fromkeys(("connect", "weld", "flex"), "equality"),
    **dict.fromkeys(("fixed", "spatial"), "tendon"),
}
"""The kind of those tags that are not called like their kind; inside a section the section decides."""

REFERENCES = {
    "actuator": ("joint", "jointinparent", "site", "tendon", "body", "refsite", "cranksite", "slidersite"),
    "sensor": (
        "site",
        "joint",
        "body",
        "actuator",
        "tendon",
        "camera",
        "objname",
        "refname",
        "geom1",
        "geom2",
        "body1",
        "body2",
    ),
    "equality": ("body1", "body2", "joint1", "joint2", "tendon1", "tendon2", "site1", "site2"),
    "pair": ("geom1", "geom2"),
    "exclude": ("body1", "body2"),
    "geom": ("mesh", "hfield", "material"),
    "site": ("material",),
    "material": ("texture",),
    "camera": ("target",),
    "light": ("target",),
    "tendon": ("material",),
}
"""Attributes that name another element."""


_IN_BODIES = (*TREE_KINDS, "inertial")


class Element:
    """One element of a model; made by ``Model.find``, ``find_all`` and ``add``.

    Reading and setting any other attribute reads and sets it in the model's ``MjSpec``, in MJCF's spelling or in
    MuJoCo's own. Two handles on the same element are equal.

    Attributes:
        root: The model that the element belongs to.
        kind: What it is: ``body``, ``geom``, ``joint``, ``actuator`` and so on.
    """

    __slots__ = ("_native", "kind", "root")

    root: Model
    kind: str
    _native: Any

    def __init__(self, root: Model, kind: str, native: Any) -> None:
        for name, value in (("root", root), ("kind", kind), ("_native", native)):
            object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Element) and self._native is other._native

    def __hash__(self) -> int:
        return hash(self._native)

    def __repr__(self) -> str:
        return f"<{self.kind} {self.full_identifier!r}>"

    @property
    def native(self) -> Any:
        """The element of the ``MjSpec``."""
        self.root.expose()
        return self._native

    @property
    def name(self) -> str | None:
        """The name inside the element's own model; None when it has none."""
        return self._native.name or None

    @name.setter
    def name(self, value: str) -> None:
        self.root.check_name(self.kind, value)
        self._native.name = value or ""
        self.root.touch()

    @property
    def full_identifier(self) -> str:
        """The name in the compiled model, such as ``arm/hand/finger``."""
        return self.root.identify(self)

    @property
    def tag(self) -> str:
        """The kind, or ``worldbody``."""
        return "worldbody" if self.is_worldbody else self.kind

    @property
    def is_worldbody(self) -> bool:
        """Whether this is the model's world."""
        return self.kind == "body" and self._native.parent is None

    @property
    def is_frame(self) -> bool:
        """Whether this is the frame that another model is attached to."""
        return self.kind == "body" and self._native.name.endswith("/")

    @property
    def parent(self) -> Element | None:
        """The body that holds this element; None for the world and for what stands in no body."""
        native = getattr(self._native, "parent", None)
        return None if native is None else self.root.handle("body", native)

    def add(self, tag: str, **attrs: Any) -> Element:
        """Add an element to a body, or a path element to a tendon.

        Args:
            tag: ``body``, ``geom``, ``joint``, ``freejoint``, ``site``, ``camera``, ``light`` or ``inertial``.
            **attrs: MJCF attributes; ``dclass`` names the defaults.

        Raises:
            UsageError: When such an element cannot stand here.
        """
        if self.kind == "tendon":
            return self.root.builder.extend_tendon(self.root, self, tag, attrs)
        if self.is_frame and tag not in ("joint", "freejoint", "inertial"):
            raise UsageError(
                f"a <{tag}> cannot stand in the attachment frame {self.full_identifier!r}. "
                "Available: freejoint, inertial, joint",
                hint="add it to the attached model, or to a body of the model it is attached to",
            )
        if self.kind != "body" or KIND_OF_TAG.get(tag, tag) not in _IN_BODIES:
            raise UsageError(f"a <{tag}> cannot stand in the {self.kind} {self.full_identifier!r}")
        if tag == "freejoint" and not (self._native.parent is not None and self._native.parent.parent is None):
            raise UsageError(
                f"a free joint is only for bodies that stand in the world, {self.full_identifier!r} does not",
                hint="attach the model to the world, or use hinge and slide joints",
            )
        return self.root.builder.add_to_body(self.root, self, tag, attrs)

    def attach(self, model: Model) -> Element:
        """Attach a model at this site, or at the world; return the frame."""
        if self.kind != "site" and not self.is_worldbody:
            raise UsageError(
                f"a model is attached to a site or the world, not to the {self.kind} {self.full_identifier!r}"
            )
        return self.root.attach_at(self, model)

    def find_all(
        self, kind: str, immediate_children_only: bool = False, exclude_attachments: bool = False
    ) -> list[Element]:
        """Return the elements of a kind below this body, in the order of the document."""
        return list(self.root.walk(self._native, kind, immediate_children_only, exclude_attachments))

    def all_children(self) -> list[Element]:
        """Return what stands directly in this body."""
        return [e for kind in TREE_KINDS for e in self.find_all(kind, immediate_children_only=True)]

    def set_attributes(self, **attrs: Any) -> None:
        """Set several attributes."""
        for name, value in attrs.items():
            setattr(self, name, value)

    def remove(self) -> None:
        """Delete the element from its model, with what refers to it."""
        self.root.builder.remove(self.root, self)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        native, kind = self._native, self.kind
        if kind == "body" and name in TREE_KINDS:
            return ElementList(lambda: self.find_all(name, immediate_children_only=True), name)
        if kind == "body" and name == "freejoint":
            return next((j for j in self.find_all("joint", True) if j._native.type == mj.mjtJoint.mjJNT_FREE), None)
        if name in REFERENCES.get(kind, ()):
            return self.root.referenced(self, name)
        if name == "dclass":
            return native.classname.name
        value = translate.read(native, kind, name)
        if isinstance(value, np.ndarray):  # which the caller may write into
            self.root.touch()
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "name":
            type(self).name.__set__(self, value)
        elif name in REFERENCES.get(self.kind, ()) or isinstance(value, Element):
            self.root.refer(self, translate.native_name(self.kind, name), value)
        else:
            translate.assign(self._native, self.kind, name, value)
            self.root.touch()


def as_elements(elements: Any) -> tuple[tuple[Element, ...], bool]:
    """Return what was given as a tuple, and whether it was a single element.

    Raises:
        UsageError: When something in it is no element, or the kinds differ.
    """
    if elements is None:
        raise UsageError("nothing to bind: the element is None", hint="find() returns None where it finds nothing")
    if isinstance(elements, Element) or not isinstance(elements, Iterable):
        found: tuple[Any, ...] = (elements,)
    else:
        found = tuple(elements)
    for element in found:
        if not isinstance(element, Element):
            raise UsageError(f"expected an element of a model, got {type(element).__name__}: {element!r}")
    kinds = sorted({e.kind for e in found})
    if len(kinds) > 1:
        raise UsageError(f"Cannot bind to a collection containing multiple element types: {', '.join(kinds)}")
    return found, isinstance(elements, Element)
