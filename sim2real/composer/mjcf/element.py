"""Elements of an MJCF tree: tags, explicit attributes and children, with the names that PyMJCF gives them."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.mjcf import files, schema
from sim2real.composer.mjcf.schema import KIND_OF_TAG
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.mjcf.model import RootElement

_POSE = ("pos", "quat", "axisangle", "xyaxes", "zaxis", "euler")
_NO_ORDER: dict[str, list[Any]] = {}
_CHANGES = itertools.count()
_UNITS = {unit: 1 << 10 * (i + 1) for i, unit in enumerate("kmgtpe")}


class NoSuchChildError(UsageError, AttributeError):
    """MJCF does not allow such an element there."""


class Element:
    """One element of a model; made by ``find``, ``find_all`` and ``add``.

    An attribute that is not explicit reads as None. Children are attributes too: ``body.geom``, ``option.flag``.
    """

    __slots__ = ("_attached", "_children", "_given", "_key_order", "_parent", "_root", "_spec", "_tag", "is_removed")
    _attached: RootElement | None
    """The model that an attachment frame holds."""
    _given: dict[str, Any]
    _key_order: dict[str, list[Any]]
    """Only for a keyframe: attribute -> the elements to which its numbers belong, or the names of removed ones."""
    _root: RootElement
    _tag: str
    is_removed: bool

    def __init__(self, spec: schema.Spec, parent: Element | None, root: RootElement | None = None) -> None:
        put = object.__setattr__  # one by one: a model has hundreds of elements
        put(self, "_attached", None)
        put(self, "_children", [])
        put(self, "_given", {})
        put(self, "_key_order", {} if spec.name == "key" else _NO_ORDER)
        put(self, "_parent", parent)
        put(self, "_root", root or getattr(parent, "_root", None))
        put(self, "_spec", spec)
        put(self, "_tag", spec.name)
        put(self, "is_removed", False)

    def __repr__(self) -> str:
        return f"MJCF Element: {self}"

    def __str__(self) -> str:
        return self.to_xml_string(self_only=True, pretty_print=False)

    def __dir__(self) -> list[str]:
        return sorted({*object.__dir__(self), *map(_public, self._spec.attributes), *self._spec.children})

    # -- identity

    @property
    def tag(self) -> str:
        """The tag in MJCF."""
        return self._spec.name

    @property
    def spec(self) -> schema.Spec:
        """The attributes and children that MJCF allows."""
        return self._spec

    @property
    def kind(self) -> str:
        """The kind for ``find``: ``actuator`` for a ``<motor>``; ``body`` also for the world."""
        return "body" if self.tag == "worldbody" else self._spec.kind or self.tag

    @property
    def root(self) -> RootElement:
        """The model."""
        return self._root

    @property
    def namescope(self) -> RootElement:
        """The model in which the element's name is unique."""
        return self._root

    @property
    def parent(self) -> Any:
        """The element above this one."""
        return self._parent

    @property
    def is_worldbody(self) -> bool:
        """Whether this is the model's world."""
        return self.tag == "worldbody"

    @property
    def is_frame(self) -> bool:
        """Whether this is the frame of an attached model."""
        return self._attached is not None

    @property
    def full_identifier(self) -> Any:
        """The name in the compiled model, such as ``arm/hand/finger``; None if such elements have no names."""
        return self._root.identify(self)

    def prefixed_identifier(self, prefix_root: RootElement | None = None) -> str | None:
        """Return the name relative to a model; default: the element's own model."""
        return self._root.identify(self, prefix_root or self._root)

    @property
    def _path(self) -> str:
        parent = self._parent
        return self._tag if parent is None or parent is self._root else f"{parent._tag}.{self._tag}"

    def _note_change(self) -> None:
        """Note that the cached text of the model is out of date."""
        object.__setattr__(self._root, "changes", next(_CHANGES))
        if self._root.parent_model is not None and self._is_setting:  # the cache belongs to the root model
            object.__setattr__(self._root.root_model, "changes", next(_CHANGES))

    # -- attributes

    def _values(self, name: str) -> dict[str, Any]:
        """Return where an attribute is stored: attached models share the settings of the root model."""
        top = self._root.root_model
        if top is self._root or name in schema.OWN_SETTINGS or not self._is_setting:
            return self._given
        return self._in(top)._given

    @property
    def _is_setting(self) -> bool:
        parent = self._parent
        section = self if parent is self._root else parent
        return section is not None and section._tag in ("compiler", "option", "size", "statistic", "visual")

    def _in(self, model: RootElement) -> Element:
        """Return the same setting of another model."""
        parent = self._parent
        holder = model if parent is self._root or parent is None else parent._in(model)
        return holder._child(self._tag)

    def _checked(self, name: str, problem: str = "") -> str:
        if self.is_removed:
            raise UsageError(f"this {self.kind} was removed from model {self._root.model!r}")
        name = "class" if name == "dclass" else name
        if name not in self._spec.attributes:
            available = ", ".join(sorted(map(_public, self._spec.attributes)))
            raise AttributeError(
                f"{problem}{name!r} is not a valid attribute for <{self._tag}>. Available: {available}"
            )
        return name

    def _get(self, name: str) -> Any:
        value = self._values(name).get(name)
        return None if isinstance(value, Element) and value.is_removed else value

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if hasattr(type(self), name):  # a property of this class failed: raise its own error
            return object.__getattribute__(self, name)
        spec = self._spec
        if name in spec.children and not self.is_removed:
            if spec.children[name].repeated:
                return ElementList(self, name)
            return self._child(name) if spec.children[name].implicit else self._present(name)
        if name == spec.name and name in schema.GROUPS:
            return ElementList(self, name)
        if name not in spec.attributes and name != "dclass" and spec.children:
            children = f"; children: {', '.join(sorted(spec.children))}"
            attributes = ", ".join(sorted(spec.attributes))
            raise AttributeError(f"<{self._tag}> object has no attribute {name!r}. Available: {attributes}{children}")
        return self._get(self._checked(name, "object has no attribute: "))

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_") or name == "is_removed":
            object.__setattr__(self, name, value)
        else:
            self._set(self._checked(name, "can't set attribute: "), value)

    def __delattr__(self, name: str) -> None:
        if name in self._spec.children:
            if self._spec.children[name].repeated:
                raise AttributeError(f"`{name}` is a list of elements. Did you mean to call `{name}.clear()`?")
            child = self._child(name) if self._spec.children[name].implicit else self._present(name)
            if child is not None:
                child.remove()
            return
        self._set(self._checked(name, "object has no attribute: "), None)

    def _set(self, name: str, value: Any) -> None:
        self._note_change()
        values = self._values(name)
        value = None if isinstance(value, str) and not value else value
        if name == self._spec.named_by:
            self._root.rename(self, values.get(name), value)
        if value is None:
            values.pop(name, None)
            if self._tag == "key":
                self._key_order.pop(name, None)
            return
        values[name] = self._converted(name, value)
        if self._tag == "key" and name in schema.KEYED:
            self._key_order[name] = self._root.keyed_elements(name)

    def _converted(self, name: str, value: Any) -> Any:
        """Return the value of an attribute in the form in which it is stored."""
        target = schema.reference(self._path, self._tag, name)
        if target is not None:
            return self._converted_reference(name, target, value)
        if isinstance(value, Element):
            raise UsageError(f"{name} of <{self._tag}> names no element")
        if name.startswith("file") and self._tag in files.TAGS:
            return value if isinstance(value, files.Asset) else files.read(self, str(value))
        form = schema.form(self._path, self._tag, name)
        try:
            if form in ("array", "ints"):
                numbers = value.split() if isinstance(value, str) else value
                array = np.atleast_1d(np.array(numbers, dtype=float if form == "array" else int))
                if array.ndim > 1:
                    raise ValueError("it has more than one dimension")
                if array.size > schema.LENGTHS.get(name, array.size):
                    raise ValueError(f"it should have no more than {schema.LENGTHS[name]} entries")
                return array
            if form == "int":
                if float(value) != int(float(value)):
                    raise ValueError("it is no whole number")
                return int(float(value))
            if form == "float":
                return float(np.asarray(value, float).item())
        except (TypeError, ValueError) as error:
            raise UsageError(f"{name}={value!r} of <{self._tag}> is not valid: {error}") from None
        if isinstance(value, bool | np.bool_):
            return str(bool(value)).lower()
        if isinstance(value, str):
            return value
        if isinstance(value, np.ndarray | list | tuple):  # the attribute is newer than the tables
            return np.atleast_1d(np.array(value))
        return str(value)

    def _converted_reference(self, name: str, target: str, value: Any) -> Any:
        by = self._given.get(target) if target in ("objtype", "reftype") else target
        if not isinstance(value, Element):
            if not isinstance(value, str | np.str_):
                raise UsageError(f"{name} of <{self._tag}> names an element, got {value!r}")
            return str(value)
        if by is None:
            self._given[target] = by = value.kind
        by = KIND_OF_TAG.get(by, by)
        if value.kind != by:
            raise UsageError(f"{name} of <{self._tag}> names an element of kind {by}, got one of kind {value.kind}")
        return value

    @property
    def dclass(self) -> Any:
        """The class of defaults."""
        return self._get(self._checked("class"))

    @dclass.setter
    def dclass(self, value: Any) -> None:
        self._set(self._checked("class"), value)

    def get_attributes(self) -> dict[str, Any]:
        """Return the explicit attributes: name -> value."""
        found = {name: self._get(name) for name in sorted(self._spec.attributes)}
        return {_public(name): v for name, v in found.items() if v is not None}

    def set_attributes(self, **attrs: Any) -> None:
        """Set several attributes, or none if one of them is not valid."""
        attrs = {self._checked(k): v for k, v in attrs.items()}
        before = {name: self._values(name).get(name) for name in attrs}
        done = []
        try:
            for name in sorted(attrs, key=_types_first):
                self._set(name, attrs[name])
                done.append(name)
        except Exception:
            for name in done:
                self._set(name, before[name])
            raise

    # -- children

    def _present(self, tag: str) -> Element | None:
        for child in self._children:
            if child._tag == tag:
                return child
        return None

    def _child(self, tag: str) -> Element:
        """Return a child that exists without being added."""
        child = self._present(tag)
        if child is None:
            child = Element(self._spec.children[tag], self)
            place = len(self._children)
            if self._tag in ("default", "mujoco"):  # in MJCF's order, not in the order of use
                order = list(self._spec.children)
                later = order[order.index(tag) :]
                place = next((i for i, c in enumerate(self._children) if c._tag in later), place)
            self._children.insert(place, child)
            # Sections also contain the elements of attached models.
            if self is self._root and self._root.parent_model is not None:
                self._root.parent_model._child(tag)
        return child

    def get_children(self, tag: str) -> Any:
        """Return the children with a tag: a list, or the one child."""
        if tag not in self._spec.children:
            raise NoSuchChildError(f"<{tag}> is not a valid child of <{self._tag}>")
        return getattr(self, tag)

    def add(self, tag: str, **attrs: Any) -> Element:
        """Add an element after the others.

        Raises:
            UsageError: Such an element is not allowed here, or an attribute is not valid.
        """
        return self.insert(tag, None, **attrs)

    def insert(self, tag: str, position: int | None, **attrs: Any) -> Element:
        """Add an element before the child with number ``position``; None: after all others."""
        spec = self._spec.children.get(tag)
        if spec is None or (self.is_frame and tag not in schema.FRAME_CHILDREN):
            available = ", ".join(schema.FRAME_CHILDREN if self.is_frame else sorted(self._spec.children))
            where = f"the attachment frame {self.full_identifier!r}" if self.is_frame else f"<{self._tag}>"
            raise NoSuchChildError(f"<{tag}> is not a valid child of {where}. Available: {available or 'nothing'}")
        if not spec.repeated and (spec.implicit or self._present(tag) is not None):
            raise UsageError(f"A <{tag}> child already exists in <{self._tag}>, please access it directly.")
        if tag == "freejoint" and not self._stands_in_the_world:
            raise NoSuchChildError(
                f"<freejoint> is not a valid child of {self.full_identifier!r}, which is not in the world",
                hint="attach the model to the world, or use hinge and slide joints",
            )
        self._note_change()
        element = Element(spec, self)
        attrs = {("class" if k in ("dclass", "class_") else k): v for k, v in attrs.items()}
        if tag in files.NAMED_AFTER and "name" not in attrs and isinstance(attrs.get("file"), str):
            attrs["name"] = PurePath(attrs["file"]).stem
        for name in attrs:
            element._checked(name)
        self._children.insert(len(self._children) if position is None else position, element)
        try:
            for name in sorted(attrs, key=_types_first):
                element._set(name, attrs[name])
        except Exception:
            self._root.rename(element, element._given.get(spec.named_by), None)
            self._children.remove(element)
            raise
        return element

    @property
    def _stands_in_the_world(self) -> bool:
        above = self._parent
        while above is not None and above.tag in ("frame", "replicate"):
            above = above._parent
        return above is not None and above.is_worldbody

    def remove(self, affect_attachments: bool = False) -> None:
        """Delete the element from its model, with its children.

        Args:
            affect_attachments: Whether to detach models that are attached below it; otherwise they are an error.
        """
        self._note_change()
        below = [e for e in self.walk(own=True) if e._attached is not None]
        others = [] if below or self.is_worldbody else self.attached_children()
        shared = self._is_setting and (self._root.parent_model is not None or self._root.frames)
        if (below or others or shared) and not affect_attachments:
            raise UsageError(
                "other models are attached here, or share this element",
                hint="use remove(affect_attachments=True), which detaches them, or removes it for all",
            )
        for frame in below:
            attached: Any = frame._attached
            attached.detach()
        if shared and self._root is not self._root.root_model:
            self._in(self._root.root_model).remove(affect_attachments=True)
        for child in [*self._children, *others]:
            child.remove(affect_attachments=affect_attachments)
        name = self._given.get(self._spec.named_by)
        self._root.rename(self, name, None)
        self._given.clear()
        self._key_order = {"name": [name]}  # for messages
        if self._parent is not None and (self._spec.repeated or not self._spec.implicit):
            self._parent._children.remove(self)
            self.is_removed = True

    def all_children(self) -> list[Element]:
        """Return the children, also those of models in an attachment frame or a section."""
        for tag, spec in self._spec.children.items():
            if spec.implicit:
                self._child(tag)
        return list(self._with_attached())

    def _with_attached(self) -> list[Element]:
        if self._attached is None and (self._parent is not self._root or not self._root.frames):
            return self._children
        attached = self.attached_children()
        return [*self._children, *attached] if attached else self._children

    def attached_children(self) -> list[Element]:
        """Return the children that belong to attached models."""
        if self._attached is not None:
            return self._attached.worldbody._with_attached()
        if self._parent is self._root and self._tag not in ("worldbody", "default") and not self._is_setting:
            sections = [m._present(self._tag) for m in self._root.frames]
            return [c for section in sections if section is not None for c in section._with_attached()]
        return []

    def walk(self, own: bool = False) -> Iterator[Element]:
        """Yield this element and all below it, in document order; ``own``: without attached models."""
        waiting: list[Element] = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting.extend(reversed(element._children if own else element._with_attached()))

    def find(self, namespace: str, identifier: str | None = None, *, name: str | None = None) -> Any:
        """Return the element of a kind below this one, by a name such as ``finger`` or ``hand/finger``, or None."""
        found = self._root.look_up(namespace, identifier if identifier is not None else name)
        above = found
        while isinstance(above, Element) and above is not self and self is not self._root:
            above = above._parent
        return found if above is self or self is self._root else None

    def find_all(
        self, namespace: str, immediate_children_only: bool = False, exclude_attachments: bool = False
    ) -> list[Element]:
        """Return the elements of a kind below this one, in the order of the document."""
        if namespace not in schema.KINDS and namespace not in KIND_OF_TAG:
            raise UsageError(f"{namespace!r} is not a valid namespace. Available: {', '.join(schema.KINDS)}")
        namespace = KIND_OF_TAG.get(namespace, namespace)
        if immediate_children_only:
            found: Iterable[Element] = self._children if exclude_attachments else self._with_attached()
        else:
            found = (e for e in self.walk(exclude_attachments) if e is not self)
        return [e for e in found if e._spec.kind == namespace]

    def enter_scope(self, scope_identifier: str) -> RootElement | None:
        """Return the model attached under a name such as ``arm/hand``, or None."""
        return self._root.look_up("attached_model", scope_identifier.rstrip("/"))

    def attach(self, attachment: RootElement) -> Element:
        """Attach a model at this site, or at the world; return the frame, an empty body to which joints are added."""
        if self._tag not in ("site", "worldbody"):
            raise UsageError(
                f"a model is attached to a site or the world, not to the {self.kind} {self.full_identifier!r}"
            )
        self._note_change()
        self._root.adopt(attachment)
        holder: Any = self if self.is_worldbody else self._parent
        frame = Element(schema.root().children["worldbody"].children["body"], holder)
        frame._attached = attachment
        self._root.frames[attachment] = frame
        frame._given.update({k: v.copy() for k, v in self._given.items() if k in _POSE})
        position = len(holder._children)
        if not self.is_worldbody:
            position = holder._children.index(self) + 1
            while position < len(holder._children) and holder._children[position].is_frame:
                position += 1
        holder._children.insert(position, frame)
        return frame

    @property
    def _has_content(self) -> bool:
        """Whether the element has content or was added explicitly."""
        return not self._spec.implicit or bool(self._given) or any(c._has_content for c in self._with_attached())

    def is_same_as(self, other: Element | None) -> bool:
        """Return whether another element has the same tag, attributes and children."""
        if other is None or other.tag != self._tag:
            return False
        mine, theirs = (
            {k: v.full_identifier if isinstance(v, Element) else v for k, v in Element.get_attributes(e).items()}
            for e in (self, other)
        )
        if mine.keys() != theirs.keys() or not all(
            np.array_equal(np.asarray(mine[k]), np.asarray(theirs[k])) for k in mine
        ):
            return False
        ordered = self.kind == "tendon"  # compare the order of a path's elements
        for tag in (None,) if ordered else self._spec.children:
            one, two = (
                [c for c in e._with_attached() if tag in (None, c._tag) and c._has_content] for e in (self, other)
            )
            if len(one) != len(two) or not all(a.is_same_as(b) for a, b in zip(one, two, strict=True)):
                return False
        return True

    def resolve_references(self) -> None:
        """Replace names of elements in attributes by the elements."""
        self._note_change()
        for element in self.walk():
            for name, value in element._given.items():
                target = schema.reference(element._path, element._tag, name) if isinstance(value, str) else None
                target = element._given.get(target) if target in ("objtype", "reftype") else target
                target = KIND_OF_TAG.get(target or "", target)
                if target is not None and target in schema.KINDS:
                    element._given[name] = element._root.look_up(target, value) or value

    def to_xml_string(
        self,
        prefix_root: RootElement | None = None,
        self_only: bool = False,
        pretty_print: bool = True,
        precision: int = 17,
    ) -> str:
        """Return this element as MJCF.

        Args:
            prefix_root: The model to which names are relative; default: the element's own.
            precision: Significant digits of numbers; 17 digits are exact.
        """
        from sim2real.composer.mjcf import compose  # imported late: it walks over elements

        return compose.element_text(self, prefix_root or self._root, self_only, pretty_print, precision)


