"""One variation for several attributes."""

from __future__ import annotations

import weakref
from collections import deque
from typing import TYPE_CHECKING, Any

from sim2real.composer.variation.base import Variation, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, RandomState, Varying


class VariationBroadcaster:
    """Hands the same draws to several users: the n-th call of every proxy returns the n-th draw."""

    def __init__(self, wrapped_variation: Varying) -> None:
        self._wrapped = wrapped_variation
        self._waiting: weakref.WeakKeyDictionary[Proxy, deque[Any]] = weakref.WeakKeyDictionary()

    def get_proxy(self) -> Proxy:
        """Return a variation that stands for the wrapped one."""
        proxy = Proxy(self)
        self._waiting[proxy] = deque()
        return proxy

    def next_value(self, proxy: Proxy, random_state: RandomState | None) -> Any:
        """Return the next draw that a proxy has not had yet."""
        if not self._waiting[proxy]:
            value = evaluate(self._wrapped, None, None, random_state)
            for waiting in self._waiting.values():
                waiting.append(value)
        return self._waiting[proxy].popleft()


class Proxy(Variation):
    """Stands for a broadcast variation; made by ``VariationBroadcaster.get_proxy``."""

    def __init__(self, broadcaster: VariationBroadcaster) -> None:
        self._broadcaster = broadcaster

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return the next draw."""
        return self._broadcaster.next_value(self, random_state)
