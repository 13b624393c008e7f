"""A model: the MJCF tree of one entity, with the models that are attached to it."""

from __future__ import annotations

import copy
import functools
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from sim2real.composer.mjcf import compose, schema
from sim2real.composer.mjcf.element import Element, bytes_of
from sim2real.composer.mjcf.files import NoSuchFileError
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.types import MjModel, MjSpec

_log = logging.getLogger(__name__)
_MOST_INCLUDES = 50
"""Largest depth of documents that include each other."""
SETTINGS = ("compiler", "option", "size", "statistic", "visual")


class RootElement(Element):
    """The physical parts of one entity, as an MJCF tree; attached models keep their own trees.

    Attributes:
        parent_model: The model to which this one is attached, or None.
        frames: Attached model -> its frame, in the order of attachment.
        assets: Name of a file -> its contents, for files that are given in memory.
        model_dir: Folder to which paths of files are relative.
        is_document: Whether it was read from a document, in which angles are in degrees by default.
        changes: A number that every change alters, except writing into an attribute's array.
        written: Cached result of ``to_xml_string``, with its arguments.
    """

    __slots__ = (
        *("__weakref__", "_name", "_names", "assets", "changes", "frames", "is_document", "layout", "model_dir"),
        *("parent_model", "written"),
    )

    def __init__(
        self, model: str | None = None, model_dir: str | os.PathLike[str] = "", assets: dict[str, bytes] | None = None
    ) -> None:
        super().__init__(schema.root(), None, self)
        made = {"_name": "", "_names": {}, "assets": assets or {}, "changes": -1, "frames": {}, "is_document": False}
        made |= {"layout": None, "model_dir": os.fspath(model_dir), "parent_model": None, "written": None}
        for name, value in made.items():
            object.__setattr__(self, name, value)
        self.model = model or "unnamed_model"

    @classmethod
    def from_xml_string(
        cls,
        xml_string: str | bytes,
        assets: dict[str, bytes] | None = None,
        *,
        model_dir: str | os.PathLike[str] = "",
        resolve_references: bool = True,
    ) -> RootElement:
        """Return a model from MJCF.

        Args:
            assets: Contents of files by name, which are searched first.
            model_dir: Folder to which paths of files are relative; default: the working directory.
            resolve_references: Whether attributes that refer to elements return elements; otherwise they return names
                until ``resolve_references()``.
        """
        return _from_text(xml_string, "the document", Path(model_dir), assets or {}, resolve_references)

    @classmethod
    def from_path(
        cls, path: str | os.PathLike[str], assets: dict[str, bytes] | None = None, *, resolve_references: bool = True
    ) -> RootElement:
        """Return a model from an MJCF file; UsageError when there is none.

        Args:
            assets: Contents of files by name: they are looked for there first.
        """
        path = Path(path)
        if not path.is_file():
            raise NoSuchFileError(f"there is no MJCF file {str(path)!r}", hint="give the path of a file that exists")
        return _from_text(path.read_bytes(), str(path), path.parent, assets or {}, resolve_references)

    @classmethod
    def from_file(
        cls,
        file: IO[str] | IO[bytes],
        assets: dict[str, bytes] | None = None,
        *,
        model_dir: str | os.PathLike[str] = "",
        resolve_references: bool = True,
    ) -> RootElement:
        """Return a model from an open MJCF file."""
        return cls.from_xml_string(file.read(), assets, model_dir=model_dir, resolve_references=resolve_references)

    def __repr__(self) -> str:
        return f"<model {self.model!r}>"

    __str__ = __repr__

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "model":
            RootElement.model.__set__(self, value)
        else:
            super().__setattr__(name, value)

    @property
    def name(self) -> str:
        """The name."""
        return self._name

    def __copy__(self) -> RootElement:
        return self.__deepcopy__({})

    def __deepcopy__(self, memo: dict[int, Any]) -> RootElement:
        copies: dict[Element, Element] = {}
        made = _copied(self, copies)
        for element in copies.values():  # references to elements of the copied models become references to the copies
            for name, value in element._given.items():
                if isinstance(value, Element):
                    element._given[name] = copies.get(value, value)
            for name, order in element._key_order.items():
                element._key_order[name] = [(copies.get(e, e), *rest) for e, *rest in order]
        return made

    def get_attributes(self) -> dict[str, Any]:
        """Return the explicit attributes: the model's name."""
        return {"model": self.model}

    # -- names and models

    @property
    def model(self) -> str:
        """The name."""
        return self._name

    @model.setter
    def model(self, name: str) -> None:
        if "/" in name:
            raise UsageError(f"model name {name!r} contains '/', which separates the names of models")
        parent: RootElement | None = self.parent_model
        if parent is not None and any(m.model == name for m in parent.frames if m is not self):
            attached = ", ".join(m.model for m in parent.frames)
            raise UsageError(f"model {parent.model!r} has {name!r} attached already. Attached: {attached}")
        self._note_change()
        object.__setattr__(self, "_name", name)

    @property
    def root_model(self) -> RootElement:
        """The root model, to which all others are attached."""
        return self if self.parent_model is None else self.parent_model.root_model

    @property
    def full_identifier(self) -> str:
        """The prefix of all names in this model when it is compiled: ``''`` for the root model, else ``arm/hand/``."""
        return self.prefix(self.root_model)

    def all_models(self) -> Iterator[RootElement]:
        """Yield this model and all attached to it, depth first."""
        yield self
        for model in self.frames:
            yield from model.all_models()

    def prefix(self, top: RootElement) -> str:
        """Return the prefix of this model's names relative to a model above."""
        if self is top:
            return ""
        if self.parent_model is None:
            raise UsageError(
                f"model {top.model!r} refers to model {self.model!r}, which is not attached below it",
                hint="attach it first, or add the referring element to a model above both",
            )
        return f"{self.parent_model.prefix(top)}{self.model}/"

    def identify(self, element: Element, top: RootElement | None = None) -> str | None:
        """Return the name of an element of this model relative to a model above; default: the root model."""
        prefix = self.prefix(top or self.root_model)
        if element.is_worldbody:
            return prefix or "world"
        if element._attached is not None:
            return f"{prefix}{element._attached.model}/"
        name = element._given.get(element._spec.named_by)
        if element.tag == "default":
            return prefix + ("" if element._parent is self else name or "") or "/"
        if not element._spec.kind:
            return None
        parent = element._parent
        if parent is not None and parent.is_frame:
            return f"{self.identify(parent, top)}{name}/" if name else self.identify(parent, top)
        if name or element.tag == "composite":  # MuJoCo names its elements; the model's prefix precedes these names
            return prefix + (name or "")
        peers = self.find_all(element.kind, exclude_attachments=True)
        number = next(i for i, peer in enumerate(peers) if peer is element)
        return f"{prefix or '/'}/unnamed_{element.kind}_{number}"

    def rename(self, element: Element, old: str | None, new: str | None) -> None:
        """Give an element of this model another name; raise UsageError if the name is not allowed."""
        parent = element._parent
        if new is not None and (not isinstance(new, str) or "/" in new):
            raise UsageError(f"{element.kind} name {new!r} is no text without '/', which separates the names of models")
        if not element._spec.kind or (parent is not None and parent.is_frame):
            return
        if element.kind == "body" and new == "world":
            raise UsageError("A body cannot be named 'world': that is the world's name.")
        names = self._names.setdefault(element.kind, {})
        if new is not None and names.get(new, element) is not element:
            raise UsageError(f"Duplicated identifier {new!r} in namespace <{element.kind}>")
        if old is not None and names.get(old) is element:
            del names[old]
        if new is not None:
            names[new] = element

    def get(self, kind: str, identifier: str) -> Any:
        """Return the element of a kind with a name; raise KeyError if there is none."""
        found = self.look_up(kind, identifier)
        if found is None:
            raise KeyError(f"there is no {kind} {identifier!r}")
        return found

    def look_up(self, kind: str, identifier: str | None) -> Any:
        """Return the element of a kind with a name in this model or those attached, or None.

        Args:
            kind: Kind of elements, or ``attachment_frame``, ``attached_model``.
        """
        if not isinstance(kind, str) or not isinstance(identifier, str):
            raise UsageError(f"find needs a kind and a name, got {kind!r} and {identifier!r}")
        kind = schema.KIND_OF_TAG.get(kind, kind)
        if kind not in (*schema.KINDS, "attached_model"):
            raise UsageError(f"{kind!r} is not a valid namespace. Available: {', '.join(schema.KINDS)}")
        head, slash, tail = identifier.partition("/")
        if slash or kind in ("attachment_frame", "attached_model"):
            model = next((m for m in self.frames if m.model == head), None)
            if slash:
                return None if model is None else model.look_up(kind, tail)
            return model if model is None or kind == "attached_model" else self.frames[model]
        if kind == "body" and identifier == "world":
            return self.worldbody
        return self._names.get(kind, {}).get(identifier)

    # -- attaching

    @property
    def is_degree(self) -> bool:
        """Whether angles in this model are in degrees, rather than in radians."""
        angle = self._child("compiler")._given.get("angle")
        if angle is None and not self.is_document and self.parent_model is not None:
            return self.parent_model.is_degree
        return angle != "radian"

    def attach(self, attachment: RootElement) -> Element:
        """Attach a model to this one's world; return the frame."""
        return self.worldbody.attach(attachment)

    def adopt(self, model: RootElement) -> None:
        """Register a model as attached, before it has a frame; raise UsageError if it cannot be attached."""
        if not isinstance(model, RootElement):
            raise UsageError(f"Expected a mjcf.RootElement: got {type(model).__name__}: {model!r}")
        if model.parent_model is not None:
            raise UsageError(f"The model {model.model!r} is already attached elsewhere", hint="detach it first")
        if model is self.root_model:
            raise UsageError(f"Cannot merge a model to itself: {model.model!r}")
        for element, name, value in list(_merged(model, self.root_model)):
            element._note_change()
            element._given[name] = copy.copy(value)
        taken = {m.model for m in self.frames}
        names = (model.model if i == 0 else f"{model.model}_{i}" for i in range(len(taken) + 1))
        model.model = next(n for n in names if n not in taken)
        object.__setattr__(model, "parent_model", self)
        for section in model._children:
            self._child(section._tag)
        self._warn_of_degrees(model)

    def _warn_of_degrees(self, model: RootElement) -> None:
        """Warn if dm_control would read a document's angles in another unit than MuJoCo, which reads degrees."""
        if self.is_degree or not model.is_document or model.compiler.angle is not None:
            return
        joints = model.find_all("joint", exclude_attachments=True)
        angles = ("range", "ref", "springref")
        if any(compose.turns(j) and any(compose.inherited(j, a) is not None for a in angles) for j in joints):
            _log.warning(
                "the document of model %r does not say in which unit its angles are: they are read in degrees, as "
                "MuJoCo reads them, also below %r, whose unit is the radian. hint: set compiler.angle of the model to "
                "'degree' or 'radian'",
                model.model,
                self.model,
            )

    def detach(self) -> None:
        """Detach this model from the model to which it is attached."""
        parent = self.parent_model
        if parent is None:
            raise UsageError(f"Cannot detach model {self.model!r}: it is not attached")
        for section in [c for c in self.root_model._children if c.tag in SETTINGS]:  # settings stay as they were shared
            for element in section.walk(own=True):
                kept = {k: copy.copy(v) for k, v in element._given.items() if k not in schema.OWN_SETTINGS}
                element._in(self)._given.update(kept)
        self._note_change()
        frame = parent.frames.pop(self)
        object.__setattr__(self, "parent_model", None)
        frame._attached = None
        frame.remove()

    # -- keyframes

    def keyed_elements(self, name: str) -> list[Any]:
        """Return the elements to which the numbers of a keyframe's attribute belong, with names and widths."""
        elements = self.find_all(schema.KEYED[name], exclude_attachments=True)
        if schema.KEYED[name] == "body":
            elements = [e for e in elements if e._given.get("mocap") == "true"]
        return [(e, e._given.get("name"), compose.width_of(e, name)) for e in elements]

    # -- compiling

    def compile(self) -> MjModel:
        """Return the ``mujoco.MjModel`` of this model with all attached models; ValueError if it does not compile."""
        return compose.compile_model(self)

    def to_xml_string(self, *args: Any, precision: int = 17, **kwargs: Any) -> str:
        """Return the composed model as MJCF, with the names of files in ``get_assets``."""
        del args, kwargs
        return compose.text(self, precision)

    def get_assets(self) -> dict[str, bytes]:
        """Return name -> contents of the files in ``to_xml_string``."""
        return compose.assets(self)

    def to_spec(self) -> MjSpec:
        """Return a new ``mujoco.MjSpec`` of the composed model."""
        return schema.mj.MjSpec.from_string(self.to_xml_string(), assets=self.get_assets())


