"""A model with all attached models as one document, which MuJoCo's parser compiles.

Names of elements and classes of attached models get the prefix ``model/``; elements without a name get a name. The
defaults of one model do not apply to another, so every class has a name: ``/`` for the defaults of the root model,
``model/`` for those of an attached model.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from sim2real.composer.mjcf import files, schema
from sim2real.composer.mjcf.schema import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.mjcf.element import Element
    from sim2real.composer.mjcf.model import RootElement
    from sim2real.types import MjModel

_COSMETIC = ("material", "texture")
"""Attributes that an element does not need: they may refer to a removed element."""
_ANGLES = ("range", "ref", "springref")
_SPECIAL = re.compile('[&<>"\n\r\t]').search
_FOLDERS = ("meshdir", "texturedir", "assetdir")


def compile_model(model: RootElement) -> MjModel:
    """Return the ``mujoco.MjModel`` of a model; raise ValueError with MuJoCo's message if it does not compile."""
    return mj.MjModel.from_xml_string(text(model), assets(model))


def text(model: RootElement, precision: int = 17) -> str:
    """Return a model as MJCF; cached until the model changes."""
    models = [(one, one.changes) for one in model.all_models()]
    if model.written is not None:
        before, arrays, numbers, document = model.written
        if before == (models, precision) and [a.tobytes() for a in arrays] == numbers:
            return document
    writer = _Writer(model, precision=precision)
    document = writer.document()
    numbers = [a.tobytes() for a in writer.arrays]  # a program may write into the array of an attribute
    object.__setattr__(model, "written", ((models, precision), writer.arrays, numbers, document))
    return document


def element_text(element: Element, top: RootElement, self_only: bool, pretty: bool, precision: int) -> str:
    """Return an element as MJCF, with names relative to the model ``top``."""
    writer = _Writer(top, element.root.root_model, precision)
    if self_only:
        attributes = writer.attributes(element)
        if not element._given.get("name") and not element.is_frame:
            attributes.pop("name", None)
        inner = "...</" + element._tag + ">" if element._with_attached() else ""
        return _tag(element._tag, attributes, bool(inner)) + inner + "\n" * pretty
    if element._tag == "default":
        writer.defaults(element)
    elif element._is_setting:
        writer.setting(element._in(element.root.root_model), 0)
        writer.lines = writer.lines or [_tag(element._tag, {})]
    else:
        writer.element(element)
    return "\n".join(writer.lines) + "\n" if pretty else "".join(line.strip() for line in writer.lines)


def assets(model: RootElement) -> dict[str, bytes]:
    """Return name -> contents of the files of a model and of all attached models."""
    found = {}
    for element in model.walk():
        for value in element._given.values():
            if isinstance(value, files.Asset):
                asset = _asset(element, value, model)
                found[asset.get_vfs_filename()] = asset.contents
    return found


def _asset(element: Element, asset: files.Asset, top: RootElement) -> files.Asset:
    prefix = element.root.prefix(top)
    if element._tag != "skin" or not prefix:
        return asset
    # The file has the bones' names in its own model, which may have changed.
    return files.renamed_skin(asset, lambda bone: prefix + bone)


