"""Colours whose channels vary; the values are RGBA, shape ``(4,)`` in [0, 1]."""

from __future__ import annotations

import colorsys
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.physics.arrays import namespace
from sim2real.composer.variation.base import Variation, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, RandomState, Varying


class RgbVariation(Variation):
    """Red, green, blue and alpha.

    Args:
        r: Red, from 0 to 1.
        g: Green, from 0 to 1.
        b: Blue, from 0 to 1.
        alpha: Opacity, from 0 to 1.
    """

    def __init__(self, r: Varying, g: Varying, b: Varying, alpha: Varying = 1.0) -> None:
        self._channels = [r, g, b, alpha]

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a colour."""
        values = evaluate(self._channels, initial_value, current_value, random_state)
        return namespace(values).asarray(values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RgbVariation) and self._channels == other._channels

    def __repr__(self) -> str:
        r, g, b, alpha = self._channels
        return f"RgbVariation(r={r}, g={g}, b={b}, alpha={alpha})"


class HsvVariation(Variation):
    """Hue, saturation, value and alpha.

    Args:
        h: Hue, from 0 to 1.
        s: Saturation, from 0 to 1.
        v: Value, from 0 to 1.
        alpha: Opacity, from 0 to 1.
    """

    def __init__(self, h: Varying, s: Varying, v: Varying, alpha: Varying = 1.0) -> None:
        self._channels = (h, s, v, alpha)

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a colour."""
        h, s, v, alpha = evaluate(self._channels, initial_value, current_value, random_state)
        xp = namespace(h, s, v, alpha)
        if xp is np:
            return np.asarray([*colorsys.hsv_to_rgb(h, s, v), alpha])
        # The same without branches: a channel falls from v to v (1 - s) with the hue's distance from it.
        places = (xp.asarray([5.0, 3.0, 1.0]) + 6.0 * h) % 6.0
        return xp.append(v - v * s * xp.clip(xp.minimum(places, 4.0 - places), 0.0, 1.0), alpha)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HsvVariation) and self._channels == other._channels

    def __repr__(self) -> str:
        h, s, v, alpha = self._channels
        return f"HsvVariation(h={h}, s={s}, v={v}, alpha={alpha})"


class GrayVariation(HsvVariation):
    """Gray level and alpha."""

    def __init__(self, gray_level: Varying, alpha: Varying = 1.0) -> None:
        super().__init__(h=0.0, s=0.0, v=gray_level, alpha=alpha)

    def __repr__(self) -> str:
        return f"GrayVariation(gray_level={self._channels[2]}, alpha={self._channels[3]})"
