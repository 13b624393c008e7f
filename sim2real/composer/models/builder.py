"""Adding elements to a model, and taking them away."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.models.mjcf import explicit_values, files, references, schema, tendon_paths, translate
from sim2real.composer.models.mjcf.references import REFERENCES, refer
from sim2real.composer.models.mjcf.schema import KIND_OF_TAG
from sim2real.composer.models.mjcf.translate import TREE_KINDS
from sim2real.composer.models.tree import H, Handle, Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import NativeDefault, Value

_SHORTCUT_ATTRIBUTES = ("dyntype", "dynprm", "gaintype", "gainprm", "biastype", "biasprm")
"""Attributes that every actuator except ``<general>`` sets for the user."""


def add_to_body(model: Tree[H], body: H, tag: str, attrs: dict[str, Value]) -> H:
    """Add an element to a body of this model.

    Args:
        attrs: Its attributes in MJCF; they are put under PyMJCF's names.
    """
    if tag == "inertial":
        return _add_inertial(model, body, attrs)
    kind = KIND_OF_TAG.get(tag, tag)
    name = attrs.get("name")
    if name is not None:
        model.check_name(kind, name)
    # Add the native element with the defaults of its class; MuJoCo cannot look up a class of another model.
    foreign = _foreign(model, attrs["dclass"]) if "dclass" in attrs else None
    defaults = None if foreign else _defaults(model, attrs)
    if tag == "freejoint":
        native = body._native.add_freejoint()
    else:
        adder = getattr(body._native, f"add_{kind}")
        native = adder() if defaults is None or kind == "body" else adder(defaults)
    if foreign:
        translate.reset(native, getattr(foreign.native, kind))
    # Set the attributes; MuJoCo's parser reads those that the spec does not hold.
    element = model.enlist(kind, native, tag, _renamed(attrs))
    try:
        if name is not None:
            native.name = name
        named = REFERENCES.get(kind, ())
        for key, value in tuple(attrs.items()):
            if key in ("name", "dclass"):
                continue
            if key == "childclass":
                translate.assign(native, kind, key, getattr(value, "dclass", value))
            elif key in named or isinstance(value, Handle):
                refer(element, translate.native_name(kind, key), value)
            elif translate.is_plain(native, kind, key, value):
                translate.assign(native, kind, key, value)
            else:
                rebuild(model, element, key)
    except Exception:
        remove(model, element)
        raise
    if kind == "joint" and body.is_frame:  # joints of a frame are called after it
        _name_frame_joint(model, body, element, name)
    model.touch()
    return element


def _name_frame_joint(model: Tree[H], frame: H, joint: H, name: str | None) -> None:
    full = frame._native.name + (f"{name}/" if name else "")
    if model._spec.joint(full) is not None:
        remove(model, joint)
        raise UsageError(
            f"the attachment frame {frame.full_identifier!r} has a joint {full!r} already",
            hint='give each of its joints a name: frame.add("joint", name="x", ...)',
        )
    joint._native.name = full


def add_to_section(model: Tree[H], kind: str, tag: str, attrs: dict[str, Value]) -> H:
    """Add an element outside of bodies; MuJoCo's parser reads its attributes.

    Args:
        attrs: Its attributes in MJCF; they are put under PyMJCF's names.
    """
    model.check_name(kind, attrs.get("name"))
    if kind in ("numeric", "text", "tuple") and not attrs.get("name"):
        raise UsageError(f"a <{tag}> needs a name", hint=f'custom.add("{tag}", name=...)')
    defaults = _defaults(model, attrs)
    adder = getattr(model._spec, f"add_{kind}")
    native = adder() if defaults is None else adder(defaults)
    element = model.enlist(kind, native, tag, _renamed(attrs))
    try:
        native.name = attrs.get("name") or ""
        _lay_down(model, element)
    except Exception:
        remove(model, element)
        raise
    return element


def _lay_down(model: Tree[Handle], element: Handle) -> None:
    """Set the explicit attributes of an element, as MuJoCo's parser reads them; the rest stays."""
    native, kind, record = element._native, element.kind, element.recorded()
    values = {k: v for k, v in record.values.items() if k not in ("name", "dclass")}
    if ("reftype" in values) != ("refname" in values):  # a program sets one after the other
        values = {k: v for k, v in values.items() if k not in ("reftype", "refname")}
    is_shortcut = kind == "actuator" and record.tag != "general"
    if is_shortcut and model.records.has_defaults:  # their parser sets all of these, for every class
        translate.reset(native, translate.blank(kind), _SHORTCUT_ATTRIBUTES)
        values = _inherited(element) | values
    if kind in files.KINDS:
        values = {k: files.adopt(model, v) if isinstance(v, files.Asset) else v for k, v in values.items()}
    naming = [k for k in REFERENCES.get(kind, ()) if k in values]
    _fill(model, element, *translate.from_xml(kind, record.tag, values, naming))
    for key in translate.ORIENTATIONS & values.keys():
        translate.assign(native, kind, key, values[key])


