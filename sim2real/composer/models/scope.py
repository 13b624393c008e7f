"""One model among others: its name, its parent and attached models, its settings, its changes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Self, TypeVar

from sim2real.composer.models.composition import merge_options
from sim2real.composer.models.mjcf.translate import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import MjSpec, Native

T = TypeVar("T", bound="Scope")


@dataclass(eq=False)
class Attachment(Generic[T]):
    """A model below another one, and the empty body that holds its place there."""

    model: T
    frame: Native


class Scope:
    """A spec of its own among those of other models: PyMJCF calls it a namescope.

    Attributes:
        parent_model: The model that this one is attached to, or None.
        attachments: Name -> attached model and its frame, in order.
        inherits_angle: Whether angles are read in the unit of the model that this one is attached to: so it is until
            ``compiler.angle`` is set, for models that programs make. Documents have a unit of their own.
        overrides: Settings that were written while other models were attached.
    """

    def __init__(self, model: str | None = None, spec: MjSpec | None = None) -> None:
        self._revision: int | None = 0 if spec is None else None
        self._spec: MjSpec = mj.MjSpec() if spec is None else spec
        self._spec.modelname = model or (self._spec.modelname if spec is not None else "unnamed_model")
        self.check_name("model", self._spec.modelname)
        self._settings: merge_options.Settings | None = {} if spec is None else None
        self.overrides = merge_options.Overrides()
        self.inherits_angle = spec is None
        self.parent_model: Self | None = None
        self.attachments: dict[str, Attachment[Self]] = {}

    def __repr__(self) -> str:
        return f"<model {self.model!r}>"

    # -- changes

    def settings(self) -> merge_options.Settings:
        """Return the options, sizes and visual settings that this model sets, without those of attached models."""
        if self._settings is None or self._revision is None:
            self._settings = merge_options.settings(self._spec)
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
        """Mark that the spec may change from now on without a call of the model."""
        self._revision = None

    def touch(self) -> None:
        """Note a change."""
        if self._revision is not None:
            self._revision += 1

    def revision(self) -> int | None:
        """Return a number that grows with every change, or None when changes cannot be seen."""
        return self._revision

    # -- names

    @property
    def model(self) -> str:
        """The name."""
        return self._spec.modelname

    @model.setter
    def model(self, name: str) -> None:
        self.check_name("model", name)
        if self.parent_model is not None:
            self.parent_model.rename_attachment(self.model, name)
        self.touch()
        self._spec.modelname = name

    @property
    def root(self) -> Self:
        """This model itself: elements have a root too."""
        return self

    @property
    def root_model(self) -> Self:
        """The model at the top, that all others are attached to."""
        return self if self.parent_model is None else self.parent_model.root_model

    @property
    def full_identifier(self) -> str:
        """The prefix of all names in this model once it is compiled: ``''`` at the top, else ``arm/hand/``."""
        return "" if self.parent_model is None else f"{self.parent_model.full_identifier}{self.model}/"

    def check_name(self, kind: str, name: str | None) -> None:
        """Refuse a name with a slash in it: slashes separate the names of models."""
        if name and "/" in name:
            raise UsageError(f"{kind} name {name!r} contains '/', which separates the names of models")

    def prefix(self, relative_to: Scope | None) -> str:
        """Return the prefix of this model's names as seen from a model above, or from the top."""
        if self is relative_to or (relative_to is None and self.parent_model is None):
            return ""
        if self.parent_model is None:
            raise UsageError(f"model {self.model!r} is not attached below {relative_to!r}")
        return f"{self.parent_model.prefix(relative_to)}{self.model}/"

    def rename_attachment(self, old: str, new: str) -> None:
        """Rename an attached model's frame, with the frame's joints."""
        if new in self.attachments and new != old:
            raise UsageError(
                f"model {self.model!r} has {new!r} attached already. Attached: {', '.join(self.attachments)}"
            )
        frame = self.attachments[old].frame
        for native in (frame, *frame.joints):
            native.name = f"{new}/" + native.name[len(old) + 1 :]
        self.attachments = {new if k == old else k: v for k, v in self.attachments.items()}

    def all_models(self) -> Iterator[Self]:
        """Yield this model and all attached to it, depth first."""
        yield self
        for attachment in self.attachments.values():
            yield from attachment.model.all_models()
