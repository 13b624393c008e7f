"""Composition by copy: every model keeps its own spec; compiling copies them into one."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from sim2real.composer.models.composition import keyframes, merge_options
from sim2real.composer.models.composition import recreate as late_elements
from sim2real.composer.models.mjcf import files, translate
from sim2real.composer.models.mjcf.targets import SECTION_KINDS, point
from sim2real.composer.models.mjcf.tendon_paths import ELSEWHERE, path_of, wrap
from sim2real.composer.models.mjcf.translate import TREE_KINDS, mj
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


def compile_model(model: Tree[Handle]) -> MjModel:
    """Return the ``mujoco.MjModel`` of a model with all attached models.

    Raises:
        ValueError: MuJoCo's own message, when the composed model does not compile.
    """
    return compose(model).compile()


def compose(model: Tree[Handle]) -> MjSpec:
    """Return a new ``MjSpec`` of a world: the model at its top, all attached models, and their options.

    Raises:
        UsageError: When an element names one that is not there, or would be lost.
    """
    models = list(model.all_models())
    with files.renamed(model) if any(map(files.is_mixed, models)) else contextlib.nullcontext():
        out = _whole(model, models)
    merge_options.apply(out, merge_options.merged(models))
    if len(models) > 1 and any(m._spec.keys for m in models):
        keyframes.restore(out, models)
    return out


def _whole(model: Tree[Handle], models: list[Tree[Handle]]) -> MjSpec:
    """Return a new ``MjSpec`` of a world with every element of its models.

    MuJoCo's copies drop an element that refers to another model, or let it refer to an element of the same name in the
    copy. Such elements are added again at the end. References that programs made are on record; references by text are
    detected by counting.
    """
    late = late_elements.foreign_kinds(models)
    wanted = _wanted(models)
    while True:
        out = _compose(model, late)
        late_elements.add(out, model, models, late)
        late_elements.point_aside(out, model, models, late)
        counts = late_elements.count(out)
        lost = {kind for kind, number in wanted.items() if counts[kind] != number}
        if not lost:
            return out
        if lost & late or not lost <= set(SECTION_KINDS):
            each = ", ".join(f"{counts[k]} of {wanted[k]} of kind {k}" for k in sorted(lost))
            raise UsageError(
                f"model {model.model!r} loses elements when it is composed: {each} are left",
                hint="an element that names another one by text names it as its own model does: arm/hand/finger",
            )
        late = late_elements.closed(late | lost)


def _wanted(models: list[Tree[Handle]]) -> dict[str, int]:
    """Return how many elements of each kind the world of some models has."""
    counts = [late_elements.count_own(m) for m in models]
    wanted = {kind: sum(c[kind] for c in counts) for kind in counts[0]}
    # Where a model has a free joint of its own, its body takes the place of the frame.
    wanted["body"] -= sum(free_body(a.model) is not None for m in models for a in m.attachments.values())
    return wanted


def _compose(model: Tree[Handle], late: frozenset[str]) -> MjSpec:
    """Return a new ``MjSpec`` that holds copies of a model and of all attached models, with default options.

    Names of attached elements are prefixed with ``model/``; each attached model is in a body of that name.
    Bodies, joints, geoms, actuators and so on are in depth-first order, as PyMJCF writes them.
    """
    out = _copy(model, late)
    for name, attachment in model.attachments.items():
        child = _compose(attachment.model, late)
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


def copy_spec(model: Tree[Handle], late: frozenset[str] = frozenset()) -> MjSpec:
    """Return a copy of a model's own spec in which every element has a name, and the references of this model hold.

    A reference to an element of another model gets a name that no element of this model has.
    """
    spec = model._spec
    # Name all elements and set their references for the time of the copy.
    unnamed = list(_unnamed(model))
    dropped = [(native, native.name) for kind in late for native in getattr(spec, translate.plural(kind))]
    try:
        for native, name in unnamed:
            native.name = name
        for (native, key), target in model.references.items():
            is_here = target.root is model and not target.is_removed
            point(native, key, target._native.name if is_here else ELSEWHERE)
        for native, _ in dropped:  # the copy keeps the names of dropped elements reserved
            native.name = ""
        out = spec.copy()
    finally:
        for native, name in (*dropped, *((native, "") for native, _ in unnamed)):
            native.name = name
    # Delete the kinds that are added later.
    for kind in late:
        for native in getattr(out, translate.plural(kind)):
            out.delete(native)
    return out


def full_copy(model: Tree[Handle]) -> MjSpec:
    """Return a copy of a model's own spec as ``copy_spec`` does, with what names elements of other models."""
    wanted = late_elements.count(model._spec)
    counts = late_elements.count(copy_spec(model))
    late = late_elements.closed(kind for kind, number in wanted.items() if counts[kind] != number)
    out = copy_spec(model, late)
    for kind in late:
        for native in getattr(model._spec, translate.plural(kind)):
            new = late_elements.copied(out, kind, native, native.name)
            for part in path_of(model, native) if kind == "tendon" else ():
                wrap(new, part, lambda kind, target: target if isinstance(target, str) else target.full_identifier)
    return out


def _copy(model: Tree[Handle], late: frozenset[str]) -> MjSpec:
    """Return a copy of a model's own spec that can become a part of another one, without some kinds of elements."""
    out = copy_spec(model, late)
    merge_options.clear(out, model.settings())
    out.compiler.degree = model.reads_degrees()
    merge_options.inherit_compiler(out, model)
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
