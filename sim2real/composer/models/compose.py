"""Composition by copy: every model keeps its own spec; compiling copies them into one."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from sim2real.composer.models import files, keyframes, layout, merge, translate
from sim2real.composer.models.translate import TREE_KINDS, mj
from sim2real.composer.models.tree import Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sim2real.composer.models.tree import Handle
    from sim2real.composer.types import MjModel, MjSpec, Native

NAMED_KINDS = (
    *TREE_KINDS,
    *("actuator", "sensor", "equality", "tendon", "pair", "exclude"),
    *("mesh", "material", "texture", "hfield", "numeric", "text", "tuple", "key"),
)
_MAY_DANGLE = ("actuator", "sensor", "equality", "pair", "exclude")
"""Elements that name others; MuJoCo's copy drops them silently when what they name is in another model."""


def compile_model(model: Tree[Handle]) -> MjModel:
    """Return the ``mujoco.MjModel`` of a model and all that is attached to it.

    Raises:
        ValueError: MuJoCo's own message, when the composed model does not compile.
    """
    return compose(model).compile()


def compose(model: Tree[Handle]) -> MjSpec:
    """Return a new ``MjSpec`` of a world: the model at its top with all that is attached to it, and their options."""
    models = list(model.all_models())
    with files.renamed(model) if any(map(files.is_mixed, models)) else contextlib.nullcontext():
        out = _compose(model)
    merge.apply(out, merge.merged(models))
    _point_aside(out, models)
    if len(models) > 1 and any(m._spec.keys for m in models):
        keyframes.restore(out, models)
    return out


def _compose(model: Tree[Handle]) -> MjSpec:
    """Return a new ``MjSpec`` that holds copies of a model and of all that is attached to it, with default options.

    Names of attached elements are prefixed with ``model/``; each attached model stands in a body of that name.
    Bodies, joints, geoms, actuators and so on are in depth-first order, as PyMJCF writes them.
    """
    out = _copy(model)
    for name, attachment in model.attachments.items():
        child = _compose(attachment.model)
        host = out.body(f"{name}/")
        if free_body(attachment.model) is None:
            out.attach(child, frame=host.add_frame(), prefix=f"{name}/")
            continue
        if host.joints or host.parent.parent is not None or model.parent_model is not None:
            raise UsageError(
                f"model {name!r} has a free joint of its own: it can only be attached to the world, without joints",
                hint="take the free joint out of the model and use add_free_entity",
            )
        frame = out.worldbody.add_frame(pos=host.pos, quat=host.quat)
        out.delete(host)
        out.attach(child, frame=frame, prefix=f"{name}/")
    return out


def free_body(model: Tree[Handle]) -> Native | None:
    """Return the first body of a model's own world that has a free joint, or None."""
    for body in model._spec.worldbody.bodies:
        if not body.name.endswith("/") and any(j.type == mj.mjtJoint.mjJNT_FREE for j in body.joints):
            return body
    return None


def copy_spec(model: Tree[Handle]) -> MjSpec:
    """Return a copy of a model's own spec in which every element has a name and names what it should."""
    spec = model._spec
    unnamed = list(_unnamed(model))
    try:
        for native, name in unnamed:
            native.name = name
        for (native, key), target in model.references.items():
            translate.point(native, key, _name_seen_from(model, target))
        out = spec.copy()
        lost = [kind for kind in _MAY_DANGLE if _count(out, kind) != _count(spec, kind)]
        if lost:
            out = _copy_all(model, lost)
    finally:
        for native, _ in unnamed:
            native.name = ""
    return out


def _copy(model: Tree[Handle]) -> MjSpec:
    """Return a copy of a model's own spec that can become a part of another one."""
    out = copy_spec(model)
    merge.clear(out, model.settings())
    out.compiler.degree = model.reads_degrees()
    merge.inherit_compiler(out, model)
    if model.attachments or model.parent_model is not None:  # else MuJoCo's own handling of keyframes does
        for key in list(out.keys):
            out.delete(key)
    for mesh in out.meshes:  # MuJoCo names a mesh after its file, which a prefix would turn into another name
        if not mesh.name and mesh.file:
            mesh.name = mesh.file.rsplit("/", 1)[-1].rsplit(".", 1)[0]
    return out


def _unnamed(model: Tree[Handle]) -> Iterator[tuple[Native, str]]:
    """Yield elements without a name, with the one they get: ``/unnamed_geom_0``, ``//unnamed_geom_0`` at the top."""
    lead = "/" if model.parent_model is None else ""
    for kind in NAMED_KINDS:
        if kind in ("mesh", "texture", "hfield"):
            continue
        natives = getattr(model._spec, translate.plural(kind))
        if not natives or all(n.name for n in natives):
            continue
        for number, element in enumerate(model.find_all(kind, exclude_attachments=True)):
            if not element._native.name:
                yield element._native, f"{lead}/unnamed_{kind}_{number}"


