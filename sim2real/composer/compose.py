"""Composition by copy: every model keeps its own spec; compiling copies them into one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sim2real.composer import keyframes, merge, translate
from sim2real.composer.translate import TREE_KINDS, mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.model import Model

NAMED_KINDS = (
    *TREE_KINDS,
    *("actuator", "sensor", "equality", "tendon", "pair", "exclude"),
    *("mesh", "material", "texture", "hfield", "numeric", "text", "tuple", "key"),
)
_MAY_DANGLE = ("actuator", "sensor", "equality", "pair", "exclude")
"""Elements that name others; MuJoCo's copy drops them silently when what they name is in another model."""


def compile_model(model: Model) -> Any:
    """Return the ``mujoco.MjModel`` of a model and all that is attached to it.

    Raises:
        ValueError: MuJoCo's own message, when the composed model does not compile.
    """
    return compose(model).compile()


def compose(model: Model) -> Any:
    """Return a new ``MjSpec`` of a world: the model at its top with all that is attached to it, and their options."""
    out = _compose(model)
    models = list(model.all_models())
    merge.apply(out, merge.merged(models))
    if len(models) > 1 and any(m._spec.keys for m in models):
        keyframes.restore(out, models)
    return out


def _compose(model: Model) -> Any:
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


def free_body(model: Model) -> Any:
    """Return the first body of a model's own world that has a free joint, or None."""
    for body in model._spec.worldbody.bodies:
        if not body.name.endswith("/") and any(j.type == mj.mjtJoint.mjJNT_FREE for j in body.joints):
            return body
    return None


def _copy(model: Model) -> Any:
    """Return a copy of a model's own spec in which every element has a name and names what it should."""
    spec = model._spec
    unnamed = list(_unnamed(model))
    try:
        for native, name in unnamed:
            native.name = name
        for (native, key), target in model.references.items():
            setattr(native, key, _name_seen_from(model, target))
        out = spec.copy()
        for kind in _MAY_DANGLE:
            _restore(spec, out, kind)
    finally:
        for native, _ in unnamed:
            native.name = ""
    merge.clear(out, model.settings())
    out.compiler.degree = model.reads_degrees()
    if model.attachments or model.parent_model is not None:  # else MuJoCo's own handling of keyframes does
        for key in list(out.keys):
            out.delete(key)
    for mesh in out.meshes:  # MuJoCo names a mesh after its file, which a prefix would turn into another name
        if not mesh.name and mesh.file:
            mesh.name = mesh.file.rsplit("/", 1)[-1].rsplit(".", 1)[0]
    return out


def _unnamed(model: Model) -> Any:
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


def _name_seen_from(model: Model, target: Any) -> str:
    if target.root is model:
        return target._native.name
    return model_name(target, model)


def model_name(target: Any, model: Model) -> str:
    """Return an element's name as seen from a model above the element's own."""
    if target.root is not model and model not in _above(target.root):
        raise UsageError(
            f"model {model.model!r} refers to {target.full_identifier!r}, which is not attached below it",
            hint="attach it first, or add the referring element to a model above both",
        )
    return target.root.identify(target, relative_to=model)


def _above(model: Model) -> list[Any]:
    found, current = [], model.parent_model
    while current is not None:
        found.append(current)
        current = current.parent_model
    return found


def _restore(source: Any, out: Any, kind: str) -> None:
    """Bring back what a copy dropped, in the source's order; done before anything is attached, so that it resolves."""
    wanted = getattr(source, translate.plural(kind))
    held = getattr(out, translate.plural(kind))
    if len(wanted) == len(held):
        return
    for native in held:
        out.delete(native)
    for native in wanted:
        new = getattr(out, f"add_{kind}")()
        new.name, new.info = native.name, native.info
        for key in translate.attributes(native):
            value = getattr(native, key)
            if not callable(value) and value is not None:
                setattr(new, key, value)
