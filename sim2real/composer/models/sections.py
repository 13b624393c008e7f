"""The parts of a model besides its bodies: options, sizes, defaults, assets, actuators, sensors and so on."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.models import builder
from sim2real.composer.models.composition import merge_options
from sim2real.composer.models.defaults import Defaults
from sim2real.composer.models.element import Element
from sim2real.composer.models.element_list import ElementList
from sim2real.composer.models.mjcf import schema, translate
from sim2real.composer.models.mjcf.translate import mj
from sim2real.composer.models.tree import Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.models.tree import Handle
    from sim2real.composer.types import Value

_INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")
_CHOICES = {
    "integrator": {k: getattr(mj.mjtIntegrator, f"mjINT_{k.upper()}") for k in _INTEGRATORS},
    "cone": {k: getattr(mj.mjtCone, f"mjCONE_{k.upper()}") for k in ("pyramidal", "elliptic")},
    "jacobian": {k: getattr(mj.mjtJacobian, f"mjJAC_{k.upper()}") for k in ("dense", "sparse", "auto")},
    "solver": {k: getattr(mj.mjtSolver, f"mjSOL_{k.upper()}") for k in ("PGS", "CG", "Newton")},
}
_BYTES = {"k": 1 << 10, "m": 1 << 20, "g": 1 << 30}
_UNSET = object()


class Section:
    """One section of a model, such as ``option``, ``actuator`` or ``visual.map``.

    Attributes read and set the fields of the ``MjSpec``; ``add`` adds an element to the sections that hold some.

    Args:
        path: Where its fields are in the ``MjSpec``; '' for the spec itself.
    """

    __slots__ = ("_kinds", "_model", "_name", "_path")

    def __init__(self, model: Tree[Handle], name: str, path: str = "", kinds: tuple[str, ...] = ()) -> None:
        for key, value in (("_model", model), ("_name", name), ("_path", path), ("_kinds", kinds)):
            object.__setattr__(self, key, value)

    def __repr__(self) -> str:
        return f"<{self._name} of model {self._model.model!r}>"

    @property
    def tag(self) -> str:
        """The tag in MJCF."""
        return self._name.rsplit(".", 1)[-1]

    @property
    def _native(self) -> Value:
        """Return the part of the ``MjSpec`` that holds the fields."""
        part = self._model._spec
        for step in self._path.split(".") if self._path else ():
            part = getattr(part, step)
        return part

    def add(self, tag: str, **attrs: Value) -> Value:
        """Add an element, such as ``actuator.add('motor', joint=...)``.

        Raises:
            UsageError: Elements of this tag belong to another section.
        """
        if not self._kinds:
            raise UsageError(f"<{self._name}> holds no elements: set its attributes")
        kind = self._kinds[0] if len(self._kinds) == 1 else tag
        if kind not in self._kinds or tag == "plugin":
            hint = schema.FROM_DOCUMENTS if (self._name, tag) in schema.tables() else None
            raise UsageError(
                f"a <{tag}> cannot stand in <{self._name}>. Available: {', '.join(self._kinds)}", hint=hint
            )
        return builder.add_to_section(self._model, kind, tag, attrs)

    def _everything(self) -> list[Element]:
        return [e for kind in self._kinds for e in self._model.find_all(kind)]

    def all_children(self) -> list[Element]:
        """Return the elements of this section, without those of attached models."""
        return [e for kind in self._kinds for e in self._model.find_all(kind, exclude_attachments=True)]

    def to_xml_string(self) -> str:
        """Return the elements of this section as MJCF, without those of attached models.

        Raises:
            UsageError: When it holds no elements but options, which only whole models write.
        """
        if not self._kinds:
            raise UsageError(f"<{self._name}> holds no elements", hint="model.to_xml_string() writes options too")
        inner = "".join(f"{e.to_xml_string()}\n" for e in self.all_children())
        return f"<{self.tag}>\n{textwrap.indent(inner, '  ')}</{self.tag}>" if inner else f"<{self.tag}/>"

    def set_attributes(self, **attrs: Value) -> None:
        """Set several attributes."""
        for name, value in attrs.items():
            setattr(self, name, value)

    def __getattr__(self, name: str) -> Value:
        if name.startswith("__"):
            raise AttributeError(name)
        if name in self._kinds or (self._kinds and (self._name, name) in schema.tables()):
            return ElementList(lambda: [e for e in self._everything() if name in (e.tag, e.kind)], name)
        if self._name == "compiler" and name == "angle":
            return "degree" if self._model.reads_degrees() else "radian"
        if self._name == "visual":
            return Section(self._model, f"visual.{name}", f"visual.{name.rstrip('_')}")
        if self._name == "option" and name == "flag":
            return Flags(self._model)
        if not hasattr(self._native, name):
            raise AttributeError(f"<{self._name}> has no attribute {name!r}. Available: {self._available()}")
        value = merge_options.in_world(self._model, self._path, name, getattr(self._native, name))
        if isinstance(value, np.ndarray):  # which the caller may write into
            self._model.touch_settings()
        return next((k for k, v in _CHOICES[name].items() if v == value), value) if name in _CHOICES else value

    def __setattr__(self, name: str, value: Value) -> None:
        native = self._native
        self._model.touch_settings()
        if self._name == "compiler" and name == "angle":
            native.degree, self._model.inherits_angle = value == "degree", False
            self._model.records.say_angle()
            return
        if self._name == "size" and name == "memory" and isinstance(value, str):
            value = int(float(value.rstrip("kKmMgG")) * _BYTES.get(value[-1].lower(), 1))
        current = getattr(native, name, _UNSET)
        if current is _UNSET:
            raise AttributeError(f"<{self._name}> has no attribute {name!r}. Available: {self._available()}")
        if name in _CHOICES and isinstance(value, str):
            if value not in _CHOICES[name]:
                raise UsageError(f"{name}={value!r} is not valid. Available: {', '.join(_CHOICES[name])}")
            value = int(_CHOICES[name][value])
        if name == "eulerseq":
            native.eulerseq = list(value)
            return
        setattr(native, name, translate.like(current, value))
        merge_options.note(self._model, self._path, name)

    def _available(self) -> str:
        return ", ".join(n for n in dir(self._native) if not n.startswith("_"))


class Flags:
    """``option.flag``: parts of the physics that are switched with ``enable`` and ``disable``."""

    __slots__ = ("_model",)

    def __init__(self, model: Tree[Handle]) -> None:
        object.__setattr__(self, "_model", model)

    def _check(self, name: str) -> None:
        if name not in merge_options.FLAGS:
            raise AttributeError(
                f"<option.flag> has no attribute {name!r}. Available: {', '.join(merge_options.FLAGS)}"
            )

    def __getattr__(self, name: str) -> str:
        self._check(name)
        field, bit = merge_options.FLAGS[name]
        on = bool(getattr(self._model._spec.option, field) & bit) == (field == "enableflags")
        return merge_options.in_world(self._model, merge_options.FLAG, name, "enable" if on else "disable")

    def __setattr__(self, name: str, value: str) -> None:
        self._check(name)
        if value not in ("enable", "disable"):
            raise UsageError(f"option.flag.{name}={value!r} is not valid. Available: disable, enable")
        merge_options.set_flag(self._model._spec, name, value)
        merge_options.note(self._model, merge_options.FLAG, name)


class DocumentsOnly:
    """A section that documents may have, and programs cannot add to: plug-ins and flexes."""

    __slots__ = ("_name",)

    def __init__(self, name: str) -> None:
        self._name = name

    def add(self, tag: str, **attrs: Value) -> Value:
        """Refuse; UsageError always."""
        raise UsageError(f"a <{tag}> cannot be added to <{self._name}> by a program", hint=schema.FROM_DOCUMENTS)


def make_sections(model: Tree[Handle]) -> dict[str, Value]:
    """Return the sections of a model by name."""
    sections: dict[str, Value] = {name: Section(model, name, "", kinds) for name, kinds in schema.SECTIONS.items()}
    for name, path in (("option", "option"), ("size", ""), ("compiler", "compiler"), ("visual", "visual")):
        sections[name] = Section(model, name, path)
    sections["statistic"] = Section(model, "statistic", "stat")
    sections |= {name: DocumentsOnly(name) for name in ("extension", "deformable")}
    sections["default"] = Defaults(model, "main")
    return sections