def _merged(model: RootElement, top: RootElement) -> Iterator[tuple[Element, str, Any]]:
    """Yield the settings that the root model takes over from an attached model."""
    for section in [c for c in model._children if c.tag in SETTINGS]:
        for element in section.walk(own=True):
            target = element._in(top)
            for name, value in element._given.items():
                if name in schema.OWN_SETTINGS:
                    continue
                old = target._given.get(name)
                if old is None or (name not in schema.SMALLER | schema.LARGER and np.array_equal(old, value)):
                    yield target, name, value
                elif name in schema.SMALLER | schema.LARGER:
                    old, value = (bytes_of(v) if name == "memory" else v for v in (old, value))
                    merged = min(old, value) if name in schema.SMALLER else max(old, value)
                    yield target, name, str(merged) if name == "memory" else merged
                else:
                    raise UsageError(
                        f"Conflicting values for attribute `{name}` of <{element.tag}>: {old} in model {top.model!r} "
                        f"and {value} in model {model.model!r}"
                    )


def _copied(model: RootElement, copies: dict[Element, Element]) -> RootElement:
    made_model = RootElement(model.model, model.model_dir, dict(model.assets))
    object.__setattr__(made_model, "is_document", model.is_document)
    copies[model] = made_model

    def fill(old: Element, new: Element) -> None:
        copies[old] = new
        for name, value in old._given.items():
            new._given[name] = value.copy() if isinstance(value, np.ndarray) else value
        if old._key_order:
            new._key_order = dict(old._key_order)
        new._children.clear()
        for child in old._children:
            made = Element(child._spec, new, made_model)
            new._children.append(made)
            if child._attached is not None:
                attached = _copied(child._attached, copies)
                made._attached = attached
                object.__setattr__(attached, "parent_model", made_model)
            fill(child, made)
            made_model.rename(made, None, made._given.get(made._spec.named_by))

    fill(model, made_model)
    for attached, frame in model.frames.items():
        new: Any = copies[attached]
        made_model.frames[new] = copies[frame]
    return made_model