class _Writer:
    """Writes elements line by line, with names relative to the root model."""

    def __init__(self, top: RootElement, world: RootElement | None = None, precision: int = 17) -> None:
        self.top, self.world, self._number = top, world or top, f"%.{precision}g"
        self.lines: list[str] = []
        self.arrays: list[np.ndarray] = []
        self._is_whole = False
        self._unnamed: dict[RootElement, dict[Element, int]] = {}
        self._factors: dict[RootElement, float] = {}
        self._prefixes: dict[RootElement, str] = {}
        self._classed: dict[Element, str | None] = {}

    # -- documents

    def document(self) -> str:
        """Return the whole document."""
        top, self._is_whole = self.top, True
        self.lines.append(f"<mujoco model={quoteattr(top.model)}>")
        for tag in ("compiler", "option", "size", "statistic", "visual"):
            section = top._present(tag)
            if section is not None:
                self.setting(section, 1)
        self.defaults(top._child("default"), 1)
        for tag in top._spec.children:
            if tag not in ("compiler", "option", "size", "statistic", "visual", "default", "keyframe"):
                children = top._child(tag)._with_attached()
                if children:
                    self.lines.append(f"  <{tag}>")
                    for child in children:
                        self.element(child, 2)
                    self.lines.append(f"  </{tag}>")
        keys = top._child("keyframe")._with_attached()
        if keys:
            body = "\n".join(self.lines)
            self.lines.append("  <keyframe>")
            for key in keys:
                self.lines.append("    " + _tag("key", self.attributes(key) | self._numbers(key, body)))
            self.lines.append("  </keyframe>")
        self.lines.append("</mujoco>\n")
        return "\n".join(self.lines)

    def setting(self, element: Element, depth: int) -> None:
        """Write a section of settings, if it is not empty."""
        attributes = self.attributes(element)
        at = len(self.lines)
        for child in element._children:
            self.setting(child, depth + 1)
        if attributes or len(self.lines) > at:
            self._around(element._tag, attributes, at, depth)

    def defaults(self, element: Element, depth: int = 0) -> None:
        """Write a class of defaults; classes of attached models become siblings of the root model's."""
        if element._parent is not element.root:
            self.default(element, depth)
            return
        self.lines.append("  " * depth + "<default>")
        for model in element.root.all_models():
            self.default(model._child("default"), depth + 1)
        self.lines.append("  " * depth + "</default>")

    def default(self, element: Element, depth: int) -> None:
        """Write a class of defaults."""
        at = len(self.lines)
        for child in element._children:
            if child._tag == "default":
                self.default(child, depth + 1)
            elif child._given or child._children:
                self.element(child, depth + 1)
        name = element.root.identify(element, self.top)
        self._around("default", {"class": name or "/"}, at, depth)

    def _around(self, tag: str, attributes: dict[str, str], at: int, depth: int) -> None:
        space = "  " * depth
        if len(self.lines) == at:
            self.lines.append(space + _tag(tag, attributes))
        else:
            self.lines.insert(at, space + _tag(tag, attributes, True))
            self.lines.append(f"{space}</{tag}>")

    def element(self, element: Element, depth: int = 0) -> None:
        """Write an element and all below it."""
        space, tag = "  " * depth, element._tag
        children = element._with_attached()
        attributes = self.attributes(element)
        attached = element._attached
        if self._is_whole and attached is not None and free_body(attached) is not None:
            parent = element._parent
            if children[: len(element._children)] or attached.parent_model is not self.top or not parent.is_worldbody:
                raise UsageError(
                    f"model {attached.model!r} has a free joint: it can only be attached to the world, without joints",
                    hint="remove the free joint from the model and use add_free_entity",
                )
            tag = "frame"
            attributes.pop("name")
        self.lines.append(space + _tag(tag, attributes, bool(children)))
        if children:
            for child in children:
                if not child._spec.implicit or child._given or child._children:
                    self.element(child, depth + 1)
            self.lines.append(f"{space}</{tag}>")

    # -- attributes

    def attributes(self, element: Element) -> dict[str, str]:
        """Return the attributes of an element as text."""
        made, spec, given = {}, element._spec, element._given
        named_by = spec.named_by
        if spec.kind and named_by in spec.attributes and named_by != "class":
            made[named_by] = self._name(element)
            if not made[named_by]:  # a composite in the root model, whose elements MuJoCo names
                del made[named_by]
        if "class" in spec.attributes and "class" not in given and element._tag != "default":
            by_model = self._class(element._parent or element)
            if by_model:
                made["class"] = by_model
        for name in sorted(given, key=spec.attributes.__getitem__):
            value = given[name]
            if name == named_by or name in _FOLDERS or (element._tag == "key" and name in element._key_order):
                continue
            written = self._text(element, name, value)
            if written is not None:
                made[name] = written
        if "name" in made and (element._attached is not None or element._parent._attached is not None):
            made["name"] = made.pop("name")  # PyMJCF writes it last
        factor = self._factor(element.root)
        if factor != 1.0:
            made |= self._turned(element, factor)
        return made

    def _name(self, element: Element) -> str:
        model, name = element._root, element._given.get("name")
        parent: Any = element._parent
        if element._attached is not None or parent._attached is not None or element._tag == "composite":
            return model.identify(element, self.top) or ""
        if name:
            return self._prefix(model) + name
        numbers = self._unnamed.get(model)
        if numbers is None:
            counts: Counter[str] = Counter()
            numbers = self._unnamed[model] = {}
            for one in model.walk(own=True):
                if one._spec.kind:
                    numbers[one] = counts[one._spec.kind]
                    counts[one._spec.kind] += 1
        prefix = model.prefix(self.world)  # as in PyMJCF: the name in the compiled model
        return f"{prefix or '/'}/unnamed_{element.kind}_{numbers[element]}"

    def _prefix(self, model: RootElement) -> str:
        if model not in self._prefixes:
            self._prefixes[model] = model.prefix(self.top)
        return self._prefixes[model]

    def _class(self, above: Element) -> str | None:
        """Return the class of an element without a class; None if a body sets a class for its children."""
        if above not in self._classed:
            if above._given.get("childclass"):
                found = None
            elif above._parent is None:
                found = above._root.identify(above._child("default"), self.top)
            else:
                found = self._class(above._parent)
            self._classed[above] = found
        return self._classed[above]

    def _text(self, element: Element, name: str, value: Any) -> str | None:
        """Return the value of an attribute as text; None if it is not written."""
        if not isinstance(value, str):
            if hasattr(value, "_given"):
                return self._named(element, name, value)
            if isinstance(value, files.Asset):
                return _asset(element, value, self.top).get_vfs_filename()
            if isinstance(value, np.ndarray):
                self.arrays.append(value)
            return self._digits(value)
        model = element._root
        target = schema.reference(element._path, element._tag, name)
        if target == "default" and value == (model._child("default")._given.get("class") or "main"):
            return model.identify(model._child("default"), self.top)
        if target is not None:
            return self._prefix(model) + value
        if element._tag == "flex" and name in ("body", "node"):
            return " ".join(self._prefix(model) + word for word in value.split())
        return value

    def _digits(self, value: Any) -> str:
        """Return a number, or an array, as text."""
        values = np.atleast_1d(value).tolist()
        if values and isinstance(values[0], float):
            return " ".join([self._number] * len(values)) % tuple(values)
        return " ".join(map(str, values))

    def _named(self, element: Element, name: str, target: Element) -> str | None:
        if target.is_removed:
            if name in _COSMETIC:
                return None
            removed = target._key_order.get("name", [""])[0]
            raise UsageError(
                f"{element.kind} {element._given.get('name') or element.full_identifier!r} of model "
                f"{element.root.model!r} refers to the {target.kind} {removed!r}, which was removed",
                hint=f"remove the {element.kind}, too, or let it refer to another {target.kind}",
            )
        return target.root.identify(target, self.top)

    # -- angles

    def _factor(self, model: RootElement) -> float:
        """Return the factor from a model's angles to the root model's unit."""
        if model not in self._factors:
            one, other = model.is_degree, self.world.is_degree
            self._factors[model] = 1.0 if one == other else math.pi / 180 if one else 180 / math.pi
        return self._factors[model]

    def _turned(self, element: Element, factor: float) -> dict[str, str]:
        """Return the attributes of an element that are angles, in the unit of the root model."""
        made, given = {}, element._given
        if "euler" in given and element._tag != "compiler":
            made["euler"] = self._digits(factor * given["euler"])
        if "axisangle" in given:
            made["axisangle"] = self._digits(given["axisangle"] * [1.0, 1.0, 1.0, factor])
        if element._tag == "joint" and "range" in element._spec.attributes:
            scale = factor if turns(element) else 1.0
            for name in _ANGLES:  # also attributes of its classes: a class may serve hinges and slides
                value = inherited(element, name)
                if value is not None:
                    made[name] = self._digits(scale * np.asarray(value))
        if element._tag == "compiler":
            made.pop("angle", None)
        return made

    # -- keyframes

    def _numbers(self, key: Element, body: str) -> dict[str, str]:
        """Return the numbers of a keyframe for the whole world."""
        alone = not self.top.frames
        names = key._key_order
        self.arrays += [key._given[name] for name in names]
        if alone and all(_same(order, key.root.keyed_elements(name)) for name, order in names.items()):
            return {name: self._digits(key._given[name]) for name in names}
        layout = self.top.layout
        if layout is None or layout[0] != body:
            layout = body, mj.MjModel.from_xml_string(f"{body}\n</mujoco>", assets(self.top))
            object.__setattr__(self.top, "layout", layout)
        return {name: self._spread(key, name, layout[1]) for name in names}

    def _spread(self, key: Element, name: str, model: MjModel) -> str:
        """Return an attribute of a keyframe for the whole world; elements without numbers get their defaults."""
        values, order = key._given[name], key._key_order[name]
        everything = [entry for one in key.root.all_models() for entry in one.keyed_elements(name)]
        own = self._placed(order, name, model)
        world = self._placed(everything, name, model)
        width = sum(w for _, w in own)
        if width != values.size:
            if sum(w for _, w in world) != values.size:
                raise UsageError(
                    f"keyframe {key.name!r} of model {key.root.model!r} has {values.size} values for {name}, its model "
                    f"has {width}, and {sum(w for _, w in world)} with the attached ones"
                )
            own = sorted(world, key=lambda place: math.inf if place[0] is None else place[0])
        usual = {"qpos": model.qpos0, "qvel": np.zeros(model.nv), "act": np.zeros(model.na)}
        mocap = [i for i in range(model.nbody) if model.body_mocapid[i] >= 0]
        usual |= {"ctrl": np.zeros(model.nu), "mpos": model.body_pos[mocap], "mquat": model.body_quat[mocap]}
        numbers, at = np.ravel(usual[name]).copy(), 0
        for place, size in own:
            if place is not None:
                numbers[place : place + size] = values[at : at + size]
            at += size
        return self._digits(numbers)

    def _placed(self, order: list[Any], name: str, model: MjModel) -> list[tuple[int | None, int]]:
        """Return start and number of the elements' numbers in the world; None as the start of removed elements.

        A removed element passes its numbers on to an element with the same name.
        """
        places: list[tuple[int | None, int]] = []
        for element, called, hint in order:
            one = element
            if one.is_removed and called:
                one = element._root.look_up(schema.KEYED[name], called)
            places.append((None, hint) if one is None or one.is_removed else self._place(one, name, model))
        return places

    def _place(self, element: Element, name: str, model: MjModel) -> tuple[int, int]:
        called = self._name(element)
        if name in ("qpos", "qvel"):
            number = mj.mj_name2id(model, mj.mjtObj.mjOBJ_JOINT, called)
            kind = int(model.jnt_type[number])
            if name == "qpos":
                return int(model.jnt_qposadr[number]), (7, 4, 1, 1)[kind]
            return int(model.jnt_dofadr[number]), (6, 3, 1, 1)[kind]
        if name in ("act", "ctrl"):
            number = mj.mj_name2id(model, mj.mjtObj.mjOBJ_ACTUATOR, called)
            if name == "act":
                return int(model.actuator_actadr[number]), int(model.actuator_actnum[number])
            return int(model.actuator_ctrladr[number]), int(model.actuator_ctrlnum[number])
        width = 3 if name == "mpos" else 4
        number = mj.mj_name2id(model, mj.mjtObj.mjOBJ_BODY, called)
        return width * int(model.body_mocapid[number]), width


