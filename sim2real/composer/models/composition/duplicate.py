"""Copies of models, together with the attached models."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, TypeVar

from sim2real.composer.models.composition import compose
from sim2real.composer.models.mjcf import translate
from sim2real.composer.models.mjcf.explicit_values import PathPart
from sim2real.composer.models.mjcf.tendon_paths import path_of
from sim2real.composer.models.tree import Handle, Tree
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.types import Native

T = TypeVar("T", bound=Tree[Handle])


def duplicate(model: T) -> T:
    """Return an independent copy of a model with all attached models; the copy has no parent."""
    twins: dict[Tree[Handle], Tree[Handle]] = {}
    natives: dict[Native, Native] = {}
    copy = _copy(model, twins, natives)
    for old, new in twins.items():
        new.overrides = old.overrides.among(twins)
        for (native, key), target in old.references.items():
            new.references[natives[native], key] = _twin(old, target, twins, natives)
        for native, path in old.paths.items():
            new.paths[natives[native]] = [_part(old, part, twins, natives) for part in path]
    return copy


def _twin(
    model: Tree[Handle], target: Handle, twins: dict[Tree[Handle], Tree[Handle]], natives: dict[Native, Native]
) -> Handle:
    """Return the copy of what an element of a model names."""
    if target.is_removed:
        return target
    if target.root not in twins:
        raise UsageError(
            f"model {model.model!r} cannot be copied: it refers to {target.full_identifier!r}, which is not below it",
            hint="copy a model above both",
        )
    return twins[target.root].handle(target.kind, natives[target._native])


def _part(
    model: Tree[Handle], part: PathPart, twins: dict[Tree[Handle], Tree[Handle]], natives: dict[Native, Native]
) -> PathPart:
    values = {k: _twin(model, v, twins, natives) if hasattr(v, "root") else v for k, v in part.values.items()}
    return PathPart(part.tag, values, dict(part.written))


def _copy(model: T, twins: dict[Tree[Handle], Tree[Handle]], natives: dict[Native, Native]) -> T:
    spec = compose.full_copy(model)
    copy = twins[model] = type(model).owning(spec)
    copy.shows_text = model.shows_text
    copy.inherits_angle = model.inherits_angle
    # Map every element to its copy.
    natives[model._spec.worldbody] = spec.worldbody
    for kind in compose.NAMED_KINDS:
        plural = translate.plural(kind)
        for old, new in zip(getattr(model._spec, plural), getattr(spec, plural), strict=True):
            natives[old] = new
            if not old.name:  # which the copy was given
                new.name = ""
    for native in model._spec.tendons:
        path_of(model, native)
    # Copy the records of the model by this map.
    copy.records = model.records.among(natives)
    copy._order = {natives[old]: number for old, number in model._order.items() if old in natives}
    copy._clock = itertools.count(max(copy._order.values(), default=next(copy._clock)) + 1)
    # Copy the attached models in the same way.
    for name, attachment in model.attachments.items():
        child = _copy(attachment.model, twins, natives)
        child.parent_model = copy
        copy.attachments[name] = type(attachment)(child, natives[attachment.frame])
    return copy