def _inherited(element: Handle) -> dict[str, Value]:
    """Return what the classes of an element say of its own tag: the nearest one's word counts."""
    inherited: dict[str, Value] = {}
    valid = schema.attributes(element.kind, element.tag)
    for record in class_records(element):
        if record.tag == element.tag:  # the last one that was spoken of: a class has one actuator for all tags
            inherited = {k: v for k, v in record.values.items() if k in valid} | inherited
    return inherited


def _fill(model: Tree[Handle], element: Handle, fixed: Mapping[str, Value], named: dict[str, Value]) -> None:
    """Set what MuJoCo's parser read: plain attributes, and those that name elements."""
    native = element._native
    for key, value in fixed.items():
        setattr(native, key, value)
    for key, value in named.items():
        if isinstance(value, Handle):
            refer(element, key, value)
        elif isinstance(value, list) and any(isinstance(v, Handle) for v in value):
            setattr(native, key, ["" if isinstance(v, Handle) else v for v in value])
            for i, item in enumerate(value):
                if isinstance(item, Handle):
                    refer(element, f"{key}[{i}]", item)
        else:
            setattr(native, key, value)
    model.touch()


def rebuild(model: Tree[Handle], element: Handle, key: str | None = None) -> None:
    """Set all attributes of an element again: the defaults of its class, then the explicit ones, as MuJoCo reads them.

    For attributes with several native ones, such as a servo's ``kp``, and for removed ones.

    Args:
        key: The attribute that was set or taken back; None: its class changed.

    Raises:
        AttributeError: When such an element has no such attribute.
    """
    native, kind, record = element._native, element.kind, element.recorded()
    valid = schema.attributes(kind, record.tag)
    if key is not None and key not in valid:
        available = ", ".join(sorted(valid))
        raise AttributeError(f"{key!r} is not a valid attribute for <{record.tag}>. Available: {available}")
    if key is not None and kind in ("body", "inertial"):  # whose children and inertia are no attributes of its own
        translate.reset(native, element.class_defaults, (translate.native_name(kind, key),))
        model.touch()
        return
    # Reset the element to its defaults, and drop its references.
    _catch_up(element, record.values, key)
    native_only = {
        k: record.values.pop(k) for k in list(record.values) if k not in valid and k not in ("name", "dclass")
    }
    foreign = _foreign(model, record.values.get("dclass"))
    translate.reset(native, getattr(foreign.native, kind) if foreign else element.class_defaults)
    for reference in [r for r in model.references if r[0] is native]:
        del model.references[reference]
    # Set the explicit attributes again, those in MuJoCo's spelling last.
    try:
        _lay_down(model, element)
        for extra, value in native_only.items():
            translate.assign(native, kind, extra, value)
    finally:
        record.values.update(native_only)


def _catch_up(element: Handle, explicit: dict[str, Value], key: str | None) -> None:
    """Update explicit attributes: a program may have written into arrays, or renamed referenced elements."""
    for name in REFERENCES.get(element.kind, ()):
        target = references.held(element, name) if name in explicit and name != key else None
        if target is not None:
            explicit[name] = target
    for name in explicit:
        if name in ("name", "dclass") or name in REFERENCES.get(element.kind, ()):
            continue
        try:
            value = translate.read(element._native, element.kind, name)
        except AttributeError:
            continue
        if isinstance(value, np.ndarray):
            explicit[name] = np.array(explicit_values.show(value, explicit[name]))


def reclass(model: Tree[Handle], element: Handle, name: str, value: Value) -> None:
    """Give an element, or those of a body, another class of defaults: ``name`` is ``dclass`` or ``childclass``."""
    value = getattr(value, "dclass", value)
    element.recorded().note(name, value)
    if name == "childclass":
        element._native.childclass = value or ""
        followers = [e for kind in TREE_KINDS if kind != "body" for e in model.walk(element._native, kind, False, True)]
    else:
        followers = [element]
    for follower in followers:
        follower._native.classname = _defaults(model, {"dclass": class_of(follower)})
        rebuild(model, follower)
    model.touch()


def class_of(element: Handle) -> str:
    """Return the class of an element: its own, or the ``childclass`` of the nearest body that has one."""
    name, holder = element.recorded().values.get("dclass"), element.parent
    while name is None and isinstance(holder, Handle):
        name, holder = holder._native.childclass or None, holder.parent
    return getattr(name, "name", name) or "main"


