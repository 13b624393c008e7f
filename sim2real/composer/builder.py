"""Adding elements to a model, and taking them away."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sim2real.composer import translate
from sim2real.composer.element import KIND_OF_TAG, REFERENCES, Element
from sim2real.composer.translate import TREE_KINDS
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.model import Model


def add_to_body(model: Model, body: Element, tag: str, attrs: dict[str, Any]) -> Element:
    """Add an element to a body of this model."""
    if tag == "inertial":
        return _add_inertial(model, body, attrs)
    kind = KIND_OF_TAG.get(tag, tag)
    name = attrs.get("name")
    if name is not None:
        model.check_name(kind, name)
    defaults = _defaults(model, attrs)
    if tag == "freejoint":
        native = body._native.add_freejoint()
    else:
        adder = getattr(body._native, f"add_{kind}")
        native = adder() if defaults is None or kind == "body" else adder(defaults)
    element = model.enlist(kind, native)
    try:
        if name is not None:
            native.name = name
        named = REFERENCES.get(kind, ())
        for key, value in attrs.items():
            if key in named or isinstance(value, Element):
                setattr(element, key, value)
            elif key not in ("name", "dclass", "class_"):
                translate.assign(native, kind, key, value)
    except Exception:
        remove(model, element)
        raise
    if body.is_frame:  # joints of a frame are called after it
        native.name = body._native.name + (f"{name}/" if name else "")
    model.touch()
    return element


def add_to_section(model: Model, kind: str, tag: str, attrs: dict[str, Any]) -> Element:
    """Add an element that stands in no body; MuJoCo's parser reads its attributes."""
    model.check_name(kind, attrs.get("name"))
    defaults = _defaults(model, attrs)
    references = [k for k in REFERENCES.get(kind, ()) if attrs.get(k) is not None]
    given = {k: v for k, v in attrs.items() if k not in ("name", "dclass", "class_") and v is not None}
    fixed, named = translate.from_xml(kind, tag, given, references)
    adder = getattr(model._spec, f"add_{kind}")
    native = adder() if defaults is None else adder(defaults)
    native.name = attrs.get("name") or ""
    element = model.enlist(kind, native)
    for key, value in fixed.items():
        setattr(native, key, value)
    for key, value in named.items():
        if isinstance(value, Element):
            model.refer(element, key, value)
        elif isinstance(value, list) and any(isinstance(v, Element) for v in value):
            setattr(native, key, [v.name if isinstance(v, Element) else v for v in value])
        else:
            setattr(native, key, value)
    model.touch()
    return element


def extend_tendon(model: Model, tendon: Element, tag: str, attrs: dict[str, Any]) -> Element:
    """Add a joint, a site, a geom or a pulley to a tendon's path."""
    model.touch()
    names = {k: v.name if isinstance(v, Element) else v for k, v in attrs.items()}
    if tag == "joint":
        tendon._native.wrap_joint(names["joint"], names["coef"])
    elif tag == "site":
        tendon._native.wrap_site(names["site"])
    elif tag == "geom":
        tendon._native.wrap_geom(names["geom"], names.get("sidesite") or "")
    elif tag == "pulley":
        tendon._native.wrap_pulley(names["divisor"])
    else:
        raise UsageError(f"a <{tag}> cannot stand in a tendon. Available: geom, joint, pulley, site")
    return tendon


def remove(model: Model, element: Element) -> None:
    """Delete an element with what stands in it and what refers to it; its handles are of no use afterwards."""
    native = element._native
    gone = [native]
    if element.kind == "body":
        gone += [child for kind in TREE_KINDS for child in native.find_all(kind)]
    model.references = {
        key: target for key, target in model.references.items() if key[0] not in gone and target._native not in gone
    }
    model.strike(gone)
    model._spec.delete(native)
    model.touch()


def _defaults(model: Model, attrs: dict[str, Any]) -> Any:
    name = attrs.get("dclass", attrs.get("class_"))
    if name is None:
        return None
    name = getattr(name, "name", name)
    found = model._spec.find_default(name)
    if found is None:
        raise UsageError(f"model {model.model!r} has no default class {name!r}")
    return found


def _add_inertial(model: Model, body: Element, attrs: dict[str, Any]) -> Element:
    names = {"pos": "ipos", "quat": "iquat", "diaginertia": "inertia", "fullinertia": "fullinertia", "mass": "mass"}
    for key, value in attrs.items():
        if key not in names:
            raise AttributeError(f"{key!r} is not a valid attribute for <inertial>. Available: {', '.join(names)}")
        model.touch()
        translate.assign(body._native, "body", names[key], value)
    body._native.explicitinertial = True
    return body
