"""Copies of models: specs of their own, with all that is attached."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any, TypeVar

from sim2real.composer.models import compose, translate
from sim2real.composer.models.tree import Tree

if TYPE_CHECKING:
    from sim2real.composer.types import Native

T = TypeVar("T", bound=Tree[Any])


def duplicate(model: T) -> T:
    """Return an independent copy of a model and of all that is attached to it; it is attached to nothing."""
    twins: dict[T, T] = {}
    natives: dict[Native, Native] = {}
    made = _copy(model, twins, natives)
    for old, new in twins.items():
        new.overrides = old.overrides.among(twins)
        for (native, key), target in old.references.items():
            new.references[natives[native], key] = twins[target.root].handle(target.kind, natives[target._native])
    return made


def _copy(model: T, twins: dict[T, T], natives: dict[Native, Native]) -> T:
    spec = compose.copy_spec(model)
    made = twins[model] = type(model).owning(spec)
    made.inherits_angle = model.inherits_angle
    natives[model._spec.worldbody] = spec.worldbody
    for kind in compose.NAMED_KINDS:
        plural = translate.plural(kind)
        for old, new in zip(getattr(model._spec, plural), getattr(spec, plural), strict=True):
            natives[old] = new
            if not old.name:  # which the copy was given
                new.name = ""
    made.records = model.records.among(natives)
    made._order = {natives[old]: number for old, number in model._order.items() if old in natives}
    made._clock = itertools.count(max(made._order.values(), default=next(made._clock)) + 1)
    for name, attachment in model.attachments.items():
        child = _copy(attachment.model, twins, natives)
        child.parent_model = made
        made.attachments[name] = type(attachment)(child, natives[attachment.frame])
    return made