def class_records(element: Handle) -> Iterator[explicit_values.ExplicitValues]:
    """Yield what the classes of an element say of elements of its kind, the nearest class first."""
    model: Tree[Handle] = element.root
    name: str | None = class_of(element)
    while name is not None:
        native = getattr(model._spec.find_default(name), element.kind, None)
        if native is None:
            raise AttributeError(f"<default> has no elements {element.tag!r}")
        yield model.records.of_class(native, element.kind)
        name = model.records.class_parent(name)


def extend_tendon(model: Tree[H], tendon: H, tag: str, attrs: dict[str, Value]) -> H:
    """Add a joint, a site, a geom or a pulley to a tendon's path.

    Args:
        tag: ``joint``, ``site``, ``geom`` or ``pulley``.
    """
    path = tendon_paths.path_of(model, tendon._native)
    part = tendon_paths.make_part(model, tag, attrs)

    def name(kind: str, target: Handle | str) -> str:
        if isinstance(target, str):
            return target
        return target._native.name if target.root is model else tendon_paths.ELSEWHERE

    tendon_paths.wrap(tendon._native, part, name)
    part.written = {k: v._native.name for k, v in part.values.items() if isinstance(v, Handle)}
    path.append(part)
    model.touch()
    return tendon


def extend_tuple(model: Tree[H], element: H, tag: str, attrs: dict[str, Value]) -> H:
    """Add an element to those that a tuple names.

    Args:
        attrs: ``objname``, an element or a name, with ``objtype``; ``prm``, a number.
    """
    native, target = element._native, attrs.get("objname")
    word = attrs.get("objtype") or (target.kind if isinstance(target, Handle) else None)
    kind = getattr(translate.mj.mjtObj, f"mjOBJ_{str(word).upper()}", None)
    if tag != "element" or not target or kind is None or attrs.keys() - {"objtype", "objname", "prm"}:
        raise UsageError(
            f"a tuple holds <element objtype objname prm>, got <{tag}> with {attrs}",
            hint='add("element", objtype="body", objname=body)',
        )
    native.objtype = [*native.objtype, int(kind)]
    native.objprm = [*native.objprm, float(attrs.get("prm") or 0.0)]
    native.objname = [*native.objname, ""]
    references.refer(element, f"objname[{len(native.objname) - 1}]", target)
    return element


def remove(model: Tree[Handle], element: Handle) -> None:
    """Delete an element and its children; their handles become invalid.

    An element that names it stays: composing refuses it, unless it can do without, as a geom without its material.
    """
    native = element._native
    if element.kind == "inertial":
        translate.reset(native, translate.blank("body"), ("mass", "ipos", "iquat", "inertia", "fullinertia"))
        native.explicitinertial = False
        model.touch()
        return
    # Release the references to the element, and to all elements in a body.
    handles: list[Handle] = [element]
    if element.kind == "body":
        handles += [model.handle(kind, child) for kind in TREE_KINDS for child in native.find_all(kind)]
    references.let_go(model, handles)
    # Rename the elements first, so that MuJoCo does not delete those that refer to them.
    gone = [handle._native for handle in handles]
    for number, one in enumerate(gone):  # MuJoCo deletes what names an element together with it
        frame = one.name[:-1] if one.name.endswith("/") else ""
        if translate.kind_of(one) == "body" and frame in model.attachments:
            model.attachments.pop(frame).model.parent_model = None
        one.name = f"//removed_{number}"
    model.strike(gone)
    model._spec.delete(native)
    model.touch()


def _renamed(attrs: dict[str, Value]) -> dict[str, Value]:
    """Return the attributes that have a value, under PyMJCF's names."""
    if "class_" in attrs:
        attrs["dclass"] = attrs.pop("class_")
    for name in [name for name, value in attrs.items() if value is None]:
        del attrs[name]
    return attrs


def _foreign(model: Tree[Handle], dclass: Value) -> Value:
    """Return a class of defaults that belongs to another model, such as that of a frame's joint; else None."""
    return dclass if getattr(dclass, "root", model) is not model else None


def _defaults(model: Tree[Handle], attrs: dict[str, Value]) -> NativeDefault | None:
    name = attrs.get("dclass", attrs.get("class_"))
    if name is None:
        return None
    name = getattr(name, "name", name)  # a class of defaults, or its name
    defaults = model._spec.find_default(name)
    if defaults is None:
        raise UsageError(f"model {model.model!r} has no default class {name!r}")
    return defaults


def _add_inertial(model: Tree[H], body: H, attrs: dict[str, Value]) -> H:
    names = {"pos": "ipos", "quat": "iquat", "diaginertia": "inertia", "fullinertia": "fullinertia", "mass": "mass"}
    for key, value in attrs.items():
        if key not in names:
            raise AttributeError(f"{key!r} is not a valid attribute for <inertial>. Available: {', '.join(names)}")
        model.touch()
        translate.assign(body._native, "body", names[key], value)
    body._native.explicitinertial = True
    return model.handle("inertial", body._native)