def _from_text(text: str | bytes, what: str, folder: Path, assets: dict[str, bytes], resolves: bool) -> RootElement:
    word = "file" if isinstance(text, str) else b"file"
    if assets or word in text:  # pyright: ignore[reportOperatorIssue]
        return _from_node(_parsed(text, what), folder, folder, assets, resolves)
    return copy.copy(_document(text, what, folder, resolves))


@functools.lru_cache(maxsize=32)
def _document(text: str | bytes, what: str, folder: Path, resolves: bool) -> RootElement:
    """Return the model of a document without files; cached, because worlds often have many copies of a model."""
    return _from_node(_parsed(text, what), folder, folder, {}, resolves)


def _parsed(text: str | bytes, what: str) -> ElementTree.Element:
    try:
        node = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UsageError(f"{what} is no XML: {error}") from None
    if not node.tag.startswith("mujoco"):
        raise UsageError(f"{what} begins with <{node.tag}> instead of <mujoco>")
    return node


def _from_node(
    node: ElementTree.Element, folder: Path, beside: Path, assets: dict[str, bytes], resolves: bool
) -> RootElement:
    model = RootElement(node.get("model"), str(folder) if str(folder) != "." else "", assets)
    object.__setattr__(model, "is_document", True)
    _include(node, folder, beside, assets, 0)
    # Set folders of files first, and references last, because they need all elements.
    for compiler in node.findall("compiler"):
        _fill(model.compiler, compiler)
        node.remove(compiler)
    _fill(model, node)
    if resolves:
        model.resolve_references()
    for key in model._child("keyframe")._children:
        for name in schema.KEYED.keys() & key._given.keys():
            key._key_order[name] = model.keyed_elements(name)
    return model


