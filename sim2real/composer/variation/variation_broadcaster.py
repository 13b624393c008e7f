"""One variation for several attributes."""

from __future__ import annotations

import weakref
from collections import deque
from typing import TYPE_CHECKING

from sim2real.composer.variation.base import Context, ContextVariation, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import RandomState, Varying
    from sim2real.types import PyTree


class VariationBroadcaster:
    """Gives all proxies the same draws: the n-th call of every proxy returns the n-th draw."""

    def __init__(self, wrapped_variation: Varying) -> None:
        self._wrapped = wrapped_variation
        self._waiting: weakref.WeakKeyDictionary[Proxy, deque[PyTree]] = weakref.WeakKeyDictionary()

    def get_proxy(self) -> Proxy:
        """Return a variation with the value of the wrapped one."""
        proxy = Proxy(self)
        self._waiting[proxy] = deque()
        return proxy

    def next_value(self, proxy: Proxy, random_state: RandomState | None) -> PyTree:
        """Return the next draw of a proxy."""
        if not self._waiting[proxy]:
            value = evaluate(self._wrapped, None, None, random_state)
            for waiting in self._waiting.values():
                waiting.append(value)
        return self._waiting[proxy].popleft()


class Proxy(ContextVariation):
    """Stands for a broadcast variation; made by ``VariationBroadcaster.get_proxy``."""

    def __init__(self, broadcaster: VariationBroadcaster) -> None:
        self._broadcaster = broadcaster

    def _value(self, context: Context) -> PyTree:
        return self._broadcaster.next_value(self, context.random_state)
