"""Tasks and entities must not keep traced values: they mean nothing once a program is compiled."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from typing import Any

import jax
from jax.core import Tracer

from sim2real.errors import UsageError


@contextlib.contextmanager
def guarded(owners: Iterable[Any]) -> Iterator[None]:
    """Put the attributes of tasks and entities back as they were, and refuse traced values in them.

    Raises:
        UsageError: With the attribute and its owner.
    """
    before = [(owner, dict(vars(owner))) for owner in owners]
    try:
        yield
        for owner, values in before:
            for name, value in vars(owner).items():
                if value is not values.get(name) and _is_traced(value):
                    raise UsageError(
                        f"{type(owner).__name__}.{name} was set by a hook to a value that only exists in the program",
                        hint=f"keep it in physics.variables[{name!r}]: it then belongs to each copy",
                    )
    finally:
        for owner, values in before:
            vars(owner).clear()
            vars(owner).update(values)


def _is_traced(value: Any) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree_util.tree_leaves(value))