def _public(name: str) -> str:
    return "dclass" if name == "class" else name


def _types_first(name: str) -> bool:
    """Sort key: attributes such as ``objtype`` precede the attributes that depend on them."""
    return not name.endswith("type")


def bytes_of(text: str) -> int:
    """Return the number of bytes in ``size.memory``."""
    unit = _UNITS.get(text[-1:].lower(), 1)
    return int(text[:-1] if unit > 1 else text) * unit


class ElementList(Sequence[Element]):
    """A live list of the children with one tag, such as ``body.geom`` and ``sensor.gyro``."""

    def __init__(self, parent: Element, tag: str) -> None:
        self._parent, self._tag = parent, tag

    def _find(self) -> list[Element]:
        wanted = (
            (self._tag,)
            if self._tag != self._parent.tag or self._tag not in schema.GROUPS
            else self._parent._spec.children
        )
        return [c for c in self._parent._with_attached() if c._tag in wanted]

    def __len__(self) -> int:
        return len(self._find())

    def __getitem__(self, key: Any) -> Any:
        """Return an element by its number or its name, or a list of them for a slice."""
        elements = self._find()
        if not isinstance(key, str):
            return elements[key]
        top = self._parent._root
        for element in elements:
            if key in (element.dclass if self._tag == "default" else element.name, top.identify(element, top)):
                return element
        raise KeyError(
            f"there is no <{self._tag}> {key!r}. Available: {', '.join(filter(None, (e.name for e in elements)))}"
        )

    def __delitem__(self, key: int | str | slice) -> None:
        for element in self[key] if isinstance(key, slice) else [self[key]]:
            element.remove()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    def __repr__(self) -> str:
        return repr(self._find())

    def clear(self) -> None:
        """Delete all elements of the list."""
        for element in self._find():
            element.remove()


Elements = Element | Iterable[Element]
"""An element, or several of one kind."""


def as_elements(elements: Elements) -> tuple[tuple[Element, ...], bool]:
    """Return elements as a tuple, and whether the argument was a single element.

    Raises:
        UsageError: Something is no element, or the kinds differ.
    """
    if elements is None:
        raise UsageError("nothing to bind: the element is None", hint="find() returns None if it finds nothing")
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
