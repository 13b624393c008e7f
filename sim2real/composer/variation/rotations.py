"""Random rotations, as unit quaternions ``(4,)``, scalar first."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.physics.arrays import multiply_quaternions, namespace, rotate
from sim2real.composer.variation.base import Variation, evaluate

if TYPE_CHECKING:
    from sim2real.composer.types import ArrayLike, RandomState, Varying

IDENTITY_QUATERNION = np.array([1.0, 0.0, 0.0, 0.0])


class UniformQuaternion(Variation):
    """Uniformly distributed rotations (Shoemake, Graphics Gems III, 1992)."""

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a quaternion."""
        random_state = random_state or np.random
        u1, u2, u3 = random_state.uniform([0.0] * 3, [1.0, 2.0 * np.pi, 2.0 * np.pi])
        xp = namespace(u1)
        a, b = xp.sqrt(1.0 - u1), xp.sqrt(u1)
        return xp.array([a * xp.sin(u2), a * xp.cos(u2), b * xp.sin(u3), b * xp.cos(u3)])

    def __eq__(self, other: object) -> bool:
        return isinstance(other, UniformQuaternion)

    def __repr__(self) -> str:
        return "UniformQuaternion()"


class QuaternionFromAxisAngle(Variation):
    """Rotations about an axis by an angle [rad], both of which may vary."""

    def __init__(self, axis: Varying, angle: Varying) -> None:
        self._axis, self._angle = axis, angle

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a quaternion."""
        given = (initial_value, current_value, random_state or np.random)
        axis, angle = evaluate(self._axis, *given), evaluate(self._angle, *given)
        xp = namespace(axis, angle)
        turn = xp.asarray(axis) * angle
        size = xp.linalg.norm(turn)
        small = size < 1e-10
        direction = turn / xp.where(small, 1.0, size)
        quaternion = xp.concatenate([xp.cos(size / 2)[None], xp.sin(size / 2) * direction])
        return xp.where(small, xp.asarray(IDENTITY_QUATERNION), quaternion)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, QuaternionFromAxisAngle):
            return False
        return (self._axis, self._angle) == (other._axis, other._angle)

    def __repr__(self) -> str:
        return f"QuaternionFromAxisAngle(axis={self._axis}, angle={self._angle})"


class QuaternionPreMultiply(Variation):
    """Rotates the initial rotation, or the current one, further."""

    def __init__(self, quat: Varying, cumulative: bool = False) -> None:
        self._quat, self._cumulative = quat, cumulative

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a quaternion."""
        random_state = random_state or np.random
        first = evaluate(self._quat, initial_value, current_value, random_state)
        base: Any = current_value if self._cumulative else initial_value
        return multiply_quaternions(first, base)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, QuaternionPreMultiply):
            return False
        return (self._quat, self._cumulative) == (other._quat, other._cumulative)

    def __repr__(self) -> str:
        return f"QuaternionPreMultiply(quat={self._quat}, cumulative={self._cumulative})"


class QuaternionRotate(Variation):
    """A vector ``(3,)`` that is rotated: a given one, else the initial or the current value.

    Args:
        quat: The rotation, ``(4,)``, scalar first.
        vec: The vector; None: the initial or the current value.
        cumulative: Whether the current value is rotated, rather than the initial one.
    """

    def __init__(self, quat: Varying, vec: Varying = None, cumulative: bool = False) -> None:
        self._quat, self._vec, self._cumulative = quat, vec, cumulative

    def __call__(
        self,
        initial_value: ArrayLike | None = None,
        current_value: ArrayLike | None = None,
        random_state: RandomState | None = None,
    ) -> Any:
        """Return a vector."""
        given = (initial_value, current_value, random_state or np.random)
        quaternion = evaluate(self._quat, *given)
        if self._vec is None:
            vector = current_value if self._cumulative else initial_value
        else:
            vector = evaluate(self._vec, *given)
        xp = namespace(quaternion, vector)
        return rotate(xp.asarray(vector), xp.asarray(quaternion))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, QuaternionRotate):
            return False
        mine = (self._quat, self._vec, self._cumulative)
        return mine == (other._quat, other._vec, other._cumulative)

    def __repr__(self) -> str:
        return f"QuaternionRotate(quat={self._quat}, vec={self._vec}, cumulative={self._cumulative})"
