"""Models below other models."""

from __future__ import annotations

import itertools
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sim2real.composer.models import builder, merge
from sim2real.composer.models.translate import mj
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.models.element import Element
    from sim2real.composer.models.model import Model

_log = logging.getLogger(__name__)
_POSE = ("pos", "quat", "euler", "axisangle", "xyaxes", "zaxis")


@dataclass(eq=False)
class Attachment:
    """A model below another one, and the empty body that holds its place there."""

    model: Model
    frame: Any


def attach(parent: Model, site: Element, model: Model) -> Element:
    """Attach a model at a site of another one or at its world; return the frame, an empty body until compilation.

    Raises:
        UsageError: When the model is attached already, would hold itself, or its options contradict the other's.
    """
    if model.parent_model is not None:
        raise UsageError(f"The model {model.model!r} is already attached elsewhere", hint="detach it first")
    if model is parent.root_model:
        raise UsageError(f"Cannot attach model {model.model!r} to itself")
    merge.merged([*parent.root_model.all_models(), *model.all_models()])
    _warn_of_degrees(parent, model)
    name = _free_name(parent, model.model)
    model._spec.modelname = name
    host = site._native if site.is_worldbody else site._native.parent
    frame = host.add_body(name=f"{name}/")
    pose = {} if site.is_worldbody else {k: v for k, v in parent.given(site).values.items() if k in _POSE}
    if pose:
        frame.pos, frame.quat = site._native.pos, site._native.quat
        for key in ("euler", "axisangle", "xyaxes", "zaxis", "type"):
            setattr(frame.alt, key, getattr(site._native.alt, key))
    parent.attachments[name] = Attachment(model, frame)
    model.parent_model = parent
    parent.touch()
    return parent.enlist("body", frame, "body", pose)


def _free_name(parent: Model, name: str) -> str:
    """Return a name, with a number behind it where others have it already."""
    numbered = (f"{name}_{i}" for i in itertools.count(1))
    return next(n for n in itertools.chain([name], numbered) if n not in parent.attachments)


def _warn_of_degrees(parent: Model, model: Model) -> None:
    """Warn where dm_control would read a document's angles in another unit than MuJoCo, which reads degrees."""
    if parent._spec.compiler.degree or not model.records.is_silent_on_angles:
        return
    turning = [j for j in model.find_all("joint", exclude_attachments=True) if j._native.type in _TURNING]
    angular = [j for j in turning if {"range", "ref", "springref"} & model.given(j).values.keys()]
    if angular and model._spec.compiler.degree:
        _log.warning(
            "the document of model %r does not say in which unit its angles are: they are read in degrees, as MuJoCo "
            "reads them, also below %r, whose unit is the radian. hint: set compiler.angle of the model to 'degree' or "
            "'radian'",
            model.model,
            parent.model,
        )


_TURNING = (mj.mjtJoint.mjJNT_HINGE, mj.mjtJoint.mjJNT_BALL)


def detach(model: Model) -> None:
    """Take a model off the one that it is attached to.

    Raises:
        UsageError: When it is not attached.
    """
    parent = model.parent_model
    if parent is None:
        raise UsageError(f"Cannot detach model {model.model!r}: it is not attached")
    attachment = parent.attachments.pop(model.model)
    builder.remove(parent, parent.handle("body", attachment.frame))
    model.parent_model = None


def rename(parent: Model, old: str, new: str) -> None:
    """Rename an attached model, with its frame and the frame's joints.

    Raises:
        UsageError: When another one has that name.
    """
    if new in parent.attachments and new != old:
        raise UsageError(
            f"model {parent.model!r} has {new!r} attached already. Attached: {', '.join(parent.attachments)}"
        )
    attachment = parent.attachments[old]
    for native in (attachment.frame, *attachment.frame.joints):
        native.name = f"{new}/" + native.name[len(old) + 1 :]
    parent.attachments = {new if k == old else k: v for k, v in parent.attachments.items()}
