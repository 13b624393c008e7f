"""Decorators: properties that are computed once, and methods that declare observables."""

from __future__ import annotations

import functools
import inspect
import threading
from collections.abc import Callable
from typing import Any


class cached_property(property):  # noqa: N801 - a decorator, called like dm_control's
    """A property that is evaluated once per object."""

    def __init__(self, func: Callable[..., Any]) -> None:
        super().__init__(fget=func)
        self._lock = threading.RLock()
        wrapper: Any = self
        functools.update_wrapper(wrapper, func)

    def __get__(self, obj: Any, owner: type | None = None) -> Any:
        if obj is None:
            return self
        getter: Any = self.fget
        name, values = getter.__name__, obj.__dict__
        if name not in values:
            with self._lock:
                if name not in values:
                    values[name] = getter(obj)
        return values[name]

    def __set__(self, obj: Any, value: Any) -> None:
        getter: Any = self.fget
        raise AttributeError(f"{getter.__name__!r} is computed, it cannot be set")


class observable(cached_property):  # noqa: N801
    """Decorates a method of an ``Observables`` class that returns an observable; evaluated when the entity is made.

    A method of an entity or a task that takes ``physics``, or a function of ``physics``, may be decorated, too: its
    result is then the value of the observable, and it stays callable.
    """

    _in_class = False

    def __set_name__(self, owner: type, name: str) -> None:
        """Note that the decorated function is a method: its first argument is the object, under any name."""
        self._in_class = True

    @property
    def takes_physics(self) -> bool:
        """Whether the decorated function computes the value from the physics, rather than returning an observable."""
        getter: Any = self.fget
        kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
        names = [name for name, p in inspect.signature(getter).parameters.items() if p.kind in kinds]
        return len(names) > (1 if self._in_class or names[:1] == ["self"] else 0)

    def __get__(self, obj: Any, owner: type | None = None) -> Any:
        if obj is not None and self.takes_physics:
            getter: Any = self.fget
            return functools.partial(getter, obj)
        return super().__get__(obj, owner)

    def __call__(self, *args: Any) -> Any:
        """Call the decorated function."""
        getter: Any = self.fget
        return getter(*args)


class abstract_observable(property):  # noqa: N801
    """Marks a method that subclasses must override with an ``observable``."""

    __isabstractmethod__ = True


def declared(owner: Any) -> dict[str, Callable[..., Any]]:
    """Return the functions of ``physics`` that an entity or a task declares with ``@observable``, by name."""
    return {name: getattr(owner, name) for name in _declared(type(owner))}


@functools.cache
def _declared(owner: type) -> tuple[str, ...]:
    members = ((name, inspect.getattr_static(owner, name)) for name in sorted(dir(owner)))
    return tuple(name for name, value in members if isinstance(value, observable) and value.takes_physics)
