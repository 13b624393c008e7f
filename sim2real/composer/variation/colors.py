"""Colours whose channels vary; the values are RGBA, shape ``(4,)`` in [0, 1]."""

from __future__ import annotations

import colorsys
from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.physics.arrays import namespace
from sim2real.composer.variation.base import Context, Parametric, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import Varying
    from sim2real.types import PyTree


class RgbVariation(Parametric):
    """Red, green, blue and alpha."""

    def __init__(self, r: Varying, g: Varying, b: Varying, alpha: Varying = 1.0) -> None:
        self._r, self._g, self._b, self._alpha = r, g, b, alpha

    def _value(self, context: Context) -> PyTree:
        values = evaluate([self._r, self._g, self._b, self._alpha], *context)
        return namespace(values).asarray(values)


class HsvVariation(Parametric):
    """Hue, saturation, value and alpha."""

    def __init__(self, h: Varying, s: Varying, v: Varying, alpha: Varying = 1.0) -> None:
        self._h, self._s, self._v, self._alpha = h, s, v, alpha

    def _value(self, context: Context) -> PyTree:
        h, s, v, alpha = evaluate((self._h, self._s, self._v, self._alpha), *context)
        xp = namespace(h, s, v, alpha)
        if xp is np:
            return np.asarray([*colorsys.hsv_to_rgb(h, s, v), alpha])
        # The same without branches: a channel falls from v to v (1 - s) with the hue's distance from it.
        places = (xp.asarray([5.0, 3.0, 1.0]) + 6.0 * h) % 6.0
        return xp.append(v - v * s * xp.clip(xp.minimum(places, 4.0 - places), 0.0, 1.0), alpha)


class GrayVariation(HsvVariation):
    """Gray level and alpha."""

    def __init__(self, gray_level: Varying, alpha: Varying = 1.0) -> None:
        super().__init__(h=0.0, s=0.0, v=gray_level, alpha=alpha)

    def __repr__(self) -> str:
        return f"GrayVariation(gray_level={self._v}, alpha={self._alpha})"
