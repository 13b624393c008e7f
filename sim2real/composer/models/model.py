"""A model: an ``MjSpec`` of one entity, and the models that are attached to it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, ClassVar

from sim2real.composer.models import attaching, builder, compose, duplicate, files, merge, parse, translate
from sim2real.composer.models.attaching import Attachment
from sim2real.composer.models.element import KIND_OF_TAG, Element
from sim2real.composer.models.given import Document, Given, Records
from sim2real.composer.models.sections import SECTION_OF, Section, make_sections
from sim2real.composer.models.translate import TREE_KINDS, mj
from sim2real.errors import UsageError

_ADDED_LATER = 1_000_000_000
"""Elements that were parsed are ordered by their line; those that a program added come after them."""


class Model:
    """The physical parts of one entity, as an ``MjSpec`` that stays editable; PyMJCF calls it ``RootElement``.

    Attached models keep specs of their own: ``compile`` copies them all into one.

    Args:
        model: The name; prefix of all names in it once it is attached.
        spec: An ``MjSpec`` to wrap; default: an empty one.
        document: What the spec was parsed from, where that is known.

    Attributes:
        parent_model: The model that this one is attached to, or None.
        attachments: Name -> what is attached to this one, in order.
        inherits_angle: Whether angles are read in the unit of the model that this one is attached to: so it is until
            ``compiler.angle`` is set, for models that programs make. Documents have a unit of their own.
        overrides: Settings that were written while other models were attached.
    """

    builder: ClassVar[Any] = builder
    """What adds and removes elements; the handles reach it through their model, as it needs them itself."""

    def __init__(self, model: str | None = None, spec: Any = None, document: Document | None = None) -> None:
        self._revision: int | None = 0 if spec is None else None
        self._spec: Any = mj.MjSpec() if spec is None else spec
        self._spec.modelname = model or (self._spec.modelname if spec is not None else "unnamed_model")
        self.check_name("model", self._spec.modelname)
        self._settings: merge.Settings | None = {} if spec is None else None
        self.overrides = merge.Overrides()
        self.inherits_angle = spec is None
        self.parent_model: Model | None = None
        self.attachments: dict[str, Attachment] = {}
        self.references: dict[tuple[Any, str], Element] = {}
        self._handles: dict[Any, Element] = {}
        self._order: dict[Any, int] = {}
        self.records = Records(document, is_blank=spec is None)
        self._clock = itertools.count(_ADDED_LATER)
        self._sections = make_sections(self)

    @classmethod
    def owning(cls, spec: Any, document: Document | None = None) -> Model:
        """Return a model around a spec that nobody else changes: changes are then seen, and results kept till then."""
        model = cls(spec=spec, document=document)
        model._revision = 0
        return model

    @classmethod
    def from_xml_string(cls, xml_string: str | bytes, assets: dict[str, bytes] | None = None) -> Model:
        """Return a model from MJCF; ``assets`` are its files by name."""
        return cls.owning(*parse.from_string(xml_string, assets))

    @classmethod
    def from_path(cls, path: Any, assets: dict[str, bytes] | None = None) -> Model:
        """Return a model from an MJCF file.

        Raises:
            UsageError: When there is no such file.
        """
        return cls.owning(*parse.from_path(path, assets))

    @classmethod
    def from_file(cls, file: Any, assets: dict[str, bytes] | None = None) -> Model:
        """Return a model from an open MJCF file."""
        return cls.from_xml_string(file.read(), assets)

    def __repr__(self) -> str:
        return f"<model {self.model!r}>"

    def __copy__(self) -> Model:
        return duplicate.duplicate(self)

    def __deepcopy__(self, memo: Any) -> Model:
        return duplicate.duplicate(self)

    @property
    def spec(self) -> Any:
        """The ``MjSpec``, without what is attached. Once it was handed out, every compilation starts from scratch."""
        self.expose()
        return self._spec

    def settings(self) -> merge.Settings:
        """Return the options, sizes and visual settings that this model sets, without those of attached models."""
        if self._settings is None or self._revision is None:
            self._settings = merge.settings(self._spec)
        return self._settings

    def touch_settings(self) -> None:
        """Note a change of the options."""
        self._settings = None
        self.touch()

    def reads_degrees(self) -> bool:
        """Return whether angles in this model are in degrees, rather than in radians."""
        if self.inherits_angle and self.parent_model is not None:
            return self.parent_model.reads_degrees()
        return bool(self._spec.compiler.degree)

    def expose(self) -> None:
        """Note that the spec may change from now on without the model knowing."""
        self._revision, self.records.is_blank = None, False

    def touch(self) -> None:
        """Note a change."""
        if self._revision is not None:
            self._revision += 1

    def revision(self) -> int | None:
        """Return a number that grows with every change, or None when changes cannot be seen."""
        return self._revision

    def __getattr__(self, name: str) -> Section:
        try:
            return self.__dict__["_sections"][name]
        except KeyError:
            known = ", ".join(self.__dict__.get("_sections", ()))
            raise AttributeError(f"a model has no {name!r}. Sections: {known}") from None

    @property
    def model(self) -> str:
        """The name."""
        return self._spec.modelname

    @model.setter
    def model(self, name: str) -> None:
        self.check_name("model", name)
        if self.parent_model is not None:
            attaching.rename(self.parent_model, self.model, name)
        self.touch()
        self._spec.modelname = name

    @property
    def name(self) -> str:
        """The name."""
        return self.model

    @property
    def root(self) -> Model:
        """This model itself: elements have a root too."""
        return self

    @property
    def root_model(self) -> Model:
        """The model at the top, that all others are attached to."""
        return self if self.parent_model is None else self.parent_model.root_model

    @property
    def full_identifier(self) -> str:
        """The prefix of all names in this model once it is compiled: ``''`` at the top, else ``arm/hand/``."""
        return "" if self.parent_model is None else f"{self.parent_model.full_identifier}{self.model}/"

    @property
    def worldbody(self) -> Element:
        """The world of this model, which becomes the attachment frame."""
        return self.handle("body", self._spec.worldbody)

    def handle(self, kind: str, native: Any) -> Element:
        """Return the handle on an element of the spec; always the same one."""
        key = (native, kind) if kind == "inertial" else native  # a part of its body
        found = self._handles.get(key)
        if found is None:
            found = self._handles[key] = Element(self, kind, native)
        return found

    def given(self, element: Element) -> Given:
        """Return what was given of an element, rather than left at its default."""
        return self.records.of(element)

    def section_of(self, kind: str) -> Section:
        """Return the section that elements of a kind stand in."""
        return self._sections[SECTION_OF[kind]]

    def default_class(self, name: Any) -> Any:
        """Return a class of defaults by its name."""
        return self.default.find("default", getattr(name, "dclass", name))

    def find_handle(self, native: Any) -> Element:
        """Return the handle on an element that has one."""
        return self._handles[native]

    def all_children(self) -> list[Any]:
        """Return the sections that hold elements, and the world."""
        return [self._sections[name] for name in dict.fromkeys(SECTION_OF.values())] + [self.worldbody]

    def check_name(self, kind: str, name: str | None) -> None:
        """Refuse a name with a slash in it: slashes separate the names of models."""
        if name and "/" in name:
            raise UsageError(f"{kind} name {name!r} contains '/', which separates the names of models")

    def identify(self, element: Element, relative_to: Model | None = None) -> str:
        """Return the compiled name of an element of this model, or its name seen from a model above."""
        prefix = self.prefix(relative_to)
        if element.is_worldbody:
            return prefix or "world"
        if element._native.name:
            return prefix + element._native.name
        number = self.find_all(element.kind, exclude_attachments=True).index(element)
        own = f"/unnamed_{element.kind}_{number}"
        return (prefix or ("/" if relative_to is None else "")) + own

    def prefix(self, relative_to: Model | None) -> str:
        """Return the prefix of this model's names as seen from a model above, or from the top."""
        if self is relative_to or (relative_to is None and self.parent_model is None):
            return ""
        if self.parent_model is None:
            raise UsageError(f"model {self.model!r} is not attached below {relative_to!r}")
        return f"{self.parent_model.prefix(relative_to)}{self.model}/"

    # -- looking for elements

    def find(self, kind: str, identifier: str | None = None, *, name: str | None = None) -> Any:
        """Return the element of a kind with a name such as ``finger`` or ``hand/finger``, or None.

        Kinds besides the elements': ``attachment_frame`` and ``attached_model``.
        """
        identifier = name if identifier is None else identifier
        if identifier is None:
            raise UsageError(f"find({kind!r}) needs a name")
        head, _, tail = identifier.partition("/")
        if tail:
            attachment = self.attachments.get(head)
            return None if attachment is None else attachment.model.find(kind, tail)
        if kind == "default":
            return self.default.find(kind, head)
        if kind in ("attachment_frame", "attached_model"):
            attachment = self.attachments.get(head)
            if attachment is None:
                return None
            return attachment.model if kind == "attached_model" else self.handle("body", attachment.frame)
        if kind == "body" and identifier == "world":
            return self.worldbody
        getter = getattr(self._spec, KIND_OF_TAG.get(kind, kind), None)
        if getter is None:
            raise UsageError(f"{kind!r} is not a kind of element")
        native = getter(identifier)
        return None if native is None else self.handle(KIND_OF_TAG.get(kind, kind), native)

    def enter_scope(self, scope_identifier: str) -> Model | None:
        """Return the model attached under a name such as ``arm/hand``, or None."""
        return self.find("attached_model", scope_identifier.rstrip("/"))

    def find_all(
        self, kind: str, immediate_children_only: bool = False, exclude_attachments: bool = False
    ) -> list[Element]:
        """Return all elements of a kind, in the order of the document: own ones, then those of attached models."""
        kind = KIND_OF_TAG.get(kind, kind)
        if kind in TREE_KINDS:
            return list(self.walk(self._spec.worldbody, kind, immediate_children_only, exclude_attachments))
        natives = getattr(self._spec, translate.plural(kind), None)
        if natives is None:
            raise UsageError(f"{kind!r} is not a kind of element")
        found = [self.handle(kind, n) for n in natives]
        if not exclude_attachments:
            for attachment in self.attachments.values():
                found += attachment.model.find_all(kind)
        return found

    def walk(self, body: Any, kind: str, shallow: bool, own: bool) -> Iterator[Element]:
        """Yield the elements of a kind below a native body, in the order of the document."""
        attachment = self.attachments.get(body.name[:-1]) if body.name.endswith("/") else None
        children = list(getattr(body, translate.plural(kind)))
        if kind != "body" and not shallow:
            children += body.bodies
        for child in sorted(children, key=self._position) if len(children) > 1 else children:
            is_body = child.__class__.__name__ == "MjsBody"
            if not is_body or kind == "body":
                yield self.handle(kind, child)
            if is_body and not shallow:
                yield from self.walk(child, kind, shallow, own)
        if attachment is not None and not own and not shallow:
            yield from attachment.model.find_all(kind)

    def _position(self, native: Any) -> int:
        added = self._order.get(native)
        if added is not None:
            return added
        words = native.info.split()
        return int(words[1]) if len(words) > 1 and words[1].isdigit() else 0

    # -- adding and removing

    def enlist(self, kind: str, native: Any, tag: str, values: dict[str, Any]) -> Element:
        """Note that an element was added after all others, with its tag and attributes; return its handle."""
        self._order[native] = next(self._clock)
        self.records.note(native, tag, values)
        return self.handle(kind, native)

    def strike(self, natives: list[Any]) -> None:
        """Forget elements that are about to be deleted."""
        for native in natives:
            self._order.pop(native, None)
            self.records.forget(native)
            handle = self._handles.pop(native, None)
            if handle is not None:
                object.__setattr__(handle, "_native", None)

    # -- references between elements

    def refer(self, element: Element, key: str, target: Any) -> None:
        """Let an attribute name another element, whatever that is called later."""
        if isinstance(target, Element):
            self.references[element._native, key] = target
            target = target.name or ""
        else:
            self.references.pop((element._native, key), None)
        translate.point(element._native, key, target or "")
        self.touch()

    def referenced(self, element: Element, name: str) -> Any:
        """Return the element that an attribute names, its name where it does not exist, or None."""
        kind = name.rstrip("12")
        if name in ("objname", "refname"):
            kind = self.given(element).values.get(name.replace("name", "type"), "body").replace("xbody", "body")
        key = "target" if element.kind == "actuator" and name in ("joint", "site", "tendon", "body") else None
        key = key or translate.native_name(element.kind, name)
        target = self.references.get((element._native, key))
        text = getattr(element._native, key, self.given(element).values.get(name))
        if isinstance(text, Element):
            return text
        if target is not None or not text:
            return target
        kind = "body" if kind == "target" else kind
        if key == "target" and not hasattr(self._spec, kind):
            return text
        return self.find(kind, text) or text

    # -- attaching

    def attach(self, model: Model) -> Element:
        """Attach a model to this one's world; return the frame."""
        return self.attach_at(self.worldbody, model)

    def attach_at(self, site: Element, model: Model) -> Element:
        """Attach a model at a site of this one or at its world; return the frame, an empty body until compilation.

        Raises:
            UsageError: When the model is attached already, would hold itself, or its options contradict this one's.
        """
        if not isinstance(model, Model):
            raise UsageError(f"Expected a model, got {type(model).__name__}: {model!r}")
        return attaching.attach(self, site, model)

    def detach(self) -> None:
        """Take this model off the one that it is attached to."""
        attaching.detach(self)

    def all_models(self) -> Iterator[Model]:
        """Yield this model and all attached to it, depth first."""
        yield self
        for attachment in self.attachments.values():
            yield from attachment.model.all_models()

    # -- compiling

    def compile(self) -> Any:
        """Return the ``mujoco.MjModel`` of this model with all that is attached to it."""
        return compose.compile_model(self)

    def to_xml_string(self) -> str:
        """Return the composed model as MJCF; its files are called as ``get_assets`` calls them."""
        with files.renamed(self):
            spec = compose.compose(self)
        files.flatten(spec)
        spec.compile()
        return spec.to_xml()

    def get_assets(self) -> dict[str, bytes]:
        """Return the contents of the files that ``to_xml_string`` names: name -> bytes."""
        return files.collect(self)
