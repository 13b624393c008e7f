"""Random rotations, as unit quaternions ``(4,)``, scalar first."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sim2real.composer.physics.arrays import multiply_quaternions, namespace, rotate
from sim2real.composer.variation.base import Context, Parametric, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import Varying
    from sim2real.types import PyTree

IDENTITY_QUATERNION = np.array([1.0, 0.0, 0.0, 0.0])


class UniformQuaternion(Parametric):
    """Uniformly distributed rotations (Shoemake, Graphics Gems III, 1992)."""

    def _value(self, context: Context) -> PyTree:
        u1, u2, u3 = context.source.uniform([0.0] * 3, [1.0, 2.0 * np.pi, 2.0 * np.pi])
        xp = namespace(u1)
        a, b = xp.sqrt(1.0 - u1), xp.sqrt(u1)
        return xp.array([a * xp.sin(u2), a * xp.cos(u2), b * xp.sin(u3), b * xp.cos(u3)])


class QuaternionFromAxisAngle(Parametric):
    """Rotations about an axis by an angle [rad]; both may vary."""

    def __init__(self, axis: Varying, angle: Varying) -> None:
        self._axis, self._angle = axis, angle

    def _value(self, context: Context) -> PyTree:
        axis, angle = evaluate(self._axis, *context), evaluate(self._angle, *context)
        xp = namespace(axis, angle)
        turn = xp.asarray(axis) * angle
        size = xp.linalg.norm(turn)
        small = size < 1e-10
        direction = turn / xp.where(small, 1.0, size)
        quaternion = xp.concatenate([xp.cos(size / 2)[None], xp.sin(size / 2) * direction])
        return xp.where(small, xp.asarray(IDENTITY_QUATERNION), quaternion)


class QuaternionPreMultiply(Parametric):
    """Rotates the initial rotation, or the current one, further."""

    def __init__(self, quat: Varying, cumulative: bool = False) -> None:
        self._quat, self._cumulative = quat, cumulative

    def _value(self, context: Context) -> PyTree:
        return multiply_quaternions(evaluate(self._quat, *context), context.base(self._cumulative))


class QuaternionRotate(Parametric):
    """A vector ``(3,)`` that is rotated: a given one, else the initial or the current value."""

    def __init__(self, quat: Varying, vec: Varying = None, cumulative: bool = False) -> None:
        self._quat, self._vec, self._cumulative = quat, vec, cumulative

    def _value(self, context: Context) -> PyTree:
        quaternion = evaluate(self._quat, *context)
        vector = context.base(self._cumulative) if self._vec is None else evaluate(self._vec, *context)
        xp = namespace(quaternion, vector)
        return rotate(xp.asarray(vector), xp.asarray(quaternion))
