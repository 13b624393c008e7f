"""Variations bound to attributes: of the model before it is compiled, or of the compiled one."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from sim2real.arrays import is_jax
from sim2real.composer.variation.base import evaluate

if TYPE_CHECKING:
    from sim2real.composer.mjcf.element import Element, Elements  # noqa: F401 - in a type as text
    from sim2real.composer.types import RandomState, Varying
    from sim2real.types import PyTree

E = TypeVar("E")
CONSTANTS = frozenset(
    {"mass", "inertia", "ipos", "iquat", "pos", "quat", "armature", "qpos0", "qpos_spring", "gear", "stiffness", "size"}
)
"""Attributes from which MuJoCo derives constants, such as the inertia at a joint."""


class _Bound:
    __slots__ = ("initial", "variation")

    def __init__(self, variation: Varying, initial: PyTree = None) -> None:
        self.variation, self.initial = variation, initial


class _Variator(Generic[E]):
    """Variations by element and attribute."""

    def __init__(self) -> None:
        self._variations: dict[E, dict[str, _Bound]] = {}

    def bind_attributes(self, element: E, **attributes: Varying) -> None:
        """Bind variations, or fixed values, to attributes of an element; None unbinds."""
        bound = self._variations.setdefault(element, {})
        for name, variation in attributes.items():
            if variation is None and name in bound:
                del bound[name]
            else:
                bound[name] = _Bound(variation, self._initial(element, name))

    def clear(self) -> None:
        """Unbind everything."""
        self._variations.clear()

    def reset_initial_values(self) -> None:
        """Take the values at the next application as the initial ones."""
        for attributes in self._variations.values():
            for bound in attributes.values():
                bound.initial = None

    def _initial(self, element: E, name: str) -> PyTree:
        """Return the value of an attribute when it is bound; None: the value at the next application."""
        del element, name


class MJCFVariator(_Variator["Element"]):
    """Varies attributes of models before they are compiled; for ``initialize_episode_mjcf``."""

    def apply_variations(self, random_state: RandomState) -> None:
        """Draw a value for every bound attribute and set it."""
        for element, attributes in self._variations.items():
            values = {}
            for name, bound in attributes.items():
                current = getattr(element, name)
                if bound.initial is None:
                    bound.initial = copy.copy(current)
                values[name] = evaluate(bound.variation, bound.initial, current, random_state)
            element.set_attributes(**values)

    def _initial(self, element: Element, name: str) -> PyTree:
        return copy.copy(getattr(element, name))


class PhysicsVariator(_Variator["Elements"]):
    """Varies attributes of the compiled model and of the state; for ``initialize_episode`` and the steps.

    On MJX the initial value is the compiled model's, and only numeric fields of the model can vary from copy to copy.
    Constants that MuJoCo derives from masses and lengths are updated.
    """

    def apply_variations(self, physics: PyTree, random_state: RandomState) -> None:
        """Draw a value for every bound attribute and set it."""
        derived = False
        for element, attributes in self._variations.items():
            binding = physics.bind(element)
            for name, bound in attributes.items():
                current = getattr(binding, name)
                if is_jax(current):
                    initial = physics.initial(element, name)
                else:
                    if bound.initial is None:
                        bound.initial = np.copy(current)
                    initial = bound.initial
                derived = derived or name in CONSTANTS
                setattr(binding, name, evaluate(bound.variation, initial, current, random_state))
        if derived:
            physics.recompute_constants()
