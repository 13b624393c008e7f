"""The observables of one entity."""

from __future__ import annotations

import functools
import inspect
import weakref
from collections import OrderedDict
from typing import TYPE_CHECKING

from sim2real.composer import define
from sim2real.composer.observation.observable.base import Generic, Observable

if TYPE_CHECKING:
    from collections.abc import Callable

    from sim2real.composer.physics.base import BasePhysics
    from sim2real.types import PyTree

OPTIONS = frozenset({"update_interval", "buffer_size", "delay", "aggregator", "corruptor", "enabled"})
"""Options of ``set_options``."""


class ObservableKeys:
    """``observables.dict_keys.position`` is the key of ``position`` in an observation."""

    def __init__(self, entity: PyTree, observables: dict[str, Observable]) -> None:
        self._entity, self._observables = entity, observables

    def __getattr__(self, name: str) -> str:
        return self._entity.mjcf_model.full_identifier + name

    def __dir__(self) -> list[str]:
        return [*self._observables, *super().__dir__()]


@functools.cache
def _declared(owner: type) -> tuple[str, ...]:
    return tuple(name for name in sorted(dir(owner)) if isinstance(getattr(owner, name), define.observable))


class Observables:
    """Named observables of an entity; subclasses declare them with ``@composer.observable``."""

    def __init__(self, entity: PyTree) -> None:
        self._entity = weakref.proxy(entity)
        self._observables: OrderedDict[str, Observable] = OrderedDict()
        self._keys = ObservableKeys(self._entity, self._observables)
        for name in _declared(type(self)):
            self._observables[name] = getattr(self, name)
        for name, function in define.declared(entity).items():
            self.add_observable(name, function)

    @property
    def dict_keys(self) -> ObservableKeys:
        """Name -> key in an observation, as attributes."""
        return self._keys

    def as_dict(self, fully_qualified: bool = True) -> OrderedDict[str, Observable]:
        """Return name -> observable; default: names are prefixed with the entity's full name."""
        prefix = self._entity.mjcf_model.full_identifier if fully_qualified else ""
        return OrderedDict((prefix + name, value) for name, value in self._observables.items())

    def get_observable(self, name: str, name_fully_qualified: bool = False) -> Observable:
        """Return an observable; raise KeyError if there is none with the name."""
        if name_fully_qualified:
            name = name.removeprefix(self._entity.mjcf_model.full_identifier)
        try:
            return self._observables[name]
        except KeyError:
            raise KeyError(self._unknown(name)) from None

    def set_options(self, options: dict[str, PyTree] | None) -> None:
        """Configure observables.

        Args:
            options: Options for all observables (``update_interval``, ``buffer_size``, ``delay``, ``aggregator``,
                ``corruptor``, ``enabled``), or observable name -> options.

        Raises:
            KeyError: There is no observable with a name.
            AttributeError: There is no such option.
        """
        options = options or {}
        if options and OPTIONS.issuperset(options):
            options = dict.fromkeys(self._observables, options)
        for name, values in options.items():
            if name not in self._observables:
                raise KeyError(self._unknown(name))
            self._observables[name].configure(**values)

    def _unknown(self, name: str) -> str:
        return f"No observable with name {name!r}. Available: {', '.join(self._observables)}"

    def enable_all(self) -> None:
        """Enable all observables of this entity."""
        for value in self._observables.values():
            value.enabled = True

    def disable_all(self) -> None:
        """Disable all observables of this entity."""
        for value in self._observables.values():
            value.enabled = False

    def add_observable(
        self, name: str, observable: Observable | Callable[[PyTree], PyTree], enabled: bool = True
    ) -> None:
        """Add an observable, or a function of ``physics`` that returns the value."""
        if not isinstance(observable, Observable):
            observable = Generic(observable)
        self._observables[name] = observable
        observable.enabled = enabled

    def get_observation(self, physics: BasePhysics) -> dict[str, PyTree]:
        """Return the present value of every observable, without delays and buffers."""
        return {name: value(physics) for name, value in self._observables.items()}

    def __getattr__(self, name: str) -> PyTree:
        observables = self.__dict__.get("_observables", {})
        if name in observables:
            return observables[name]
        declared = inspect.getattr_static(type(self), name, None)
        if isinstance(declared, property):  # the property failed: raise its error, which names the missing attribute
            return declared.__get__(self, type(self))
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}. Observables: {', '.join(observables)}")