def _same(order: list[Any], now: list[Any]) -> bool:
    return [e for e, *_ in order] == [e for e, *_ in now]


def _tag(tag: str, attributes: dict[str, str], opens: bool = False) -> str:
    inside = "".join(
        [
            f" {name}={quoteattr(value)}" if _SPECIAL(value) else f' {name}="{value}"'
            for name, value in attributes.items()
        ]
    )
    return f"<{tag}{inside}{'' if opens else '/'}>"


def classes(element: Element) -> Iterator[Element]:
    """Yield the classes of defaults of an element, the nearest first."""
    model = element.root
    name, above = element._given.get("class"), element._parent
    while name is None and above is not None:
        name, above = above._given.get("childclass"), above._parent
    found = model.look_up("default", name) if isinstance(name, str) else name
    found = model._child("default") if found is None else found
    while found is not None and found._tag == "default":
        yield found
        found = found._parent


def inherited(element: Element, name: str) -> Any:
    """Return an attribute of an element, or of its classes of defaults; None if none of them has it."""
    if name in element._given:
        return element._given[name]
    holders: Iterator[Element | None]
    if element._parent is not None and element._parent._tag == "default":
        holders = (c._present(element._tag) for c in _upwards(element._parent))
    else:
        holders = (c._present(element._tag) for c in classes(element))
    return next((h._given[name] for h in holders if h is not None and name in h._given), None)


