"""Tests of the data of robots and of their parts, and of the methods of their classes."""

import math
from collections.abc import Callable, Mapping
from typing import TypeVar

from sim2real.errors import UsageError
from sim2real.robots.roles import Roles

T = TypeVar("T")
Datum = tuple[str, Callable[[object], bool]]
"""Description of an attribute, and the test of its value."""
HINT = "{}.{} describes each of them"
"""Of errors about a class: its module and its name."""


def tuple_of(kind: type) -> Callable[[object], bool]:
    """Return the test for a tuple of one or more objects of a kind."""
    return lambda value: isinstance(value, tuple) and bool(value) and all(isinstance(t, kind) for t in value)


def has_texts(value: object) -> bool:
    """Return whether a value is a mapping of texts to texts."""
    return isinstance(value, Mapping) and all(isinstance(t, str) for pair in value.items() for t in pair)


def is_positive(value: object) -> bool:
    """Return whether a value is a finite number above 0."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0


def is_roles(value: object) -> bool:
    """Return whether a value is ``Roles`` with four different names."""
    return isinstance(value, Roles) and len({value.sensor, value.supervisor, value.actuator, value.world}) == 4


def is_joints(value: object) -> bool:
    """Return whether a value is a mapping of joints to quantities to fields."""
    return isinstance(value, Mapping) and all(has_texts(fields) for fields in value.values())


def complete(cls: type[T], *args: object, **options: object) -> T:
    """Make an object, as ``__new__`` of its class."""
    del args, options
    if missing := sorted(getattr(cls, "__abstractmethods__", ())):
        ours = [base for base in reversed(cls.__mro__) if base.__module__.startswith("sim2real.robots")]
        base = max(ours, key=lambda base: len(getattr(base, "__abstractmethods__", frozenset()) & set(missing)))
        raise UsageError(
            f"{cls.__module__}.{cls.__qualname__} is not complete: it "
            + "; it ".join(f"has no {name}()" for name in missing),
            hint=HINT.format(base.__module__.replace("robot_parts", "contract"), base.__name__),
        )
    return object.__new__(cls)