def _include(node: ElementTree.Element, folder: Path, beside: Path, assets: dict[str, bytes], level: int) -> None:
    """Insert the contents of included documents."""
    if level > _MOST_INCLUDES:
        raise UsageError(f"{beside} has documents that include each other", hint="remove the circle")
    for number, child in reversed(list(enumerate(node))):
        if child.tag != "include":
            _include(child, folder, beside, assets, level)
            continue
        file = child.get("file", "")
        path = next((p for p in (folder / file, beside / file) if p.is_file()), None)
        if file not in assets and path is None:
            raise NoSuchFileError(
                f"the document includes {file!r}, which does not exist",
                hint=f"looked for {folder / file}; from_xml_string takes model_dir and assets",
            )
        part = _parsed(assets[file] if file in assets or path is None else path.read_bytes(), file)
        _include(part, folder, (path or folder / file).parent, assets, level + 1)
        node[number : number + 1] = list(part)


def _fill(element: Element, node: ElementTree.Element) -> None:
    """Give an element the attributes and children of a node."""
    for name in sorted(node.attrib, key=lambda n: not n.endswith("type")):
        if element.tag != "mujoco" or name != "model":
            element._set(element._checked(name), node.attrib[name])
    for child in node:
        spec = element._spec.children.get(child.tag)
        if spec is None:
            available = ", ".join(sorted(element._spec.children)) or "nothing"
            raise UsageError(f"<{child.tag}> is not a valid child of <{element.tag}>. Available: {available}")
        if spec.implicit:
            part = element._child(child.tag)
            if element.tag == "default":  # as MuJoCo reads a document
                element._children.remove(part)
                element._children.append(part)
            _fill(part, child)
            continue
        made = element.add(child.tag, **child.attrib)
        child.attrib.clear()
        _fill(made, child)