def _name_seen_from(model: Tree[Handle], target: Handle) -> str:
    if target.root is model:
        return target._native.name
    if _is_aside(model, target):  # any element of its kind does for now: what names nothing is dropped
        own = model.find_all(target.kind, exclude_attachments=True)
        if own:
            return own[0]._native.name
    return model_name(target, model)


def _is_aside(model: Tree[Handle], target: Handle) -> bool:
    """Return whether an element is in the same world as a model, but neither in it nor below it."""
    above = _above(target.root)
    return target.root is not model and model not in above and target.root.root_model is model.root_model


def _point_aside(out: MjSpec, models: list[Tree[Handle]]) -> None:
    """Let elements name what is beside or above their own model, now that all models are in one spec."""
    for model in models:
        for (native, key), target in model.references.items():
            if _is_aside(model, target):
                element = model.find_handle(native)
                translate.point(getattr(out, element.kind)(element.full_identifier), key, target.full_identifier)


def model_name(target: Handle, model: Tree[Handle]) -> str:
    """Return an element's name as seen from a model above the element's own."""
    if target.root is not model and model not in _above(target.root):
        raise UsageError(
            f"model {model.model!r} refers to {target.full_identifier!r}, which is not attached below it",
            hint="attach it first, or add the referring element to a model above both",
        )
    return target.root.identify(target, relative_to=model)


def _above(model: Tree[Handle]) -> list[Tree[Handle]]:
    found, current = [], model.parent_model
    while current is not None:
        found.append(current)
        current = current.parent_model
    return found


def _count(spec: MjSpec, kind: str) -> int:
    return len(getattr(spec, translate.plural(kind)))


def _copy_all(model: Tree[Handle], lost: list[str]) -> MjSpec:
    """Return a copy of a spec with what a plain copy drops of some kinds: elements that name others elsewhere.

    They are added anew, in the source's order; done before anything is attached, so that they resolve.

    Raises:
        UsageError: When one names an element that is not below the model either.
    """
    spec = model._spec
    wanted = [(kind, native, native.name) for kind in lost for native in getattr(spec, translate.plural(kind))]
    for kind, native, _ in wanted:
        _check_targets(model, kind, native)
    try:
        for _, native, _ in wanted:  # the names of what a copy drops stay taken in it
            native.name = ""
        out = spec.copy()
    finally:
        for _, native, name in wanted:
            native.name = name
    for kind in lost:
        for native in getattr(out, translate.plural(kind)):
            out.delete(native)
    for kind, native, name in wanted:
        new = getattr(out, f"add_{kind}")()
        new.name, new.info = name, native.info
        for key in translate.attributes(native):
            value = getattr(native, key)
            if not callable(value) and value is not None:
                setattr(new, key, value)
    return out


_OBJECTS = {**{k.object_type: name for name, k in layout.KINDS.items()}, mj.mjtObj.mjOBJ_XBODY: "body"}
_TRANSMISSIONS = {
    **{getattr(mj.mjtTrn, f"mjTRN_{name}"): "joint" for name in ("JOINT", "JOINTINPARENT")},
    **{getattr(mj.mjtTrn, f"mjTRN_{name}"): "site" for name in ("SITE", "SLIDERCRANK")},
    mj.mjtTrn.mjTRN_TENDON: "tendon",
    mj.mjtTrn.mjTRN_BODY: "body",
}


def _targets(kind: str, native: Native) -> list[tuple[str | None, str]]:
    """Return kind and name of the elements that one names."""
    if kind == "actuator":
        return [
            (_TRANSMISSIONS.get(native.trntype), native.target),
            ("site", native.refsite),
            ("site", native.slidersite),
        ]
    if kind == "sensor":
        return [(_OBJECTS.get(native.objtype), native.objname), (_OBJECTS.get(native.reftype), native.refname)]
    if kind == "equality":
        return [(_OBJECTS.get(native.objtype), name) for name in (native.name1, native.name2)]
    names = ("geomname1", "geomname2") if kind == "pair" else ("bodyname1", "bodyname2")
    return [("geom" if kind == "pair" else "body", getattr(native, name)) for name in names]


def _check_targets(model: Tree[Handle], kind: str, native: Native) -> None:
    for target, name in _targets(kind, native):
        if target and name and model.find(target, name) is None:
            known = ", ".join(filter(None, (e.name for e in model.find_all(target, exclude_attachments=True))))
            raise UsageError(
                f"{kind} {native.name!r} of model {model.model!r} names the {target} {name!r}, which is not there. "
                f"Available: {known}",
                hint="elements of attached models have the names of those in front: arm/hand/finger",
            )
