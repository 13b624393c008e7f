"""The elements of one model: their handles, explicit attributes and references."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import TYPE_CHECKING, ClassVar, Generic, Self, TypeVar, cast

from sim2real.composer.models.mjcf import translate
from sim2real.composer.models.mjcf.explicit_values import Document, ExplicitValues, PathPart, Records
from sim2real.composer.models.mjcf.schema import KIND_OF_TAG, SECTION_OF
from sim2real.composer.models.mjcf.translate import TREE_KINDS
from sim2real.composer.models.scope import Scope
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjSpec, Native, Value

_ADDED_LATER = 1_000_000_000
"""Elements that were parsed are ordered by their line; those that a program added come after them."""


class Handle:
    """One element of a model: its kind, its place and its name; ``Element`` adds the attributes."""

    __slots__ = ("_native", "kind", "root")

    root: Tree[Handle]
    kind: str
    _native: Native

    def __init__(self, root: Tree[Handle], kind: str, native: Native) -> None:
        for name, value in (("root", root), ("kind", kind), ("_native", native)):
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"<{self.kind} {self.full_identifier!r}>"

    @property
    def native(self) -> Native:
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
        """The tag in MJCF: ``motor`` for what ``<motor>`` made, ``worldbody`` for the world."""
        return "worldbody" if self.is_worldbody else self.recorded().tag

    @property
    def class_defaults(self) -> Native:
        """The native element that holds the defaults of this element's class."""
        return translate.class_defaults(self._native, self.kind)

    @property
    def is_worldbody(self) -> bool:
        """Whether this is the model's world."""
        return self.kind == "body" and self._native.parent is None

    @property
    def is_frame(self) -> bool:
        """Whether this is the frame that another model is attached to."""
        return self.kind == "body" and self._native.name.endswith("/")

    @property
    def is_removed(self) -> bool:
        """Whether the element was deleted."""
        return self._native is None

    @property
    def parent(self) -> Value:
        """The body that holds this element; else its section; the model for the world."""
        if self.kind == "inertial":
            return self.root.handle("body", self._native)
        if self.is_worldbody:
            return self.root
        native = getattr(self._native, "parent", None)
        return self.root.section_of(self.kind) if native is None else self.root.handle("body", native)

    def recorded(self) -> ExplicitValues:
        """Return the explicit attributes of this element."""
        return self.root.records.of(self._native, self.kind)


H = TypeVar("H", bound=Handle, covariant=True)