def _upwards(default: Element | None) -> Iterator[Element]:
    while default is not None and default._tag == "default":
        yield default
        default = default._parent


def turns(joint: Element) -> bool:
    """Return whether a joint's range consists of angles."""
    return joint._tag == "joint" and inherited(joint, "type") not in ("slide", "free")


def width_of(element: Element, name: str) -> int:
    """Return how many numbers of a keyframe belong to an element, by its model alone."""
    if name in ("qpos", "qvel"):
        kind = "free" if element._tag == "freejoint" else inherited(element, "type")
        return {"free": 7, "ball": 4}.get(kind, 1) - (name == "qvel" and kind in ("free", "ball"))
    if name == "act":
        stateful = element._tag in ("intvelocity", "cylinder", "muscle") or inherited(element, "timeconst") is not None
        return int(stateful or (inherited(element, "dyntype") or "none") != "none")
    return {"ctrl": 1, "mpos": 3, "mquat": 4}[name]


def free_body(model: RootElement) -> Element | None:
    """Return the first body in a model's world that has a free joint, or None."""
    for body in model._child("worldbody")._children:
        if body._tag == "body" and not body.is_frame:
            for joint in body._children:
                if joint._tag == "freejoint" or (joint._tag == "joint" and inherited(joint, "type") == "free"):
                    return body
    return None
