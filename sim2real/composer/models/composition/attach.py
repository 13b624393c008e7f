"""Models below other models."""

from __future__ import annotations

import itertools
import logging
from typing import TYPE_CHECKING, Any

from sim2real.composer.models import builder
from sim2real.composer.models.composition import merge_options
from sim2real.composer.models.mjcf.translate import mj
from sim2real.composer.models.scope import Attachment
from sim2real.composer.models.tree import H, Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.models.tree import Handle

_log = logging.getLogger(__name__)
_POSE = ("pos", "quat", "euler", "axisangle", "xyaxes", "zaxis")


def attach(site: H, model: Tree[H]) -> H:
    """Attach a model at a site of another one or at its world; return the frame, an empty body until compilation."""
    if not isinstance(model, Tree):
        raise UsageError(f"Expected a model, got {type(model).__name__}: {model!r}")
    parent: Tree[Any] = site.root
    if model.parent_model is not None:
        raise UsageError(f"The model {model.model!r} is already attached elsewhere", hint="detach it first")
    if model is parent.root_model:
        raise UsageError(f"Cannot attach model {model.model!r} to itself")
    # Refuse contradicting options before anything changes.
    merge_options.merged([*parent.root_model.all_models(), *model.all_models()])
    _warn_of_degrees(parent, model)
    # Add the frame at the pose of the site.
    name = _free_name(parent, model.model)
    model._spec.modelname = name
    host = site._native if site.is_worldbody else site._native.parent
    frame = host.add_body(name=f"{name}/")
    pose = {} if site.is_worldbody else {k: v for k, v in site.recorded().values.items() if k in _POSE}
    if pose:
        frame.pos, frame.quat = site._native.pos, site._native.quat
        for key in ("euler", "axisangle", "xyaxes", "zaxis", "type"):
            setattr(frame.alt, key, getattr(site._native.alt, key))
    parent.attachments[name] = Attachment(model, frame)
    model.parent_model = parent
    parent.touch()
    return parent.enlist("body", frame, "body", pose)


def _free_name(parent: Tree[Handle], name: str) -> str:
    """Return a name, with a number behind it where others have it already."""
    numbered = (f"{name}_{i}" for i in itertools.count(1))
    return next(n for n in itertools.chain([name], numbered) if n not in parent.attachments)


def _warn_of_degrees(parent: Tree[Handle], model: Tree[Handle]) -> None:
    """Warn where dm_control would read a document's angles in another unit than MuJoCo, which reads degrees."""
    if parent._spec.compiler.degree or not model.records.is_silent_on_angles:
        return
    turning = [j for j in model.find_all("joint", exclude_attachments=True) if j._native.type in _TURNING]
    angular = [j for j in turning if {"range", "ref", "springref"} & j.recorded().values.keys()]
    if angular and model._spec.compiler.degree:
        _log.warning(
            "the document of model %r does not say in which unit its angles are: they are read in degrees, as MuJoCo "
            "reads them, also below %r, whose unit is the radian. hint: set compiler.angle of the model to 'degree' or "
            "'radian'",
            model.model,
            parent.model,
        )


_TURNING = (mj.mjtJoint.mjJNT_HINGE, mj.mjtJoint.mjJNT_BALL)


def detach(model: Tree[Handle]) -> None:
    """Take a model off the one that it is attached to; UsageError when it is not attached."""
    parent = model.parent_model
    if parent is None:
        raise UsageError(f"Cannot detach model {model.model!r}: it is not attached")
    attachment = parent.attachments.pop(model.model)
    builder.remove(parent, parent.handle("body", attachment.frame))
    model.parent_model = None
