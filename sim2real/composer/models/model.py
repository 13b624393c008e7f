"""A model: an ``MjSpec`` of one entity, and the models that are attached to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sim2real.composer.models.composition import attach as attaching
from sim2real.composer.models.composition import compose, duplicate
from sim2real.composer.models.element import Element
from sim2real.composer.models.mjcf import files, parse, references, writer
from sim2real.composer.models.mjcf.explicit_values import Document
from sim2real.composer.models.mjcf.schema import SECTION_OF
from sim2real.composer.models.sections import Section, make_sections
from sim2real.composer.models.tree import Tree

if TYPE_CHECKING:
    import os
    from typing import IO

    from sim2real.composer.types import MjModel, MjSpec


class Model(Tree[Element]):
    """The physical parts of one entity, as an ``MjSpec`` that stays editable; PyMJCF calls it ``RootElement``.

    Attached models keep specs of their own: ``compile`` copies them all into one.
    """

    handle_type = Element

    def __init__(self, model: str | None = None, spec: MjSpec | None = None, document: Document | None = None) -> None:
        super().__init__(model, spec, document)
        self._sections = make_sections(self)

    @classmethod
    def from_xml_string(
        cls,
        xml_string: str | bytes,
        assets: dict[str, bytes] | None = None,
        *,
        model_dir: str | os.PathLike[str] = "",
        resolve_references: bool = True,
    ) -> Model:
        """Return a model from MJCF.

        Args:
            assets: Contents of files by name: they are looked for there first.
            model_dir: Where relative paths of files begin; default: the working directory.
            resolve_references: False: attributes that name elements read as text until ``resolve_references()``.
        """
        return cls._owning(*parse.from_string(xml_string, assets, model_dir), resolve_references)

    @classmethod
    def from_path(
        cls, path: str | os.PathLike[str], assets: dict[str, bytes] | None = None, *, resolve_references: bool = True
    ) -> Model:
        """Return a model from an MJCF file.

        Args:
            assets: Contents of files by name: they are looked for there first.

        Raises:
            UsageError: When there is no such file.
        """
        return cls._owning(*parse.from_path(path, assets), resolve_references)

    @classmethod
    def from_file(
        cls,
        file: IO[str] | IO[bytes],
        assets: dict[str, bytes] | None = None,
        *,
        model_dir: str | os.PathLike[str] = "",
        resolve_references: bool = True,
    ) -> Model:
        """Return a model from an open MJCF file."""
        return cls.from_xml_string(file.read(), assets, model_dir=model_dir, resolve_references=resolve_references)

    @classmethod
    def _owning(cls, spec: MjSpec, document: Document, resolve_references: bool) -> Model:
        model = cls.owning(spec, document)
        model.shows_text = not resolve_references
        return model

    def resolve_references(self) -> None:
        """Let attributes that name elements read as elements."""
        self.shows_text = False

    def __copy__(self) -> Model:
        return duplicate.duplicate(self)

    def __deepcopy__(self, memo: dict[int, Any]) -> Model:
        return duplicate.duplicate(self)

    @property
    def spec(self) -> MjSpec:
        """The ``MjSpec``, without attached models. After the first access every compilation starts from scratch."""
        self.expose()
        return self._spec

    def __getattr__(self, name: str) -> Section:
        try:
            return self.__dict__["_sections"][name]
        except KeyError:
            available = ", ".join(self.__dict__.get("_sections", ()))
            raise AttributeError(f"a model has no {name!r}. Sections: {available}") from None

    @property
    def name(self) -> str:
        """The name."""
        return self.model

    def all_children(self) -> list[Section | Element]:
        """Return the sections that hold elements, and the world."""
        return [self._sections[name] for name in dict.fromkeys(SECTION_OF.values())] + [self.worldbody]

    def enter_scope(self, scope_identifier: str) -> Model | None:
        """Return the model attached under a name such as ``arm/hand``, or None."""
        return self.find("attached_model", scope_identifier.rstrip("/"))

    def rename_attachment(self, old: str, new: str) -> None:
        """Rename an attached model's frame; what names the model's elements names them still."""
        references.hold_below(self, f"{old}/")
        super().rename_attachment(old, new)

    # -- attaching

    def attach(self, model: Model) -> Element:
        """Attach a model to this one's world; return the frame."""
        return attaching.attach(self.worldbody, model)

    def detach(self) -> None:
        """Take this model off the one that it is attached to."""
        attaching.detach(self)

    # -- compiling

    def compile(self) -> MjModel:
        """Return the ``mujoco.MjModel`` of this model with all attached models."""
        return compose.compile_model(self)

    def to_xml_string(self) -> str:
        """Return the composed model as MJCF; its files are called as ``get_assets`` calls them.

        The model may be unfinished: moving bodies need no mass yet.
        """
        with files.renamed(self):
            spec = compose.compose(self)
        files.flatten(spec)
        return writer.to_xml(spec)

    def get_assets(self) -> dict[str, bytes]:
        """Return the contents of the files that ``to_xml_string`` names: name -> bytes."""
        return files.collect(self)