class Tree(Scope, Generic[H]):
    """The elements of a ``Model``; the functions that add, remove, attach and compile work on it.

    Attributes:
        references: Native element and attribute -> the element that the attribute names.
        records: The explicit attributes of every element.
        shows_text: Whether attributes that name elements by text read as text.
        removed: Deleted element that others name -> its name.
        counted: How many elements of each kind there were, and at which revision.
        paths: Native tendon -> its path, as far as it was read.
    """

    handle_type: ClassVar[type[Handle]] = Handle
    """The class of the handles."""

    def __init__(self, model: str | None = None, spec: MjSpec | None = None, document: Document | None = None) -> None:
        super().__init__(model, spec)
        self.records = Records(document, is_blank=spec is None)
        self.references: dict[tuple[Native, str], H] = {}
        self.shows_text = False
        self.removed: dict[Handle, str] = {}
        self.counted: tuple[int | None, dict[str, int]] | None = None
        self.paths: dict[Native, list[PathPart]] = {}
        self._handles: dict[Native | tuple[Native, str], H] = {}
        self._order: dict[Native, int] = {}
        self._clock = itertools.count(_ADDED_LATER)
        self._sections: dict[str, Value] = {}  # by name; ``Model`` makes them, as they need what works on a tree

    @classmethod
    def owning(cls, spec: MjSpec, document: Document | None = None) -> Self:
        """Return a model around a spec that no other code changes: results stay valid until a recorded change."""
        model = cls(spec=spec, document=document)
        model._revision = 0
        return model

    def expose(self) -> None:
        """Mark that the spec may change from now on without a call of the model."""
        super().expose()
        self.records.is_blank = False

    def identify(self, element: Handle, relative_to: Scope | None = None) -> str:
        """Return the compiled name of an element of this model, or its name seen from a model above."""
        prefix = self.prefix(relative_to)
        if element.is_worldbody:
            return prefix or "world"
        if element._native.name:
            return prefix + element._native.name
        peers = self.find_all(element.kind, exclude_attachments=True)
        number = [*map(id, peers)].index(id(element))
        unnamed = f"/unnamed_{element.kind}_{number}"
        return (prefix or ("/" if relative_to is None else "")) + unnamed

    # -- handles

    @property
    def worldbody(self) -> H:
        """The world of this model, which becomes the attachment frame."""
        return self.handle("body", self._spec.worldbody)

    def handle(self, kind: str, native: Native) -> H:
        """Return the handle on an element of the spec; always the same one."""
        key = (native, kind) if kind == "inertial" else native  # a part of its body
        if key not in self._handles:
            self._handles[key] = cast("H", self.handle_type(self, kind, native))
        return self._handles[key]

    def section_of(self, kind: str) -> Value:
        """Return the section of a kind of elements."""
        return self._sections[SECTION_OF[kind]]

    def default_class(self, name: Value) -> Value:
        """Return a class of defaults by its name."""
        return self._sections["default"].find("default", getattr(name, "dclass", name))

    def enlist(self, kind: str, native: Native, tag: str, values: dict[str, Value]) -> H:
        """Note that an element was added after all others; return its handle."""
        self._order[native] = next(self._clock)
        self.records.note(native, tag, values)
        return self.handle(kind, native)

    def strike(self, natives: list[Native]) -> None:
        """Drop the records of elements before they are deleted."""
        for native in natives:
            self._order.pop(native, None)
            self.records.forget(native)
            handle = self._handles.pop(native, None)
            if handle is not None:
                object.__setattr__(handle, "_native", None)

    # -- looking for elements

    def find(self, kind: str, identifier: str | None = None, *, name: str | None = None) -> Value:
        """Return the element of a kind with a name such as ``finger`` or ``hand/finger``, or None.

        Args:
            kind: Of elements, or ``attachment_frame``, ``attached_model``.
        """
        identifier = name if identifier is None else identifier
        if identifier is None:
            raise UsageError(f"find({kind!r}) needs a name")
        head, _, tail = identifier.partition("/")
        # A path leads into an attached model.
        if tail:
            attachment = self.attachments.get(head)
            return None if attachment is None else attachment.model.find(kind, tail)
        if kind == "default":
            return self.default_class(head)
        if kind in ("attachment_frame", "attached_model"):
            attachment = self.attachments.get(head)
            if attachment is None:
                return None
            return attachment.model if kind == "attached_model" else self.handle("body", attachment.frame)
        if kind == "body" and identifier == "world":
            return self.worldbody
        getter = getattr(self._spec, KIND_OF_TAG.get(kind, kind), None)
        if getter is None:
            raise UsageError(f"{kind!r} is not a valid namespace: there are no elements of that kind")
        native = getter(identifier)
        return None if native is None else self.handle(KIND_OF_TAG.get(kind, kind), native)

    def find_all(self, kind: str, immediate_children_only: bool = False, exclude_attachments: bool = False) -> list[H]:
        """Return all elements of a kind, in the order of the document: own ones, then those of attached models.

        Args:
            immediate_children_only: Only those that stand directly in the model, which holds sections and its world.
        """
        kind = KIND_OF_TAG.get(kind, kind)
        if kind in TREE_KINDS:
            elements = self.walk(self._spec.worldbody, kind, False, exclude_attachments)
            return [] if immediate_children_only else list(elements)
        natives = getattr(self._spec, translate.plural(kind), None)
        if natives is None:
            raise UsageError(f"{kind!r} is not a valid namespace: there are no elements of that kind")
        if immediate_children_only:
            return []
        elements = [self.handle(kind, n) for n in natives]
        if not exclude_attachments:
            for attachment in self.attachments.values():
                elements += attachment.model.find_all(kind)
        return elements

    def walk(self, body: Native, kind: str, shallow: bool, exclude_attachments: bool) -> Iterator[H]:
        """Yield the elements of a kind below a native body, in the order of the document.

        Args:
            shallow: Only elements of the body itself.
        """
        attachment = self.attachments.get(body.name[:-1]) if body.name.endswith("/") else None
        children = list(getattr(body, translate.plural(kind)))
        if kind != "body" and not shallow:
            children += body.bodies
        for child in sorted(children, key=self._position) if len(children) > 1 else children:
            is_body = child.__class__.__name__ == "MjsBody"
            if not is_body or kind == "body":
                yield self.handle(kind, child)
            if is_body and not shallow:
                yield from self.walk(child, kind, shallow, exclude_attachments)
        if attachment is not None and not exclude_attachments and not shallow:
            yield from attachment.model.find_all(kind)

    def _position(self, native: Native) -> int:
        added = self._order.get(native)
        if added is not None:
            return added
        words = native.info.split()
        return int(words[1]) if len(words) > 1 and words[1].isdigit() else 0
